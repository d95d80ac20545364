"""How a speaker moves and what a mood does to it: from speech to the weights of the rig, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facediff.puppet.coarticulation import Segment, articulate, close_lips
from facediff.puppet.curves import Array, rise
from facediff.puppet.prosody import Prosody
from facediff.puppet.rig import CONTROLS
from facediff.puppet.visemes import SPEECH_CONTROLS

FRAME_RATE = 25
_FINE_RATE = 200
_CLOSURE_SMOOTHNESS = 0.010


@dataclass(frozen=True)
class Manner:
    """A speaker's way of moving.

    Attributes:
        jaw: Gain of the jaw.
        rounding: Gain of pucker and funnel.
        spreading: Gain of stretch and of the corners.
        lips: Gain of upper and lower lip.
        lead: Seconds by which the mouth runs ahead of the sound (negative: behind).
        slack: How widely sounds run into one another; below 1 is crisp.
        smoothness: Standard deviation in seconds of the final smoothing in time.
        asymmetry: How much stronger the left side moves.
        smile: Resting weight of the corners.
        inner_brow: Gain of the inner brows on accents.
        outer_brow: Gain of the outer brows on accents.
        frown: Resting weight of the frown.
        blinks: Blinks per second.
        blink_length: Seconds that a blink takes.
        squint: Resting weight of the lower lids.
        cheeks: Gain of the cheeks with the spreading of the lips.
    """

    jaw: float = 1.0
    rounding: float = 1.0
    spreading: float = 1.0
    lips: float = 1.0
    lead: float = 0.02
    slack: float = 1.0
    smoothness: float = 0.014
    asymmetry: float = 0.0
    smile: float = 0.0
    inner_brow: float = 0.5
    outer_brow: float = 0.5
    frown: float = 0.0
    blinks: float = 0.35
    blink_length: float = 0.26
    squint: float = 0.0
    cheeks: float = 0.4


@dataclass(frozen=True)
class Mood:
    """What a mood does to every speaker.

    Attributes:
        articulation: Gain of all that speech moves.
        brows: Gain of the brows.
        raised: Resting weight of the brows.
        smile: Added to the resting corners.
        droop: Resting weight of the upper lids.
        frown: Added to the resting frown.
    """

    articulation: float
    brows: float
    raised: float
    smile: float
    droop: float
    frown: float


MOOD_EFFECTS = {
    "flat": Mood(0.65, 0.25, -0.05, -0.15, 0.16, 0.15),
    "neutral": Mood(1.0, 0.75, 0.0, 0.0, 0.04, 0.0),
    "lively": Mood(1.35, 1.4, 0.28, 0.22, 0.0, 0.0),
}

_GAINS = {
    "jaw_open": "jaw",
    "pucker": "rounding",
    "funnel": "rounding",
    "stretch": "spreading",
    "corner_up": "spreading",
    "upper_lip_raise": "lips",
    "lower_lip_drop": "lips",
}


def perform(
    segments: list[Segment],
    prosody: Prosody,
    frames: int,
    manner: Manner,
    mood: str,
    random: np.random.Generator,
) -> Array:
    """Turn a spoken sentence into the motion of a face.

    Args:
        segments: The sentence's mouth shapes in time.
        prosody: Its loudness and melody.
        frames: How many frames to make.
        manner: The speaker's manner.
        mood: One of `MOOD_EFFECTS`.
        random: Source of blinks and drift.

    Returns:
        Weights in the order of `facediff.puppet.rig.CONTROLS` at the middle of each frame, shape
        (frames, controls).
    """
    effect = MOOD_EFFECTS[mood]
    margin = 0.2
    times = np.arange(-margin, frames / FRAME_RATE + margin, 1.0 / _FINE_RATE)
    tracks = {name: np.zeros_like(times) for name in CONTROLS}
    _speech(tracks, segments, times, manner, effect, random)
    _upper_face(tracks, prosody, times, manner, effect, random)
    # Even a slack speaker shuts the lips in time.
    blur = {"lip_closure": min(manner.smoothness, _CLOSURE_SMOOTHNESS)}
    fine = np.stack([_smooth(track, blur.get(name, manner.smoothness)) for name, track in tracks.items()])
    middles = (np.arange(frames) + 0.5) / FRAME_RATE
    return np.stack([np.interp(middles, times, track) for track in fine], axis=1)


def _speech(
    tracks: dict[str, Array],
    segments: list[Segment],
    times: Array,
    manner: Manner,
    effect: Mood,
    random: np.random.Generator,
) -> None:
    """What the words ask of jaw and lips."""
    weights = articulate(segments, times + manner.lead, spread=manner.slack)
    wander = 1.0 + 0.03 * _drift(times, random)
    for column, control in enumerate(SPEECH_CONTROLS):
        gain = getattr(manner, _GAINS[control]) if control in _GAINS else 1.0
        # The lip that finds the teeth and the lips that press do so in every mood; only large shapes grow.
        emphasis = effect.articulation if control in _GAINS else 1.0
        tracks[control] += gain * emphasis * wander * weights[:, column]
    tracks["lip_closure"] += close_lips(segments, times + np.clip(manner.lead, -0.008, 0.008))
    for control in ("upper_lip_raise", "lower_lip_drop", "lower_lip_tuck"):
        # Lips that meet cannot show the teeth at the same time.
        tracks[control] *= 1.0 - 0.85 * tracks["lip_closure"]
    smile = manner.smile + effect.smile
    tracks["corner_up"] += max(smile, 0.0) + 0.03 * _drift(times, random)
    tracks["corner_down"] += max(-smile, 0.0)
    tracks["cheek_raise"] += manner.cheeks * (tracks["stretch"] + 0.8 * tracks["corner_up"])


def _upper_face(
    tracks: dict[str, Array],
    prosody: Prosody,
    times: Array,
    manner: Manner,
    effect: Mood,
    random: np.random.Generator,
) -> None:
    """Brows that follow loudness and melody; blinks and drift."""
    accent = np.interp(times, prosody.times, 0.55 * prosody.pitch + 0.45 * prosody.loudness)
    accent = effect.brows * np.maximum(accent, -0.3)
    habit = 1.0 + 0.25 * float(random.standard_normal())
    tracks["inner_brow_up"] += effect.raised + manner.inner_brow * habit * accent + 0.06 * _drift(times, random)
    tracks["outer_brow_up"] += effect.raised + manner.outer_brow * habit * accent + 0.06 * _drift(times, random)
    tracks["brow_frown"] += manner.frown + effect.frown - 0.25 * np.minimum(accent, 0.0) + 0.04 * _drift(times, random)
    tracks["squint"] += manner.squint + 0.5 * tracks["cheek_raise"] + 0.04 * _drift(times, random)
    tracks["nose_wrinkle"] += 0.3 * tracks["upper_lip_raise"]
    tracks["lids_wide"] += np.maximum(0.35 * tracks["inner_brow_up"], 0.0)
    blink = _blinks(times, manner, random)
    droop = effect.droop + 0.04 * _drift(times, random)
    tracks["lids_close"] += np.clip(droop + (1.0 - droop) * blink, 0.0, 1.0)
    tracks["lids_wide"] *= 1.0 - blink
    tracks["squint"] *= 1.0 - blink


def _blinks(times: Array, manner: Manner, random: np.random.Generator) -> Array:
    """Closings of the lids at random times, quicker to shut than to open, shape of ``times``."""
    shut = np.zeros_like(times)
    place = float(times[0] + random.exponential(1.0 / manner.blinks))
    while place < times[-1]:
        length = manner.blink_length * float(random.uniform(0.85, 1.2))
        down, hold = 0.36 * length, 0.12 * length
        pulse = rise(times, place, place + down) * rise(times, place + length, place + down + hold)
        shut = np.maximum(shut, pulse)
        place += length + 0.5 + float(random.exponential(1.0 / manner.blinks))
    return shut


def _drift(times: Array, random: np.random.Generator) -> Array:
    """Slow random wandering of about unit size: a few sines below 0.8 Hz."""
    rates = random.uniform(0.12, 0.8, 4)
    phases = random.uniform(0.0, 2.0 * np.pi, 4)
    waves = np.sin(2.0 * np.pi * rates[:, None] * times + phases[:, None])
    return np.asarray(0.7 * waves.sum(axis=0))


def _smooth(track: Array, deviation: float) -> Array:
    """Blur in time with a Gaussian of so many seconds, holding the ends."""
    reach = max(int(np.ceil(3.0 * deviation * _FINE_RATE)), 1)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (deviation * _FINE_RATE)) ** 2)
    return np.convolve(np.pad(track, reach, mode="edge"), kernel / kernel.sum(), mode="valid")
