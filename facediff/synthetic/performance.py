"""From a spoken sentence to the motion of a face: mouth, brows, lids, gaze and head.

Speech decides the mouth, and chance much of the rest, so that one recording has many possible motions. Rates, lengths
and sizes are those measured in people; each has its source next to it. Everything is computed at 200 Hz and read off at
the frames, so that a clip is the same motion at any frame rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facediff.synthetic.articulation import LIP_AT_TEETH, SIDED, SPEECH_SHAPES, SpeechSound, blend, lip_contact
from facediff.synthetic.geometry import Array, rise
from facediff.synthetic.head.rig import LOOK_DOWN, LOOK_SIDEWAYS, LOOK_UP, SHAPES
from facediff.synthetic.prosody import ProsodyContours, blurred

FINE_RATE = 200  # Steps a second
_MARGIN = 0.4  # Seconds before and after the clip in which motion goes on
_SACCADE_VELOCITY = (0.021, 0.0022)
"""Seconds that a saccade takes, and those that each degree adds (Carpenter, "Movements of the eyes", 1988)."""
_FAR_AWAY = 12.0  # Degrees of a glance above which lids blink along (Evinger and others, Exp. Brain Res. 100, 1994)


@dataclass(frozen=True)
class SpeakingHabits:
    """How a person speaks and moves, independently of the words.

    Attributes:
        jaw, rounding, spreading, lips: gains of what speech moves.
        lead: seconds by which the mouth runs ahead of the sound; negative: behind.
        slack: how widely sounds run into one another; below 1 is crisp.
        smoothness: standard deviation in seconds of the final smoothing of the mouth.
        asymmetry: how much stronger the left side moves (-0.2 to 0.2; mouths open wider on the right in 60 to 80 % of
            speakers, Graves and others, Neuropsychologia 20, 1982).
        smile, frown, squint: resting weights.
        inner_brow, outer_brow: gains of the brows on accents.
        blinks: blinks a minute while speaking: 26 on average, 10 to 50 by person (Bentivoglio and others, Mov. Disord.
            12, 1997).
        blink_length: seconds from open to open, about a third of it to close (VanderWerf and others, J. Neurophysiol.
            89, 2003: 0.25 to 0.35).
        gaze_away: share of the time that a speaker looks away (Argyle and Cook, "Gaze and mutual gaze", 1976: 0.4).
        nods: degrees by which the head goes down on accents (Hadar and others, Lang. Speech 26, 1983).
        sway: degrees of the slow drift of the head.
        tilt: resting roll of the head in degrees.
    """

    jaw: float = 1.0
    rounding: float = 1.0
    spreading: float = 1.0
    lips: float = 1.0
    lead: float = 0.0
    slack: float = 1.0
    smoothness: float = 0.014
    asymmetry: float = 0.0
    smile: float = 0.0
    frown: float = 0.0
    squint: float = 0.0
    inner_brow: float = 0.5
    outer_brow: float = 0.4
    blinks: float = 24.0
    blink_length: float = 0.28
    gaze_away: float = 0.35
    nods: float = 2.5
    sway: float = 1.5
    tilt: float = 0.0


@dataclass(frozen=True)
class MoodEffect:
    """The effect of a mood on every speaker's face and voice."""

    articulation: float  # Gain of large shapes of the mouth
    brows: float  # Gain of the brows on accents, and of the nods
    raised: float  # Resting weight of the brows
    smile: float  # Added to the resting weight, as the next one
    frown: float
    droop: float  # Resting weight of the upper lids
    rate: float  # Factor of the voice's speed
    pitch_range: float  # Factor of the range of its melody
    pitch: float  # Semitones added
    loudness: float  # Decibels added
    brightness: float  # Decibels per octave above 500 Hz; a pressed voice is bright


# Acoustics after Banse and Scherer (J. Pers. Soc. Psychol. 70, 1996): sad and bored voices are slower, lower, softer
# and flatter, happy and excited ones faster, higher, louder and brighter.
MOODS = {
    "flat": MoodEffect(0.7, 0.3, -0.05, -0.12, 0.12, 0.16, 0.93, 0.5, -1.0, -4.0, -1.5),
    "neutral": MoodEffect(1.0, 0.8, 0.0, 0.0, 0.0, 0.04, 1.0, 1.0, 0.0, 0.0, 0.0),
    "lively": MoodEffect(1.3, 1.4, 0.22, 0.25, 0.0, 0.0, 1.06, 1.5, 1.5, 3.0, 1.0),
}

_GAIN_OF = {
    "jawOpen": "jaw",
    "mouthPucker": "rounding",
    "mouthFunnel": "rounding",
    "mouthStretch": "spreading",
    "mouthSmile": "spreading",
    "mouthUpperUp": "lips",
    "mouthLowerDown": "lips",
}


@dataclass(frozen=True)
class FaceMotion:
    """The motion of a clip.

    Attributes:
        weights: (T, 54) of :data:`facediff.synthetic.head.rig.SHAPES`, the eyes' turns included.
        gaze: where the eyes look, to the face's left and up in degrees, (T, 2).
        head: pitch (chin down), yaw (to its left) and roll (towards its left shoulder) in degrees, (T, 3).
    """

    weights: Array
    gaze: Array
    head: Array


def synthesise_motion(
    sounds: Sequence[SpeechSound],
    prosody: ProsodyContours,
    frames: int,
    frame_rate: float,
    habits: SpeakingHabits,
    mood: str,
    random: np.random.Generator,
) -> FaceMotion:
    """The motion of a spoken sentence at the middle of each frame; ``mood`` is a name in :data:`MOODS`."""
    effect = MOODS[mood]
    times = np.arange(-_MARGIN, frames / frame_rate + _MARGIN, 1.0 / FINE_RATE)
    accents = np.interp(times, prosody.times, 0.55 * prosody.pitch + 0.45 * prosody.loudness)
    mouth = _mouth(sounds, times, habits, effect, random)
    gaze, glances = _gaze(times, habits, random)
    upper = _upper_face(mouth, effect.brows * accents, gaze, glances, times, habits, effect, random)
    head = _head(effect.brows * accents, gaze, times, habits, random)
    tracks = _sided({**mouth, **upper}, times, habits, random)
    looks = _looks(gaze)
    # A lid that is shut does not go along with the eye behind it, which would carry it beyond the lower one.
    for side in ("Left", "Right"):
        looks[f"eyeLookDown{side}"] *= 1.0 - tracks[f"eyeBlink{side}"]
    still = np.zeros_like(times)
    weights = np.stack([{**tracks, **looks}.get(name, still) for name in SHAPES], axis=1)
    middles: Array = (np.arange(frames, dtype=np.float64) + 0.5) / frame_rate
    return FaceMotion(*(_at(middles, times, track) for track in (np.clip(weights, 0.0, 1.2), gaze, head)))


def _at(middles: Array, times: Array, tracks: Array) -> Array:
    """Tracks (n, K) read off at other times, (T, K)."""
    return np.stack([np.interp(middles, times, track) for track in tracks.T], axis=1)


def _mouth(
    sounds: Sequence[SpeechSound], times: Array, habits: SpeakingHabits, effect: MoodEffect, random: np.random.Generator
) -> dict[str, Array]:
    """The mouth, which follows the phonemes; shapes with two sides are still one."""
    weights = blend(sounds, times + habits.lead, spread=habits.slack)
    wander = 1.0 + 0.03 * drift(times, random)
    tracks: dict[str, Array] = {}
    for column, name in enumerate(SPEECH_SHAPES):
        # Lips that press, or that touch the teeth, do so in every mood; only large shapes are emphasised.
        gain = effect.articulation * getattr(habits, _GAIN_OF[name]) if name in _GAIN_OF else 1.0
        tracks[name] = smooth(gain * wander * weights[:, column], habits.smoothness)
    # A speaker with slack articulation touches lips and teeth in time all the same.
    shut, at_teeth = (
        smooth(
            lip_contact(sounds, times + float(np.clip(habits.lead, -0.008, 0.008)), contact),
            min(habits.smoothness, 0.010),
        )
        for contact in ("lip", "teeth")
    )
    for name, weight in LIP_AT_TEETH.items():
        tracks[name] = tracks[name] + at_teeth * (weight - tracks[name])
    # Lips that meet show no teeth and are not rounded outwards; the jaw stays where it is and the lips bridge it.
    for name in ("mouthUpperUp", "mouthLowerDown", "mouthRollLower", "mouthFunnel"):
        tracks[name] = tracks[name] * (1.0 - shut)
    tracks["mouthClose"] = tracks["jawOpen"] * shut
    rest = habits.smile + effect.smile
    tracks["mouthSmile"] = tracks["mouthSmile"] + max(rest, 0.0) + 0.02 * drift(times, random)
    tracks["mouthFrown"] = np.full_like(times, max(-rest, 0.0))
    tracks["cheekSquint"] = 0.6 * tracks["mouthSmile"] + 0.3 * tracks["mouthStretch"]
    tracks["noseSneer"] = 0.25 * tracks["mouthUpperUp"]
    return tracks


def _gaze(times: Array, habits: SpeakingHabits, random: np.random.Generator) -> tuple[Array, list[tuple[float, float]]]:
    """Where the eyes look (n, 2) in degrees, and time and size of each glance.

    The eyes rest on the listener or away from it for a while and jump between; within a rest they make small jumps.
    Rests are exponential, 2.5 s on the listener and 1 s away on average (Lee, Badler and Badler, "Eyes alive", 2002),
    scaled to the speaker's share of looking away. Sizes follow that paper's exponential of 6.9 degrees.
    """
    gaze = np.zeros((len(times), 2))
    glances: list[tuple[float, float]] = []
    target, away, time = np.zeros(2), False, float(times[0])
    while time < times[-1]:
        mean = 2.5 * habits.gaze_away / 0.35 * 0.4 if away else 2.5 * (1.0 - habits.gaze_away) / 0.65
        end = time + 0.25 + float(random.exponential(max(mean, 0.1)))
        moment = time
        while moment < end:  # small jumps about the place that is looked at
            size = float(random.exponential(0.6))
            turn = float(random.uniform(0.0, 2.0 * np.pi))
            _jump(gaze, times, moment, target + size * np.array([np.cos(turn), 0.6 * np.sin(turn)]))
            moment += 0.2 + float(random.exponential(0.5))
        time, away = end, not away
        point = np.zeros(2)
        if away:
            size = 4.0 + min(float(random.exponential(6.9)), 16.0)
            turn = float(random.choice([0.0, np.pi], p=[0.5, 0.5])) + float(random.normal(0.0, 0.5))
            point = size * np.array([np.cos(turn), 0.7 * np.sin(turn)])
        glances.append((time, float(np.linalg.norm(point - target))))
        target = point
        _jump(gaze, times, time, target)
    return gaze, glances


def _jump(gaze: Array, times: Array, moment: float, target: Array) -> None:
    """Turn the eyes to a target (2,) from a moment on, as fast as eyes do."""
    first = int(np.searchsorted(times, moment))
    if first >= len(times):
        return
    start = gaze[first].copy()
    base, more = _SACCADE_VELOCITY
    length = base + more * float(np.linalg.norm(target - start))
    gaze[first:] = start + rise(times[first:], moment, moment + length)[:, None] * (target - start)


def _upper_face(
    mouth: dict[str, Array],
    accents: Array,
    gaze: Array,
    glances: list[tuple[float, float]],
    times: Array,
    habits: SpeakingHabits,
    effect: MoodEffect,
    random: np.random.Generator,
) -> dict[str, Array]:
    """Brows on accents (Cavé and others, ICSLP 1996), blinks, lids that follow the gaze, and slow drift."""
    accents = np.maximum(accents, -0.3)
    habit = 1.0 + 0.25 * float(random.standard_normal())
    inner = effect.raised + habits.inner_brow * habit * accents * 0.8 + 0.03 * drift(times, random)
    outer = effect.raised + habits.outer_brow * habit * accents * 0.8 + 0.03 * drift(times, random)
    frown = habits.frown + effect.frown - 0.2 * np.minimum(accents, 0.0) + 0.02 * drift(times, random)
    blink = _blinks(times, glances, habits, random)
    droop = np.clip(effect.droop + 0.02 * drift(times, random), 0.0, 0.4)
    squint = habits.squint + 0.4 * mouth["cheekSquint"] + 0.02 * drift(times, random)
    return {
        "browInnerUp": smooth(inner, 0.03),
        "browOuterUp": smooth(outer, 0.03),
        "browDown": smooth(frown, 0.03),
        "eyeBlink": np.clip(droop + (1.0 - droop) * blink, 0.0, 1.0),
        "eyeSquint": np.maximum(squint, 0.0) * (1.0 - blink),
        "eyeWide": np.maximum(0.3 * inner, 0.0) * (1.0 - blink),
    }


def _blinks(
    times: Array, glances: list[tuple[float, float]], habits: SpeakingHabits, random: np.random.Generator
) -> Array:
    """How far blinks shut the lids (n,): at random times, and with most of the large glances.

    They shut in about a third of their length and open more slowly (VanderWerf and others, 2003).
    """
    rate = habits.blinks / 60.0
    moments = [moment for moment, size in glances if size > _FAR_AWAY and random.uniform() < 0.6]
    time = float(times[0] + random.exponential(1.0 / rate))
    while time < times[-1]:
        moments.append(time)
        time += 0.6 + float(random.exponential(1.0 / rate))
    shut = np.zeros_like(times)
    last = -1.0
    for moment in sorted(moments):
        if moment < last + 0.35:
            continue
        length = habits.blink_length * float(random.uniform(0.85, 1.2))
        down, hold = 0.33 * length, 0.10 * length
        last = moment + length
        pulse = rise(times, moment, moment + down) * rise(times, last, moment + down + hold)
        shut = np.maximum(shut, pulse)
    return shut


def _head(accents: Array, gaze: Array, times: Array, habits: SpeakingHabits, random: np.random.Generator) -> Array:
    """Pitch, yaw and roll of the head (n, 3) in degrees.

    Nods follow the melody, which explains about two thirds of the head's motion in speech (Munhall and others, Psychol.
    Sci. 15, 2004); sway is slower than 1 Hz (Hadar and others, 1983); a glance takes a part of the head along.
    """
    nod = -smooth(np.maximum(accents, 0.0), 0.06) + 0.5 * smooth(np.maximum(-accents, 0.0), 0.15)
    along = 0.3 * smooth(gaze[:, 0], 0.12)
    pitch = -habits.nods * nod + 0.6 * habits.sway * drift(times, random)
    yaw = along + habits.sway * drift(times, random)
    roll = habits.tilt + 0.5 * habits.sway * drift(times, random) + 0.15 * along
    return np.stack([pitch, yaw, roll], axis=1)


def _looks(gaze: Array) -> dict[str, Array]:
    """Weights of the eyes' turns for a direction of gaze, to the face's left and up."""
    left, up = gaze[:, 0], gaze[:, 1]
    to_left, to_right = np.maximum(left, 0.0) / LOOK_SIDEWAYS, np.maximum(-left, 0.0) / LOOK_SIDEWAYS
    looks = {"OutLeft": to_left, "InRight": to_left, "InLeft": to_right, "OutRight": to_right}
    for side in ("Left", "Right"):
        looks[f"Up{side}"] = np.maximum(up, 0.0) / LOOK_UP
        looks[f"Down{side}"] = np.maximum(-up, 0.0) / LOOK_DOWN
    return {f"eyeLook{name}": weight for name, weight in looks.items()}


def _sided(
    tracks: dict[str, Array], times: Array, habits: SpeakingHabits, random: np.random.Generator
) -> dict[str, Array]:
    """The tracks by the rig's names: both sides of a shape move nearly alike, more or less on the left."""
    lean = np.clip(habits.asymmetry + 0.04 * drift(times, random), -0.35, 0.35)
    result: dict[str, Array] = {}
    for name, track in tracks.items():
        if name not in SIDED:
            result[name] = track
            continue
        # Lids close together: half of one lid's blink would be a wink.
        share = np.zeros_like(times) if name.startswith("eye") else lean
        result[f"{name}Left"], result[f"{name}Right"] = track * (1.0 + share), track * (1.0 - share)
    return result


def drift(times: Array, random: np.random.Generator) -> Array:
    """Slow random drift of about unit size: a few sines below 0.8 Hz."""
    rates = random.uniform(0.12, 0.8, 4)
    phases = random.uniform(0.0, 2.0 * np.pi, 4)
    waves = np.sin(2.0 * np.pi * rates[:, None] * times + phases[:, None])
    return np.asarray(0.7 * waves.sum(axis=0))


def smooth(track: Array, deviation: float) -> Array:
    """Blur in time with a Gaussian of so many seconds."""
    reach = max(int(np.ceil(3.0 * deviation * FINE_RATE)), 1)
    return blurred(track, np.arange(-reach, reach + 1) / (deviation * FINE_RATE))
