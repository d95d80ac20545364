"""From speech to the weights of the rig, frame by frame, in a speaking style and a mood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facediff.speech.espeak import SpokenPhoneme
from facediff.synthetic.geometry import Array, rise
from facediff.synthetic.rig import CONTROLS

#: Rig controls that speech drives, in the order used by `facediff.synthetic.motion`.
SPEECH_CONTROLS = (
    "jaw_open",
    "lip_press",
    "pucker",
    "funnel",
    "stretch",
    "upper_lip_raise",
    "lower_lip_drop",
    "lower_lip_tuck",
    "corner_up",
    "cheek_puff",
    "chin_raise",
    "nose_wrinkle",
)
FRAME_RATE = 25
FINE_RATE = 200
_CLOSURE_SMOOTHNESS = 0.010


@dataclass(frozen=True)
class SpeakingStyle:
    """A speaker's speaking style."""

    jaw: float = 1.0  # Gain of the jaw
    rounding: float = 1.0  # Gain of pucker and funnel
    spreading: float = 1.0  # Gain of stretch and of the corners
    lips: float = 1.0  # Gain of upper and lower lip
    lead: float = 0.02  # Seconds by which the mouth runs ahead of the sound (negative: behind)
    slack: float = 1.0  # How widely sounds run into one another; below 1 is crisp
    smoothness: float = 0.014  # Standard deviation in seconds of the final smoothing in time
    asymmetry: float = 0.0  # How much stronger the left side moves
    smile: float = 0.0  # Resting weight of the corners
    inner_brow: float = 0.5  # Gain of the inner brows on accents
    outer_brow: float = 0.5  # Gain of the outer brows on accents
    frown: float = 0.0  # Resting weight of the frown
    blinks: float = 0.35  # Blinks per second
    blink_length: float = 0.26  # Seconds that a blink takes
    squint: float = 0.0  # Resting weight of the lower lids
    cheeks: float = 0.4  # Gain of the cheeks with the spreading of the lips


@dataclass(frozen=True)
class Mood:
    """What a mood does to every speaker."""

    articulation: float  # Gain of all that speech moves
    brows: float  # Gain of the brows
    raised: float  # Resting weight of the brows
    smile: float  # Added to the resting corners
    droop: float  # Resting weight of the upper lids
    frown: float  # Added to the resting frown


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


def generate_weights(
    segments: list[Segment],
    prosody: ProsodyContours,
    frames: int,
    style: SpeakingStyle,
    mood: str,
    random: np.random.Generator,
) -> Array:
    """Turn a spoken sentence's mouth shapes, loudness and melody into the motion of a face.

    The mood is one of `MOOD_EFFECTS`; blinks and drift are random.

    Returns:
        Weights (frames, controls) in the order of `facediff.synthetic.rig.CONTROLS` at the middle of each frame.
    """
    effect = MOOD_EFFECTS[mood]
    margin = 0.2  # seconds beyond both ends, so that smoothing has no border effect within the clip
    times = np.arange(-margin, frames / FRAME_RATE + margin, 1.0 / FINE_RATE)
    tracks = {name: np.zeros_like(times) for name in CONTROLS}
    _speech(tracks, segments, times, style, effect, random)
    _upper_face(tracks, prosody, times, style, effect, random)
    # Even a speaker with slack articulation shuts the lips in time.
    blur = {"lip_closure": min(style.smoothness, _CLOSURE_SMOOTHNESS)}
    fine = np.stack([smooth(track, blur.get(name, style.smoothness)) for name, track in tracks.items()])
    middles = (np.arange(frames) + 0.5) / FRAME_RATE
    return np.stack([np.interp(middles, times, track) for track in fine], axis=1)


def _speech(
    tracks: dict[str, Array],
    segments: list[Segment],
    times: Array,
    style: SpeakingStyle,
    effect: Mood,
    random: np.random.Generator,
) -> None:
    """Add the motion of jaw and lips, which follows the phonemes."""
    # The mouth runs ahead of the sound by `lead`: sampling the gestures later in time plays them earlier.
    weights = articulate(segments, times + style.lead, spread=style.slack)
    wander = 1.0 + 0.03 * drift(times, random)
    for column, control in enumerate(SPEECH_CONTROLS):
        gain = getattr(style, _GAINS[control]) if control in _GAINS else 1.0
        # Lips that press, or that touch the teeth, do so in every mood; only large shapes are emphasised.
        emphasis = effect.articulation if control in _GAINS else 1.0
        tracks[control] += gain * emphasis * wander * weights[:, column]
    # Closures may not run ahead as far as vowels do, or a frame with the sound of a b would show open lips.
    tracks["lip_closure"] += close_lips(segments, times + np.clip(style.lead, -0.008, 0.008))
    for control in ("upper_lip_raise", "lower_lip_drop", "lower_lip_tuck"):
        # Lips that meet cannot show the teeth at the same time.
        tracks[control] *= 1.0 - 0.85 * tracks["lip_closure"]
    smile = style.smile + effect.smile
    tracks["corner_up"] += max(smile, 0.0) + 0.03 * drift(times, random)
    tracks["corner_down"] += max(-smile, 0.0)
    tracks["cheek_raise"] += style.cheeks * (tracks["stretch"] + 0.8 * tracks["corner_up"])


def _upper_face(
    tracks: dict[str, Array],
    prosody: ProsodyContours,
    times: Array,
    style: SpeakingStyle,
    effect: Mood,
    random: np.random.Generator,
) -> None:
    """Add the motion of the brows, which follows loudness and melody, and blinks and drift."""
    accent = np.interp(times, prosody.times, 0.55 * prosody.pitch + 0.45 * prosody.loudness)
    accent = effect.brows * np.maximum(accent, -0.3)
    habit = 1.0 + 0.25 * float(random.standard_normal())
    tracks["inner_brow_up"] += effect.raised + style.inner_brow * habit * accent + 0.06 * drift(times, random)
    tracks["outer_brow_up"] += effect.raised + style.outer_brow * habit * accent + 0.06 * drift(times, random)
    tracks["brow_frown"] += style.frown + effect.frown - 0.25 * np.minimum(accent, 0.0) + 0.04 * drift(times, random)
    tracks["squint"] += style.squint + 0.5 * tracks["cheek_raise"] + 0.04 * drift(times, random)
    tracks["nose_wrinkle"] += 0.3 * tracks["upper_lip_raise"]
    tracks["lids_wide"] += np.maximum(0.35 * tracks["inner_brow_up"], 0.0)
    blink = _blinks(times, style, random)
    droop = effect.droop + 0.04 * drift(times, random)
    tracks["lids_close"] += np.clip(droop + (1.0 - droop) * blink, 0.0, 1.0)
    tracks["lids_wide"] *= 1.0 - blink
    tracks["squint"] *= 1.0 - blink


def _blinks(times: Array, style: SpeakingStyle, random: np.random.Generator) -> Array:
    """How far the lids are shut by blinks at random times, which shut faster than they open, shape of ``times``."""
    shut = np.zeros_like(times)
    place = float(times[0] + random.exponential(1.0 / style.blinks))
    while place < times[-1]:
        length = style.blink_length * float(random.uniform(0.85, 1.2))
        down, hold = 0.36 * length, 0.12 * length
        pulse = rise(times, place, place + down) * rise(times, place + length, place + down + hold)
        shut = np.maximum(shut, pulse)
        place += length + 0.5 + float(random.exponential(1.0 / style.blinks))
    return shut


def drift(times: Array, random: np.random.Generator) -> Array:
    """Slow random drift of about unit size: a few sines below 0.8 Hz."""
    rates = random.uniform(0.12, 0.8, 4)
    phases = random.uniform(0.0, 2.0 * np.pi, 4)
    waves = np.sin(2.0 * np.pi * rates[:, None] * times + phases[:, None])
    return np.asarray(0.7 * waves.sum(axis=0))


def smooth(track: Array, deviation: float) -> Array:
    """Blur in time with a Gaussian of so many seconds."""
    reach = max(int(np.ceil(3.0 * deviation * FINE_RATE)), 1)
    return _blurred(track, np.arange(-reach, reach + 1) / (deviation * FINE_RATE))


def _blurred(values: Array, places: NDArray[np.floating]) -> Array:
    """Values blurred with a Gaussian that is sampled at ``places``, in standard deviations; the ends are held."""
    kernel = np.exp(-0.5 * places**2)
    padded = np.pad(values, len(places) // 2, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


# From phonemes to mouth shapes: what the rig aims at while each sound of English is spoken.


@dataclass(frozen=True)
class Viseme:
    """A mouth shape."""

    name: str  # Short upper-case name
    targets: dict[str, float]  # Rig weights aimed at; controls not named aim at 0
    # How much the sound's shape dominates its neighbours (Cohen and Massaro's magnitude of dominance); weak
    # sounds take the shape of the sounds next to them
    strength: float = 1.0
    reach: float = 1.0  # How far its influence spreads in time, as a factor
    closes: bool = False  # Whether the lips meet
    firm: tuple[str, ...] = ()  # Controls on which it dominates fully, at any `strength`


_ALL = (
    Viseme("SIL", {}, strength=1.1, reach=0.9),
    Viseme(
        "PP",
        {"jaw_open": 0.16, "lip_press": 0.55, "cheek_puff": 0.25, "chin_raise": 0.1},
        0.6,
        0.8,
        True,
        ("lip_press",),
    ),
    Viseme("MM", {"jaw_open": 0.16, "lip_press": 0.4, "chin_raise": 0.1}, 0.6, 0.8, True, ("lip_press",)),
    Viseme(
        "FF",
        {"jaw_open": 0.14, "lower_lip_tuck": 1.0, "upper_lip_raise": 0.42, "nose_wrinkle": 0.1},
        1.2,
        0.7,
        firm=("lower_lip_tuck", "upper_lip_raise", "jaw_open"),
    ),
    Viseme("TH", {"jaw_open": 0.28, "lower_lip_drop": 0.25, "upper_lip_raise": 0.15}, 0.7, 0.8),
    Viseme("DD", {"jaw_open": 0.22, "stretch": 0.12, "lower_lip_drop": 0.2}, 0.55, 0.7),
    Viseme("SS", {"jaw_open": 0.12, "stretch": 0.3, "lower_lip_drop": 0.45, "upper_lip_raise": 0.25}, 0.9, 0.8),
    Viseme("CH", {"jaw_open": 0.14, "funnel": 0.8, "pucker": 0.2, "lower_lip_drop": 0.2}, 1.0, 1.0),
    Viseme("KK", {"jaw_open": 0.32}, 0.35, 0.8),
    Viseme("RR", {"jaw_open": 0.22, "funnel": 0.35, "pucker": 0.3}, 0.6, 1.1),
    Viseme("LL", {"jaw_open": 0.34, "upper_lip_raise": 0.1}, 0.6, 0.8),
    Viseme("WW", {"jaw_open": 0.14, "pucker": 1.0, "funnel": 0.15}, 1.2, 1.1),
    Viseme("YY", {"jaw_open": 0.16, "stretch": 0.45}, 0.7, 0.9),
    Viseme("HH", {"jaw_open": 0.35}, 0.2, 0.7),
    Viseme("AA", {"jaw_open": 1.0, "lower_lip_drop": 0.3, "upper_lip_raise": 0.15}, 1.2, 1.0),
    Viseme("AE", {"jaw_open": 0.85, "stretch": 0.4, "upper_lip_raise": 0.25, "lower_lip_drop": 0.35}, 1.1, 1.0),
    Viseme("AH", {"jaw_open": 0.58, "lower_lip_drop": 0.2, "upper_lip_raise": 0.1}, 0.9, 1.0),
    Viseme("UX", {"jaw_open": 0.36, "lower_lip_drop": 0.1}, 0.4, 0.9),
    Viseme("EH", {"jaw_open": 0.62, "stretch": 0.42, "upper_lip_raise": 0.15, "lower_lip_drop": 0.3}, 1.0, 1.0),
    Viseme("ER", {"jaw_open": 0.32, "funnel": 0.45, "pucker": 0.15, "lower_lip_drop": 0.15}, 0.9, 1.0),
    Viseme("IH", {"jaw_open": 0.36, "stretch": 0.42, "lower_lip_drop": 0.2}, 0.75, 0.9),
    Viseme(
        "IY",
        {"jaw_open": 0.24, "stretch": 0.95, "corner_up": 0.2, "lower_lip_drop": 0.3, "upper_lip_raise": 0.1},
        1.0,
        1.0,
    ),
    Viseme("OH", {"jaw_open": 0.68, "funnel": 0.6, "pucker": 0.4}, 1.1, 1.1),
    Viseme("UH", {"jaw_open": 0.34, "pucker": 0.65, "funnel": 0.2}, 0.9, 1.1),
    Viseme("UW", {"jaw_open": 0.14, "pucker": 1.1, "funnel": 0.12}, 1.1, 1.2),
)
VISEMES = {viseme.name: viseme for viseme in _ALL}

_SOUNDS = {
    "PP": "pb", "MM": "m", "FF": "fv", "TH": "θð", "DD": "tdnɾ", "SS": "sz", "CH": "ʃʒ", "KK": "kɡgŋxʔ",
    "RR": "ɹr", "LL": "lɫ", "WW": "wʍ", "YY": "j", "HH": "h", "AA": "ɑa", "AE": "æ", "AH": "ʌ", "UX": "ɐə",
    "ER": "ɚɜɝ", "EH": "ɛe", "IH": "ɪᵻ", "IY": "i", "OH": "ɔoɒø", "UH": "ʊɵ", "UW": "uy",
}  # fmt: skip
_VISEME_OF = {sound: name for name, sounds in _SOUNDS.items() for sound in sounds}
_MARKS = "ˈˌːˑ̩̃ʲ̯̆ "


def visemes_of(ipa: str) -> tuple[str, ...]:
    """The names of a phoneme's mouth shapes in order: a diphthong or an affricate has several.

    ``("SIL",)`` stands for a pause, ``("UX",)`` for a sound that is not known.
    """
    sounds = [letter for letter in ipa if letter not in _MARKS]
    if not sounds:
        return ("SIL",)
    if "".join(sounds) in ("tʃ", "dʒ"):
        return ("CH",)
    names: list[str] = []
    for sound in sounds:
        name = _VISEME_OF.get(sound)
        if name and (not names or names[-1] != name):
            names.append(name)
    return tuple(names) or ("UX",)


# Coarticulation: mouth shapes flow into one another by overlapping dominance functions.
#
# After Cohen and Massaro, "Modeling coarticulation in synthetic visual speech" (1993): each segment has, for
# each control, a target and a dominance that falls off on both sides of it, and the control at a time is the
# mean of the targets weighted by their dominance then. Two things differ: the fall-off has a rounded top
# (their |t| becomes sqrt(t^2 + e^2)), so that trajectories have no corners, and the meeting of the lips has a
# channel of its own that a neighbouring vowel cannot hold open, because a b with open lips is no b.

_ROUND_TOP = 0.018
# Seconds in which dominance falls to 1/e, before and after a segment. Rounding is prepared early.
_FALL_BEFORE = {"pucker": 0.085, "funnel": 0.080, "stretch": 0.070, "lower_lip_tuck": 0.035, "lip_press": 0.035}
_FALL_AFTER = {"pucker": 0.070, "funnel": 0.065, "stretch": 0.060, "lower_lip_tuck": 0.035, "lip_press": 0.035}
_DEFAULT_FALL = 0.052
_FIRM_STRENGTH = 3.0
_SURELY_SHUT = 0.028
UNHURRIED = 0.11
# Shortest and longest time in seconds that the lips take to meet and to part.
_CLOSING, _OPENING = (0.050, 0.070), (0.060, 0.085)


@dataclass(frozen=True)
class Segment:
    """A stretch of speech with one mouth shape."""

    start: float  # Where it starts, in seconds
    end: float  # Where it ends, in seconds
    viseme: Viseme  # Its mouth shape
    stress: float  # How much of its target is reached, about 1


def segments_of(phonemes: tuple[SpokenPhoneme, ...]) -> list[Segment]:
    """Split phonemes into segments of one mouth shape each; a diphthong spends more time on its first."""
    segments: list[Segment] = []
    for phoneme in phonemes:
        names = visemes_of(phoneme.ipa)
        stress = 1.08 if "ˈ" in phoneme.ipa else 0.95  # the mark of primary stress
        shares = np.cumsum([0.0, *([0.6] + [0.4 / (len(names) - 1)] * (len(names) - 1) if len(names) > 1 else [1.0])])
        length = phoneme.end - phoneme.start
        # A short sound does not reach its target (Lindblom's undershoot, 1963): jaws have no time for it.
        stress *= float(np.clip(0.5 + 0.5 * length / UNHURRIED, 0.5, 1.0))
        segments += [
            Segment(phoneme.start + float(a) * length, phoneme.start + float(b) * length, VISEMES[name], stress)
            for name, a, b in zip(names, shares[:-1], shares[1:], strict=True)
        ]
    return segments


def articulate(segments: list[Segment], times: Array, *, spread: float = 1.0) -> Array:
    """Weights (n, controls) of `SPEECH_CONTROLS` at times (n,) in seconds: the blended targets of the segments.

    ``spread`` is how widely sounds influence each other; below 1 is crisp, above 1 is slack.
    """
    start = np.array([s.start for s in segments])
    end = np.array([s.end for s in segments])
    # A target holds in the segment's middle part and fades from there towards both borders.
    core = 0.25 * (end - start)
    before = np.maximum(start + core - times[:, None], 0.0)
    after = np.maximum(times[:, None] - end + core, 0.0)
    result = np.zeros((len(times), len(SPEECH_CONTROLS)))
    reach = spread * np.array([s.viseme.reach for s in segments])
    for column, control in enumerate(SPEECH_CONTROLS):
        fall_before = reach * _FALL_BEFORE.get(control, _DEFAULT_FALL)
        fall_after = reach * _FALL_AFTER.get(control, _DEFAULT_FALL)
        strength = np.array([_FIRM_STRENGTH if control in s.viseme.firm else s.viseme.strength for s in segments])
        distance = rounded(before) / fall_before + rounded(after) / fall_after
        dominance = strength * np.exp(-distance)
        target = np.array([s.stress * s.viseme.targets.get(control, 0.0) for s in segments])
        result[:, column] = (dominance * target).sum(axis=1) / (dominance.sum(axis=1) + 1e-9)
    return result


def close_lips(segments: list[Segment], times: Array) -> Array:
    """How firmly the lips are shut (n,), 0 to 1: 1 from before the start to past the middle of every p, b and m."""
    return shut_lips([(segment.start, segment.end, segment.viseme.closes) for segment in segments], times)


def shut_lips(stretches: Sequence[tuple[float, float, bool]], times: Array) -> Array:
    """How firmly the lips are shut (n,), by start and end of each sound in seconds and whether it closes the lips."""
    apart = np.ones_like(times)
    lengths = [end - start for start, end, _ in stretches]
    for index, ((start, _, closes), length) in enumerate(zip(stretches, lengths, strict=True)):
        if closes:
            # The lips must be shut in the frame nearest to the middle, which is up to half a frame away.
            middle = start + 0.5 * length
            first = min(start + min(0.15 * length, 0.012), middle - _SURELY_SHUT)
            last = max(start + 0.72 * length, middle + _SURELY_SHUT)
            # A short vowel between two closures needs time to open.
            closing = np.clip(0.55 * lengths[index - 1], *_CLOSING) if index > 0 else _CLOSING[1]
            opening = np.clip(0.55 * lengths[index + 1], *_OPENING) if index + 1 < len(lengths) else _OPENING[1]
            shut = rise(times, first - float(closing), first) * rise(times, last + float(opening), last)
            apart *= 1.0 - shut
    return np.asarray(1.0 - apart)


def rounded(distance: Array) -> Array:
    """Distance with a rounded start, so that its slope is continuous where a segment's core begins."""
    return np.asarray(np.sqrt(distance**2 + _ROUND_TOP**2) - _ROUND_TOP)


# Loudness and melody of a waveform, which the brows follow.

_HOP, _WINDOW = 0.010, 0.040
_LOWEST_PITCH, _HIGHEST_PITCH = 65.0, 420.0


@dataclass(frozen=True)
class ProsodyContours:
    """Slow contours of a clip, each about -1 to 2 with mean 0 over its voiced part."""

    times: Array  # Middles of the analysis windows, in seconds, shape (n,)
    loudness: Array  # Level relative to the clip's mean, in its standard deviations, shape (n,)
    # Logarithm of the fundamental frequency relative to the clip's mean, in its standard deviations, shape (n,)
    pitch: Array


def analyse(samples: NDArray[np.float32], rate: int) -> ProsodyContours:
    """Contours of a mono waveform (samples,), smoothed over about a syllable; ``rate`` is in samples a second."""
    hop, window = int(_HOP * rate), int(_WINDOW * rate)
    padded = np.pad(np.asarray(samples, dtype=np.float64), window)
    starts = np.arange(0, padded.size - window, hop)
    frames = padded[starts[:, None] + np.arange(window)]
    power = (frames**2).mean(axis=1)
    level = 10.0 * np.log10(power + 1e-7)
    voiced, pitch = _pitch(frames - frames.mean(axis=1, keepdims=True), rate)
    voiced &= level > level.max() - 30.0
    times = (starts - window + 0.5 * window) / rate
    if voiced.sum() < 3:
        return ProsodyContours(times, np.zeros_like(times), np.zeros_like(times))
    melody = np.interp(times, times[voiced], np.log(pitch[voiced]))
    loud = np.maximum(level, level[voiced].mean() - 20.0)
    # The melody fades out where there has been no voice for a while.
    gate = np.clip(1.6 * _blur(voiced.astype(np.float64), 0.12), 0.0, 1.0)
    return ProsodyContours(times, _contour(loud, voiced, 0.08), _contour(melody, voiced, 0.09) * gate)


def _pitch(frames: Array, rate: int) -> tuple[NDArray[np.bool_], Array]:
    """Fundamental frequency by the highest peak of the autocorrelation, and whether there is one."""
    size = 2 * frames.shape[1]
    spectrum = np.abs(np.fft.rfft(frames * np.hanning(frames.shape[1]), size)) ** 2
    correlation = np.fft.irfft(spectrum)[:, : frames.shape[1]]
    low, high = int(rate / _HIGHEST_PITCH), int(rate / _LOWEST_PITCH)
    lag = low + correlation[:, low:high].argmax(axis=1)
    peak = correlation[np.arange(len(lag)), lag]
    return peak > 0.3 * (correlation[:, 0] + 1e-9), rate / lag


def _contour(values: Array, voiced: NDArray[np.bool_], deviation: float) -> Array:
    """Standardise over the voiced part and smooth."""
    mean, spread = values[voiced].mean(), values[voiced].std() + 1e-6
    return _blur(np.clip((values - mean) / spread, -2.5, 2.5), deviation)


def _blur(values: Array, deviation: float) -> Array:
    reach = int(3 * deviation / _HOP)
    return _blurred(values, np.arange(-reach, reach + 1) * _HOP / deviation)
