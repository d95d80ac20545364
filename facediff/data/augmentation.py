"""Augmentations of training speech: other voices, rooms, microphones and noise, while the motion stays the same.

A model that is trained on few voices, or on a speech synthesiser, overfits to them. The augmentations change properties
that facial motion does not depend on: pitch and formants, loudness, the spectrum of a microphone or a telephone, the
room, noise and hum. Two change the motion as well: :class:`Speed`, and :class:`Pauses`, which teaches that silence
means a mouth at rest, however loud the noise.

They are registered under the kind ``augmentation`` and chosen by name with their options::

    --data.augmentations="[voice:semitones=5, room, noise:least=0, pauses]" --data.augmented_share=0.5

Everything is NumPy and SciPy on whole clips; docs/voices.md lists each with its options.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, cast

import numpy as np
import numpy.typing as npt

from facediff.registry import augmentation
from facediff.speech.audio import fit_length
from facediff.speech.pitch import SIZE, Wave, shifted, signal, spectra, stretched
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import checks_arguments
from facediff.utils.numerics import smooth_step
from facediff.utils.ranges import Range

Share = Annotated[float, Range(0, 1)]
Decibels = Annotated[float, Range(0, 60)]
Ratio = Annotated[float, Range(0, 150)]
"""A ratio of speech to noise in decibels."""

LIFTER = 30
"""Coefficients of the cepstrum that make the spectral envelope. Harmonics of voices below 530 Hz lie above."""

PIECE = 10 * SAMPLE_RATE
"""Samples that are encoded together."""

CLOSING, OPENING = 0.2, 0.16
"""Seconds that a mouth takes to come to rest after speech, and to open before it."""


@dataclass(frozen=True)
class Example:
    """A training clip, or a window of one.

    Attributes:
        speech: (S,) at 16 kHz.
        motion: (T, V, 3) offsets from the template, over the same time.
        frame_rate: of the motion.
        rest: (V, 3) the speaker's face in silence.
        mouth: (V,) which vertices speech moves, 0 to 1; the others keep their motion in a pause.
    """

    speech: Wave
    motion: npt.NDArray[np.float32]
    frame_rate: float
    rest: npt.NDArray[np.float32]
    mouth: npt.NDArray[np.float32]


class Augmentation(ABC):
    """One change that is made to a share of the clips.

    Args:
        share: of the clips that are augmented at all.
    """

    moves: bool = False
    """Whether it changes the number of frames, so that windows and pairs of clips no longer fit the corpus's frames."""

    def __init__(self, *, share: Share = 0.5) -> None:
        self.share = share

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        """Let every constructor refuse options that are out of range."""
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            cls.__init__ = checks_arguments(cls.__init__, "data.augmentations")  # type: ignore[method-assign]

    @abstractmethod
    def __call__(self, example: Example, random: np.random.Generator) -> Example:
        """The changed clip; its speech has as many samples as its frames last."""


class SpeechAugmentation(Augmentation):
    """An augmentation that changes the speech alone."""

    def __call__(self, example: Example, random: np.random.Generator) -> Example:
        """The clip with other speech of the same length."""
        if not example.speech.any():
            return example
        changed = fit_length(np.asarray(self.change(example.speech, random), np.float32), len(example.speech))
        return replace(example, speech=changed)

    @abstractmethod
    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Changed speech (S',), in time with ``speech``; it is cut or padded to the same length afterwards."""


class Augmenter:
    """Applies a list of augmentations to a share of the clips.

    Args:
        augmentations: in the order in which they are applied.
        share: of the clips that are augmented; the others stay as they are, so that clean speech is learnt too.
    """

    def __init__(self, augmentations: Sequence[Augmentation], share: float = 1.0) -> None:
        self.augmentations = list(augmentations)
        self.share = share

    @property
    def speech_only(self) -> bool:
        """Whether all augmentations leave the motion as it is, in whatever form it comes."""
        return all(isinstance(change, SpeechAugmentation) for change in self.augmentations)

    def change_speech(self, speech: Wave, seed: int) -> npt.NDArray[np.float32]:
        """Speech (S,) as augmentations of speech alone change it, with a motion or without one."""
        nothing = np.zeros((1, 0), np.float32)
        return self(Example(speech, nothing, 1.0, nothing[0], nothing[0]), seed).speech

    def __call__(self, example: Example, seed: int) -> Example:
        """The clip as these augmentations change it; the same seed changes it in the same way."""
        random = np.random.default_rng(seed)
        if random.random() >= self.share:
            return example
        for change in self.augmentations:
            if random.random() < change.share:
                example = change(example, random)
        peak = float(np.abs(example.speech).max(initial=0))
        return replace(example, speech=example.speech / peak) if peak > 1 else example


def read_augmentations(texts: Sequence[str]) -> list[Augmentation]:
    """Augmentations from ``NAME:option=value,option=value``.

    Example:
        >>> [type(change).__name__ for change in read_augmentations(["voice:semitones=3", "room"])]
        ['Voice', 'Room']
    """
    pairs = (augmentation.read(text) for text in texts)
    return [cast(Augmentation, augmentation.get(name)(**options)) for name, options in pairs]


# Voices.


@augmentation.register("voice")
class Voice(SpeechAugmentation):
    """Another speaker's pitch and formants, each by a random amount or both by the same.

    The pitch is shifted by overlapping grains of the waveform and resampling, the spectral envelope is warped along
    frequency (vocal-tract length), so that the two are independent; the timing of sounds stays. A shorter vocal tract
    mostly has a higher voice, and a warped envelope sounds less like a person than resampled speech: ``together``
    leaves the warping out.

    Args:
        share: of the augmented clips.
        semitones: largest change of the pitch, up or down.
        formants: largest change of the formants, up or down, as a share of their frequency.
        together: share of the changes in which the formants move with the pitch, by up to ``semitones``.
    """

    def __init__(
        self,
        *,
        share: Share = 0.7,
        semitones: Annotated[float, Range(0, 24)] = 5.0,
        formants: Annotated[float, Range(0, 0.6)] = 0.2,
        together: Share = 0.0,
    ) -> None:
        super().__init__(share=share)
        self.semitones, self.formants, self.together = semitones, formants, together

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Shift pitch and formants."""
        if self.together and random.random() < self.together:
            return shifted(speech, 2.0 ** (random.uniform(-self.semitones, self.semitones) / 12))
        pitch = 2.0 ** (random.uniform(-self.semitones, self.semitones) / 12)
        warp = (1 + self.formants) ** random.uniform(-1, 1)
        if abs(pitch - 1) > 0.02:
            speech = shifted(speech, pitch)
        else:
            pitch = 1.0
        # The shift has moved the formants with the pitch.
        return warped(speech, warp / pitch)


@augmentation.register("speed")
class Speed(Augmentation):
    """Faster or slower speech of the same pitch, and the motion with it.

    Args:
        share: of the augmented clips.
        ratio: largest change of the speed, faster or slower, as a share.
    """

    moves = True

    def __init__(self, *, share: Share = 0.3, ratio: Annotated[float, Range(0, 0.5)] = 0.15) -> None:
        super().__init__(share=share)
        self.ratio = ratio

    def __call__(self, example: Example, random: np.random.Generator) -> Example:
        """The clip with another number of frames."""
        before = len(example.motion)
        after = max(2, round(before / (1 + self.ratio) ** random.uniform(-1, 1)))
        if before < 2 or after == before:
            return example
        positions = (np.arange(after) + 0.5) * (before / after) - 0.5
        low = np.clip(np.floor(positions).astype(int), 0, before - 2)
        share = np.clip(positions - low, 0.0, 1.0).astype(np.float32)[:, None, None]
        motion = (1 - share) * example.motion[low] + share * example.motion[low + 1]
        length = round(after * SAMPLE_RATE / example.frame_rate)
        speech = stretched(example.speech, length / max(1, len(example.speech)))
        return replace(example, motion=motion, speech=fit_length(speech, length))


# Level and spectrum.


@augmentation.register("loudness")
class Loudness(SpeechAugmentation):
    """Loudness that drifts, as if the speaker turned away from the microphone.

    Args:
        share: of the augmented clips.
        decibels: most by which it differs from the mean, in either direction.
    """

    def __init__(self, *, share: Share = 0.5, decibels: Decibels = 6.0) -> None:
        super().__init__(share=share)
        self.decibels = decibels

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Multiply by a smooth gain."""
        knots = max(2, 2 + round(1.5 * len(speech) / SAMPLE_RATE))
        gains = random.uniform(-self.decibels, self.decibels, knots)
        over = np.interp(np.arange(len(speech)), np.linspace(0, len(speech), knots), gains)
        return cast(Wave, speech * 10 ** (over / 20))


@augmentation.register("tilt")
class Tilt(SpeechAugmentation):
    """Another balance of low and high frequencies: a linear tilt, and a smooth curve over it.

    Args:
        share: of the augmented clips.
        decibels: most by which an octave differs from the one below it.
        curve: largest gain of the curve in either direction.
    """

    def __init__(self, *, share: Share = 0.5, decibels: Decibels = 4.0, curve: Decibels = 6.0) -> None:
        super().__init__(share=share)
        self.decibels, self.curve = decibels, curve

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Filter without delay."""
        octaves = np.linspace(-3.0, 3.0, 7)  # from 125 Hz to 8 kHz
        gains = random.uniform(-self.decibels, self.decibels) * octaves + random.uniform(-1, 1, 7) * self.curve
        return filtered(
            speech, lambda hertz: 10 ** (np.interp(np.log2(np.maximum(hertz, 1) / 1000), octaves, gains) / 20)
        )


@augmentation.register("band")
class Band(SpeechAugmentation):
    """A limited band of the spectrum, as of small microphones and telephones.

    Args:
        share: of the augmented clips.
        low: everything below a random frequency is lost; the highest it may be, in Hz.
        high: everything above a random frequency is lost; the lowest it may be, in Hz.
    """

    def __init__(
        self,
        *,
        share: Share = 0.3,
        low: Annotated[float, Range(0, 2000)] = 300.0,
        high: Annotated[float, Range(500, 8000)] = 3000.0,
    ) -> None:
        super().__init__(share=share)
        self.low, self.high = low, high

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Filter by edges that fall by 24 dB an octave."""
        low = random.uniform(0, self.low)
        high = random.uniform(min(self.high, 7900), 7900)

        def gain(hertz: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
            rise = 1 / np.sqrt(1 + (low / np.maximum(hertz, 1)) ** 8)
            return cast(npt.NDArray[np.floating], rise / np.sqrt(1 + (hertz / high) ** 8))

        return filtered(speech, gain)


@augmentation.register("codec")
class Codec(SpeechAugmentation):
    """Lossy compression: a telephone's 8 bits at 8 kHz, or Vorbis at a low rate.

    Args:
        share: of the augmented clips.
        kind: ``telephone`` (mu-law, ITU-T G.711), ``vorbis``, or ``any`` of them.
    """

    def __init__(self, *, share: Share = 0.15, kind: Literal["any", "telephone", "vorbis"] = "any") -> None:
        super().__init__(share=share)
        self.kind = kind

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Encode and decode."""
        kind = ("telephone", "vorbis")[int(random.integers(2))] if self.kind == "any" else self.kind
        return telephone(speech) if kind == "telephone" else vorbis(speech, float(random.uniform(0.5, 1.0)))


# Rooms and noise.


@augmentation.register("room")
class Room(SpeechAugmentation):
    """A room: the direct sound, and noise that decays exponentially after it (Moorer 1979).

    Args:
        share: of the augmented clips.
        seconds: longest time in which the room's sound falls by 60 dB.
        direct: least ratio of direct to reverberant sound, in decibels.
    """

    def __init__(
        self,
        *,
        share: Share = 0.4,
        seconds: Annotated[float, Range(0.05, 5)] = 0.6,
        direct: Annotated[float, Range(-20, 60)] = 0.0,
    ) -> None:
        super().__init__(share=share)
        self.seconds, self.direct = seconds, direct

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Convolve with a random impulse response without delay: the direct sound comes at time 0."""
        from scipy.signal import fftconvolve

        decay = random.uniform(0.08, max(0.08, self.seconds))
        times = np.arange(round(decay * SAMPLE_RATE)) / SAMPLE_RATE
        tail = random.standard_normal(len(times)) * 10 ** (-3 * times / decay)
        tail[: round(random.uniform(0.001, 0.02) * SAMPLE_RATE)] = 0
        # Walls swallow high frequencies first.
        smooth = random.uniform(0, 0.7)
        tail = (1 - smooth) * tail + smooth * np.convolve(tail, [0.5, 0.5], "same")
        ratio = random.uniform(self.direct, self.direct + 15)
        tail *= 10 ** (-ratio / 20) / max(float(np.sqrt((tail**2).sum())), 1e-9)
        tail[0] = 1
        return cast(Wave, fftconvolve(speech, tail.astype(np.float32))[: len(speech)])


class Background(SpeechAugmentation):
    """A sound that is added to the speech, at a random ratio of the two.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to the sound, in decibels.
        most: largest ratio.
    """

    def __init__(self, *, share: Share, least: Ratio, most: Ratio) -> None:
        super().__init__(share=share)
        self.least, self.most = least, max(least, most)

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Add the sound."""
        sound = self.sound(speech, random)
        return speech + sound * gain_for(speech, sound, random.uniform(self.least, self.most))

    @abstractmethod
    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """The sound (S,) that is added to speech (S,), of any level."""


@augmentation.register("noise")
class Noise(Background):
    """Noise of a random colour, from white to brown, and of a level that may change slowly.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to noise, in decibels.
        most: largest ratio.
    """

    def __init__(self, *, share: Share = 0.6, least: Ratio = 5.0, most: Ratio = 50.0) -> None:
        super().__init__(share=share, least=least, most=most)

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Noise of one colour."""
        exponent = random.uniform(-1.0, 0.2)
        return filtered(random.standard_normal(len(speech)), lambda hertz: np.maximum(hertz / 500, 0.08) ** exponent)


@augmentation.register("hum")
class Hum(Background):
    """Mains hum: 50 or 60 Hz with its harmonics.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to hum, in decibels.
        most: largest ratio.
    """

    def __init__(self, *, share: Share = 0.2, least: Ratio = 10.0, most: Ratio = 50.0) -> None:
        super().__init__(share=share, least=least, most=most)

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Hum of one frequency."""
        base = (50.0, 60.0)[int(random.integers(2))] * random.uniform(0.995, 1.005)
        orders = np.arange(1, 13)
        sizes = random.uniform(0.2, 1.0, 12) * orders ** -random.uniform(0.5, 2.0)
        phase = 2 * np.pi * (base / SAMPLE_RATE) * np.arange(len(speech))
        hum = sum(
            size * np.sin(order * phase + shift)
            for order, size, shift in zip(orders, sizes, random.uniform(0, 2 * np.pi, 12), strict=True)
        )
        return np.asarray(hum)


@augmentation.register("babble")
class Babble(Background):
    """Other people who talk in the background.

    They are copies of the clip itself from random places, faster or slower and half of them backwards, so that their
    words do not fit the motion.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to babble, in decibels.
        most: largest ratio.
        voices: most people.
    """

    def __init__(
        self,
        *,
        share: Share = 0.25,
        least: Ratio = 6.0,
        most: Ratio = 30.0,
        voices: Annotated[int, Range(1, 20)] = 8,
    ) -> None:
        super().__init__(share=share, least=least, most=most)
        self.voices = voices

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Babble of some people."""
        import soxr

        babble = np.zeros(len(speech))
        for _ in range(int(random.integers(1, self.voices + 1))):
            copy = soxr.resample(speech, 1000 * random.uniform(0.8, 1.25), 1000, quality="LQ")
            # As often as it takes: a shorter copy would leave a part of the clip without this person.
            copy = np.resize(copy[::-1] if random.random() < 0.5 else copy, len(speech))
            babble += np.roll(copy, int(random.integers(len(speech)))) * random.uniform(0.3, 1.0)
        return babble


@augmentation.register("music")
class Music(Background):
    """Music in the background: chords of decaying partials, and often a drum.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to music, in decibels.
        most: largest ratio.
    """

    def __init__(self, *, share: Share = 0.25, least: Ratio = 6.0, most: Ratio = 30.0) -> None:
        super().__init__(share=share, least=least, most=most)

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Music as long as the speech."""
        return played(len(speech), random)


@augmentation.register("pauses")
class Pauses(Augmentation):
    """Silence for a while, or in the whole clip, during which the mouth comes to rest.

    Put it before rooms, noise and hum, so that these go on in the pause. The rest of the face keeps its motion.

    Args:
        share: of the augmented clips.
        seconds: longest pause.
        silent: share of the changed clips that become silent as a whole, but for noise where ``noise`` follows.
    """

    def __init__(
        self, *, share: Share = 0.4, seconds: Annotated[float, Range(0.3, 60)] = 1.2, silent: Share = 0.15
    ) -> None:
        super().__init__(share=share)
        self.seconds, self.silent = seconds, silent

    def __call__(self, example: Example, random: np.random.Generator) -> Example:
        """The clip with a pause."""
        frames, rate = len(example.motion), example.frame_rate
        silent_clip = random.random() < self.silent
        length = min(random.uniform(0.3, self.seconds), 0.7 * frames / rate)
        # Often at either end of the clip: where speech begins out of silence is where onsets are learnt.
        start = float(np.clip(random.uniform(-0.3, 1.3), 0, 1)) * (frames / rate - length)
        first, last = (-1e9, 1e9) if silent_clip else (start, start + length)
        if start <= 0:
            first = -1e9
        elif start >= frames / rate - length:
            last = 1e9
        middles = (np.arange(frames) + 0.5) / rate
        closing, opening = smooth_step((middles - first) / CLOSING), smooth_step((last - middles) / OPENING)
        at_rest = np.minimum(closing, opening).astype(np.float32)
        weight = at_rest[:, None, None] * example.mouth[None, :, None]
        motion = example.motion + weight * (example.rest - example.motion)
        times = np.arange(len(example.speech)) / SAMPLE_RATE
        gain = 1 - np.clip(np.minimum((times - first) / 0.02, (last - times) / 0.02), 0, 1)
        # Faint and not zero: `noise` and `hum` scale with the power of the speech and would vanish otherwise.
        faint = 10 ** (-random.uniform(50, 90) / 20) * random.standard_normal(len(times))
        speech = example.speech * gain + faint * float(np.abs(example.speech).max(initial=0))
        return replace(example, motion=motion, speech=speech.astype(np.float32))


# Signal processing.


def gain_for(speech: npt.NDArray[np.floating], noise: npt.NDArray[np.floating], ratio: float) -> float:
    """The factor on noise for a ratio of speech to noise in decibels."""
    power = float(np.mean(np.square(noise, dtype=np.float64)))
    return float(np.sqrt(np.mean(np.square(speech, dtype=np.float64)) / max(power, 1e-20))) * 10 ** (-ratio / 20)


SCALE = (0, 2, 4, 5, 7, 9, 11)
"""Semitones of a major scale."""

PERIOD = 512
"""Samples in which a period of a musical tone is stored."""


def played(length: int, random: np.random.Generator) -> npt.NDArray[np.floating]:
    """Music (length,) of a random key, tempo and sound: a chord or a single note on every beat, and often a drum."""
    music = np.zeros(length)
    key = random.uniform(90, 240)
    beat = round(random.uniform(0.15, 0.7) * SAMPLE_RATE)
    rise = round(random.uniform(0.003, 0.08) * SAMPLE_RATE)
    fading = random.uniform(0.3, 2.0)
    drum = max(0.0, random.uniform(-0.5, 1.0))
    orders = np.arange(1, 9)
    sizes = random.uniform(0.2, 1.0, 8) * orders ** -random.uniform(0.6, 2.5)
    turns = np.arange(PERIOD)[:, None] / PERIOD * orders + random.random(8)
    cycle = (sizes * np.sin(2 * np.pi * turns)).sum(1)
    ringing = round(min(3 * fading, 2.5) * SAMPLE_RATE)
    for start in range(-int(random.integers(beat)), length, beat):
        stop = min(length, max(0, start + ringing))
        times = (np.arange(max(start, 0), stop) - start) / SAMPLE_RATE
        shape = np.exp(-times / fading) * np.minimum(times * SAMPLE_RATE / rise, 1)
        degree = int(random.integers(14))
        for third in range(0, 2 * int(random.integers(1, 4)), 2):
            octaves, step = divmod(degree + third, len(SCALE))
            pitch = key * 2 ** (octaves + SCALE[step] / 12)
            music[max(start, 0) : stop] += shape * cycle[(pitch * PERIOD * times).astype(int) % PERIOD]
        if drum:
            music[max(start, 0) : stop] += drum * random.standard_normal(len(times)) * np.exp(-times / 0.04)
    return music


def filtered(speech: npt.NDArray[np.floating], gain: Any) -> npt.NDArray[np.floating]:  # noqa: ANN401
    """Speech (S,) multiplied by a gain, a function of the frequencies (F,) in Hz, without delay."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(len(speech) + SIZE, real=True)
    spectrum = rfft(speech, size) * gain(np.arange(size // 2 + 1) * (SAMPLE_RATE / size))
    return cast(npt.NDArray[np.floating], irfft(spectrum, size)[: len(speech)])


def warped(speech: Wave, ratio: float) -> npt.NDArray[np.floating]:
    """Speech (S,) with its spectral envelope scaled by ``ratio`` along frequency, at the same pitch."""
    from scipy.fft import irfft, rfft

    if abs(ratio - 1) < 0.01:
        return speech
    spectrum = spectra(speech)
    logs = np.log(np.abs(spectrum) + 1e-5)
    cepstrum = irfft(logs, SIZE, axis=1)
    cepstrum[:, LIFTER : SIZE - LIFTER + 1] = 0
    envelope = rfft(cepstrum, axis=1).real
    positions = np.minimum(np.arange(SIZE // 2 + 1) / ratio, SIZE // 2 - 1e-6)
    low = positions.astype(int)
    share = (positions - low).astype(np.float32)
    moved = (1 - share) * envelope[:, low] + share * envelope[:, low + 1]
    return signal(spectrum * np.exp(np.clip(moved - envelope, -4, 4)), len(speech))


def telephone(speech: Wave) -> npt.NDArray[np.floating]:
    """Speech through 8 bits of mu-law at 8 kHz (ITU-T G.711)."""
    import soxr

    narrow = soxr.resample(speech, SAMPLE_RATE, 8000, quality="LQ")
    scale = max(float(np.abs(narrow).max(initial=0)), 1e-6)
    compressed = np.sign(narrow) * np.log1p(255 * np.abs(narrow) / scale) / np.log(256)
    rounded = np.round(compressed * 127) / 127
    decoded = np.sign(rounded) * (np.exp(np.abs(rounded) * np.log(256)) - 1) / 255 * scale
    return cast(Wave, soxr.resample(decoded.astype(np.float32), 8000, SAMPLE_RATE, quality="LQ"))


def vorbis(speech: Wave, compression: float) -> npt.NDArray[np.floating]:
    """Speech through Vorbis; compression 0 is best, 1 is smallest."""
    import soundfile

    scale = max(1.0, float(np.abs(speech).max(initial=0)))
    with io.BytesIO() as file:
        form = {"format": "OGG", "subtype": "VORBIS", "compression_level": compression}
        with soundfile.SoundFile(file, "w", SAMPLE_RATE, 1, **form) as stream:
            # Piece by piece: libsndfile lays all that it is given onto the stack, which two minutes overflow.
            for first in range(0, len(speech), PIECE):
                stream.write(speech[first : first + PIECE] / scale)
        file.seek(0)
        return cast(Wave, soundfile.read(file, dtype="float32")[0] * scale)
