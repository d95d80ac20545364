"""Synthesisers that speak for the built-in corpus, by name, such as ``espeak:en-us+f2`` or ``flite:slt``.

espeak-ng comes with ``pip install "facediff[puppet]"`` and speaks a hundred languages by rule. flite is a program of
its own (a package in Debian, Ubuntu, Fedora and Homebrew); its voices are made from recordings of people, so that
models trained on them know more of people's voices. Both print when each phoneme is spoken.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError, choices, damaged
from facediff.registry import puppet_voice
from facediff.speech.audio import read_speech
from facediff.speech.espeak import EspeakVoice, SpokenPhoneme, Utterance, speak
from facediff.utils import SAMPLE_RATE

_SECONDS = 120.0  # After which flite is taken to hang
_SEMITONE = 2.0 ** (1.0 / 12.0)


@dataclass(frozen=True)
class Delivery:
    """How a voice says a sentence: factors of its speed and of its melody's range, semitones above its own pitch."""

    rate: float = 1.0
    pitch: float = 0.0
    pitch_range: float = 1.0


class Synthesiser(ABC):
    """A program that speaks, with one of its voices; register a subclass as a ``puppet_voice`` to add one."""

    install: ClassVar[str]
    """How to install the program, for an error."""

    def __init__(self, voice: str) -> None:
        self.voice = voice

    @classmethod
    @abstractmethod
    def voices(cls) -> list[str]:
        """Names of the voices that are installed; none where the program is missing."""

    @classmethod
    def open(cls, voice: str, name: str) -> Synthesiser:
        """One of the voices that are installed; ``name`` is its whole name, for errors."""
        program, installed = name.partition(":")[0], cls.voices()
        if voice.split("+")[0] not in installed:
            reason = f'has no voice "{voice}"; {choices(voice, installed)}' if installed else "is not installed"
            raise FaceDiffError(f'voice "{name}": {program} {reason}{"" if installed else f"; {cls.install}"}')
        return cls(voice)

    @abstractmethod
    def speak(self, text: str, delivery: Delivery = Delivery()) -> Utterance:  # noqa: B008 - frozen
        """Speak a sentence; the same arguments give the same samples."""


def open_voice(name: str) -> Synthesiser:
    """The voice of a name such as ``flite:slt``."""
    program, _, voice = name.partition(":")
    synthesiser: Synthesiser = puppet_voice.get(program).open(voice, name)
    return synthesiser


def installed_voices() -> dict[str, list[str]]:
    """Voices by synthesiser, where there are any."""
    return {name: voices for name in puppet_voice.names() if (voices := puppet_voice.get(name).voices())}


@puppet_voice.register("espeak")
class Espeak(Synthesiser):
    """espeak-ng: a hundred languages by rule, with variants such as ``+f2``; what pip installs."""

    install = 'pip install "facediff[puppet]"'

    @classmethod
    def voices(cls) -> list[str]:
        """espeak-ng's languages."""
        try:
            import espeakng_loader
        except ImportError:
            return []
        return _languages(espeakng_loader.get_data_path())

    def speak(self, text: str, delivery: Delivery = Delivery()) -> Utterance:  # noqa: B008 - frozen
        """Speak a sentence."""
        # espeak-ng's pitch of 0 to 99 spans about two octaves, and 50 is the voice's own.
        pitch = int(np.clip(round(50 + 4 * delivery.pitch), 0, 99))
        spread = int(np.clip(round(50 * delivery.pitch_range), 0, 99))
        return speak(text, EspeakVoice(self.voice, round(155 * delivery.rate), pitch, spread))


# The phones of CMU's dictionary, as flite names them, in the International Phonetic Alphabet.
_CMU = """
aa=ɑ ae=æ ah=ʌ ao=ɔ aw=aʊ ax=ə axr=ɚ ay=aɪ eh=ɛ er=ɝ ey=eɪ ih=ɪ iy=i ow=oʊ oy=ɔɪ uh=ʊ uw=u el=əl em=əm en=ən
b=b ch=tʃ d=d dh=ð dx=ɾ f=f g=ɡ hh=h hv=ɦ jh=dʒ k=k l=l m=m n=n nx=ɾ ng=ŋ p=p q=ʔ r=ɹ s=s sh=ʃ t=t th=θ v=v
w=w y=j z=z zh=ʒ pau= h#= brth=
"""
CMU_PHONES = dict(pair.split("=") for pair in _CMU.split())


@puppet_voice.register("flite")
class Flite(Synthesiser):
    """flite: five English voices made from recordings of people."""

    install = "install the package flite (apt install flite, dnf install flite, brew install flite)"

    @classmethod
    def voices(cls) -> list[str]:
        """Flite's voices, without those that can tell the time only."""
        program = shutil.which("flite")
        return [] if program is None else _flite_voices(program)

    def speak(self, text: str, delivery: Delivery = Delivery()) -> Utterance:  # noqa: B008 - frozen
        """Speak a sentence."""
        settings = {
            "duration_stretch": 1.0 / delivery.rate,
            "f0_shift": _SEMITONE**delivery.pitch,
            "int_f0_target_stddev": 12.0 * delivery.pitch_range,
        }
        with tempfile.TemporaryDirectory() as folder:
            sound = Path(folder) / "speech.wav"
            options = [word for name, value in settings.items() for word in ("--setf", f"{name}={value:g}")]
            printed = _run("flite", "-voice", self.voice, *options, "-psdur", "-t", text, "-o", str(sound))
            phonemes, start = [], 0.0
            with damaged(f'voice "{self.voice}"', "install flite again"):
                for name, colon, time in (phone.rpartition(":") for phone in printed.split()):
                    if colon and (end := float(time)) > start:
                        phonemes.append(SpokenPhoneme(start, end, CMU_PHONES.get(name, name)))
                        start = end
            if not sound.is_file() or not any(phoneme.ipa for phoneme in phonemes):
                raise FaceDiffError(f'voice "flite:{self.voice}": spoke nothing; give it a text with words')
            return Utterance(read_speech(sound), tuple(phonemes))


@lru_cache
def _languages(folder: str) -> list[str]:
    return sorted(path.name.lower() for path in (Path(folder) / "lang").rglob("*") if path.is_file())


@lru_cache
def _flite_voices(program: str) -> list[str]:
    names = _run(program, "-lv").partition(":")[2].split()
    return [name for name in names if not name.endswith("_time")]


def _run(*command: str) -> str:
    with damaged(f"{command[0]}: failed", "try it in a terminal", OSError, subprocess.SubprocessError):
        return subprocess.run(  # noqa: S603 - a program on the path, without a shell
            command, capture_output=True, text=True, check=True, timeout=_SECONDS
        ).stdout


def coloured_speech(samples: NDArray[np.float32], loudness: float, brightness: float) -> NDArray[np.float32]:
    """Speech (S,) at 16 kHz made louder by decibels and brighter by decibels per octave above 500 Hz."""
    spectrum = np.fft.rfft(samples)
    frequencies = np.fft.rfftfreq(len(samples), 1.0 / SAMPLE_RATE)
    gain = loudness + brightness * np.log2(np.maximum(frequencies, 500.0) / 500.0)
    return np.fft.irfft(spectrum * 10.0 ** (gain / 20.0), len(samples)).astype(np.float32)
