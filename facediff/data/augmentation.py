"""Augmentations of training speech: other voices, rooms, microphones and noise, while the motion stays the same.

A model that is trained on few voices, or on a speech synthesiser, overfits to them. The augmentations change properties
that facial motion does not depend on: pitch and formants, loudness, the spectrum of a microphone or a telephone, the
room, noise and hum.

They are registered under the kind ``augmentation`` and chosen by name with their options::

    --data.augmentations="[voice:semitones=5, room, noise:least=0]" --data.augmented_share=0.5

Everything is NumPy and SciPy on whole clips; docs/voices.md lists each with its options.
"""

from __future__ import annotations

import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, cast

import numpy as np
import numpy.typing as npt

from facediff.registry import augmentation
from facediff.speech.audio import fit_length
from facediff.speech.pitch import SIZE, Wave, shifted, signal, spectra
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Range

Share = Annotated[float, Range(0, 1)]
Decibels = Annotated[float, Range(0, 60)]
Ratio = Annotated[float, Range(0, 150)]
"""A ratio of speech to noise in decibels."""

LIFTER = 30
"""Coefficients of the cepstrum that make the spectral envelope. Harmonics of voices below 530 Hz lie above."""

PIECE = 10 * SAMPLE_RATE
"""Samples that are encoded together."""


@dataclass(kw_only=True)
class Augmentation(ABC):
    """One change of speech that is made to a share of the clips.

    Args:
        share: of the clips that are augmented at all.
    """

    share: Share = 0.5

    @abstractmethod
    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Changed speech (S',), in time with ``speech`` (S,) at 16 kHz; it is cut or padded to S afterwards."""


class Augmenter:
    """Applies a list of augmentations to a share of the clips.

    Args:
        augmentations: in the order in which they are applied.
        share: of the clips that are augmented; the others stay as they are, so that clean speech is learnt too.
    """

    def __init__(self, augmentations: Sequence[Augmentation], share: float = 1.0) -> None:
        self.augmentations = list(augmentations)
        self.share = share

    def __call__(self, speech: Wave, seed: int) -> Wave:
        """Speech (S,) as these augmentations change it; the same seed changes it in the same way."""
        random = np.random.default_rng(seed)
        if random.random() >= self.share:
            return speech
        for change in self.augmentations:
            if random.random() < change.share and speech.any():
                speech = fit_length(np.asarray(change.change(speech, random), np.float32), len(speech))
        peak = float(np.abs(speech).max(initial=0))
        return speech / peak if peak > 1 else speech


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
@dataclass(kw_only=True)
class Voice(Augmentation):
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

    share: Share = 0.7
    semitones: Annotated[float, Range(0, 24)] = 5.0
    formants: Annotated[float, Range(0, 0.6)] = 0.2
    together: Share = 0.0

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


# Level and spectrum.


@augmentation.register("loudness")
@dataclass(kw_only=True)
class Loudness(Augmentation):
    """Loudness that drifts, as if the speaker turned away from the microphone.

    Args:
        share: of the augmented clips.
        decibels: most by which it differs from the mean, in either direction.
    """

    share: Share = 0.5
    decibels: Decibels = 6.0

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Multiply by a smooth gain."""
        knots = max(2, 2 + round(1.5 * len(speech) / SAMPLE_RATE))
        gains = random.uniform(-self.decibels, self.decibels, knots)
        over = np.interp(np.arange(len(speech)), np.linspace(0, len(speech), knots), gains)
        return cast(Wave, speech * 10 ** (over / 20))


@augmentation.register("tilt")
@dataclass(kw_only=True)
class Tilt(Augmentation):
    """Another balance of low and high frequencies: a linear tilt, and a smooth curve over it.

    Args:
        share: of the augmented clips.
        decibels: most by which an octave differs from the one below it.
        curve: largest gain of the curve in either direction.
    """

    share: Share = 0.5
    decibels: Decibels = 4.0
    curve: Decibels = 6.0

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Filter without delay."""
        octaves = np.linspace(-3.0, 3.0, 7)  # from 125 Hz to 8 kHz
        gains = random.uniform(-self.decibels, self.decibels) * octaves + random.uniform(-1, 1, 7) * self.curve
        return filtered(
            speech, lambda hertz: 10 ** (np.interp(np.log2(np.maximum(hertz, 1) / 1000), octaves, gains) / 20)
        )


@augmentation.register("band")
@dataclass(kw_only=True)
class Band(Augmentation):
    """A limited band of the spectrum, as of small microphones and telephones.

    Args:
        share: of the augmented clips.
        low: everything below a random frequency is lost; the highest it may be, in Hz.
        high: everything above a random frequency is lost; the lowest it may be, in Hz.
    """

    share: Share = 0.3
    low: Annotated[float, Range(0, 2000)] = 300.0
    high: Annotated[float, Range(500, 8000)] = 3000.0

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Filter by edges that fall by 24 dB an octave."""
        low = random.uniform(0, self.low)
        high = random.uniform(min(self.high, 7900), 7900)

        def gain(hertz: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
            rise = 1 / np.sqrt(1 + (low / np.maximum(hertz, 1)) ** 8)
            return cast(npt.NDArray[np.floating], rise / np.sqrt(1 + (hertz / high) ** 8))

        return filtered(speech, gain)


@augmentation.register("codec")
@dataclass(kw_only=True)
class Codec(Augmentation):
    """Lossy compression: a telephone's 8 bits at 8 kHz, or Vorbis at a low rate.

    Args:
        share: of the augmented clips.
    """

    share: Share = 0.15

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Encode and decode."""
        return vorbis(speech, float(random.uniform(0.5, 1.0))) if random.integers(2) else telephone(speech)


# Rooms and noise.


@augmentation.register("room")
@dataclass(kw_only=True)
class Room(Augmentation):
    """A room: the direct sound, and noise that decays exponentially after it (Moorer 1979).

    Args:
        share: of the augmented clips.
        seconds: longest time in which the room's sound falls by 60 dB.
        direct: least ratio of direct to reverberant sound, in decibels.
    """

    share: Share = 0.4
    seconds: Annotated[float, Range(0.05, 5)] = 0.6
    direct: Annotated[float, Range(-20, 60)] = 0.0

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


@dataclass(kw_only=True)
class Background(Augmentation):
    """A sound that is added to the speech, at a random ratio of the two.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to the sound, in decibels.
        most: largest ratio.
    """

    share: Share
    least: Ratio
    most: Ratio

    def change(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Add the sound."""
        sound = self.sound(speech, random)
        return speech + sound * gain_for(speech, sound, random.uniform(self.least, max(self.least, self.most)))

    @abstractmethod
    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """The sound (S,) that is added to speech (S,), of any level."""


@augmentation.register("noise")
@dataclass(kw_only=True)
class Noise(Background):
    """Noise of a random colour, from white to brown, and of a level that may change slowly.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to noise, in decibels.
        most: largest ratio.
    """

    share: Share = 0.6
    least: Ratio = 5.0
    most: Ratio = 50.0

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Noise of one colour."""
        exponent = random.uniform(-1.0, 0.2)
        return filtered(random.standard_normal(len(speech)), lambda hertz: np.maximum(hertz / 500, 0.08) ** exponent)


@augmentation.register("hum")
@dataclass(kw_only=True)
class Hum(Background):
    """Mains hum: 50 or 60 Hz with its harmonics.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to hum, in decibels.
        most: largest ratio.
    """

    share: Share = 0.2
    least: Ratio = 10.0
    most: Ratio = 50.0

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
@dataclass(kw_only=True)
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

    share: Share = 0.25
    least: Ratio = 6.0
    most: Ratio = 30.0
    voices: Annotated[int, Range(1, 20)] = 8

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
@dataclass(kw_only=True)
class Music(Background):
    """Music in the background: chords of decaying partials, and often a drum.

    Args:
        share: of the augmented clips.
        least: least ratio of speech to music, in decibels.
        most: largest ratio.
    """

    share: Share = 0.25
    least: Ratio = 6.0
    most: Ratio = 30.0

    def sound(self, speech: Wave, random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Music as long as the speech."""
        return played(len(speech), random)


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
