"""Synthesised speech with the exact times of its phonemes, from espeak-ng.

espeak-ng arrives with ``espeakng_loader`` (library and data in one wheel) and is driven through ctypes. It
keeps state from one utterance to the next, so that a second call in one process gives another waveform with
other times, even after a reset, and its noise is seeded by the clock. Therefore the noise is given a seed, and the
library is loaded for each utterance and unloaded again. Where it cannot be unloaded (because the process uses it
elsewhere, or the C library never unloads), a new interpreter speaks the utterance. Both ways give the same bits.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError, needs_extra
from facediff.utils import SAMPLE_RATE

_SYNCHRONOUS = 2
_PHONEME_EVENTS_AS_IPA = 0x0001 | 0x0002
_DONT_EXIT = 0x8000
_RATE, _VOLUME, _PITCH, _RANGE = 1, 2, 3, 4
_EVENT_END, _EVENT_PHONEME = 0, 7
_POSITION_CHARACTER = 1
_TEXT_UTF8 = 1
_VOLUME_LEVEL = 80
_NOISE_SEED = 1
_VOICELESS_PLOSIVES = ("p", "t", "k")
_CLOSURE = 0.045


@dataclass(frozen=True)
class EspeakVoice:
    """The settings of espeak-ng for a speaker."""

    name: str  # Voice and variant, such as `"en-us+f2"`
    rate: int  # Words per minute
    pitch: int  # Base pitch, 0 to 100
    pitch_range: int  # Liveliness of the melody, 0 (monotone) to 100


@dataclass(frozen=True)
class SpokenPhoneme:
    """One phoneme of an utterance."""

    start: float  # Where it starts, in seconds
    end: float  # Where the next one starts, in seconds
    ipa: str  # Its name in the International Phonetic Alphabet, with stress and length marks; empty for a pause


@dataclass(frozen=True)
class Utterance:
    """A spoken sentence."""

    samples: NDArray[np.float32]  # Waveform at 16 kHz, shape (samples,), float32 in [-1, 1]
    phonemes: tuple[SpokenPhoneme, ...]  # The phonemes in order, without gaps


class _EventId(ctypes.Union):
    _fields_ = [("number", ctypes.c_int), ("name", ctypes.c_char_p), ("string", ctypes.c_char * 8)]


class _Event(ctypes.Structure):
    _fields_ = [
        ("type", ctypes.c_int),
        ("unique_identifier", ctypes.c_uint),
        ("text_position", ctypes.c_int),
        ("length", ctypes.c_int),
        ("audio_position", ctypes.c_int),
        ("sample", ctypes.c_int),
        ("user_data", ctypes.c_void_p),
        ("id", _EventId),
    ]


_CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(_Event))


def speak(text: str, voice: EspeakVoice) -> Utterance:
    """Speak a sentence; the same text and voice give the same samples and times of phonemes."""
    library, _ = _paths()
    if _is_loaded(library):
        return _finish(*_speak_elsewhere(text, voice))
    # ctypes prints and drops exceptions of a callback. Signals, such as Ctrl-C, raise in the main thread only.
    with ThreadPoolExecutor(1) as thread:
        return _finish(*thread.submit(_speak_here, text, voice).result())


def _paths() -> tuple[str, str]:
    """Find the library and its data."""
    with needs_extra("espeakng_loader", "puppet", "speech by espeak-ng"):
        import espeakng_loader
    return str(espeakng_loader.get_library_path()), str(espeakng_loader.get_data_path())


def _is_loaded(library: str) -> bool:
    """Whether this process has loaded the library already; True where that cannot be found out."""
    if not hasattr(os, "RTLD_NOLOAD"):
        return True
    try:
        handle = ctypes.CDLL(library, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
    except OSError:
        return False
    _unload(handle)
    return True


def _unload(library: ctypes.CDLL) -> None:
    import _ctypes

    close: Callable[[int], Any] | None = getattr(_ctypes, "dlclose", None)
    if close is not None:
        close(library._handle)


def _speak_here(text: str, voice: EspeakVoice) -> tuple[int, bytes, list[tuple[int, str]]]:
    """Sample rate, 16-bit samples, and (sample index, IPA) of each phoneme, from a freshly loaded library."""
    path, data = _paths()
    library = ctypes.CDLL(path)
    chunks: list[bytes] = []
    events: list[tuple[int, str]] = []

    def collect(wave: Any, count: int, event: Any) -> int:  # noqa: ANN401 - ctypes pointers
        if wave and count > 0:
            chunks.append(ctypes.string_at(wave, 2 * count))
        index = 0
        while event and event[index].type != _EVENT_END:
            if event[index].type == _EVENT_PHONEME:
                events.append((event[index].sample, event[index].id.string.decode("utf-8", "ignore")))
            index += 1
        return 0

    callback = _CALLBACK(collect)
    try:
        rate = library.espeak_Initialize(_SYNCHRONOUS, 0, data.encode(), _PHONEME_EVENTS_AS_IPA | _DONT_EXIT)
        if rate <= 0:
            raise FaceDiffError(f"espeak-ng could not be started with its data in {data}; reinstall espeakng-loader")
        # Breathy voices mix noise in, which is seeded by the clock unless a seed is set.
        library.espeak_ng_SetRandSeed(ctypes.c_long(_NOISE_SEED))
        if library.espeak_SetVoiceByName(voice.name.encode()) != 0:
            raise FaceDiffError(f"espeak-ng has no voice {voice.name!r}; use one like 'en-us+f2'")
        library.espeak_SetSynthCallback(callback)
        for parameter, value in (
            (_RATE, voice.rate),
            (_VOLUME, _VOLUME_LEVEL),
            (_PITCH, voice.pitch),
            (_RANGE, voice.pitch_range),
        ):
            library.espeak_SetParameter(parameter, value, 0)
        encoded = text.encode() + b"\0"
        library.espeak_Synth(encoded, ctypes.c_size_t(len(encoded)), 0, _POSITION_CHARACTER, 0, _TEXT_UTF8, None, None)
        library.espeak_Synchronize()
        library.espeak_Terminate()
    finally:
        _unload(library)
    return int(rate), b"".join(chunks), events


def _speak_elsewhere(text: str, voice: EspeakVoice) -> tuple[int, bytes, list[tuple[int, str]]]:
    """Speak in a new interpreter."""
    request = json.dumps([text, voice.name, voice.rate, voice.pitch, voice.pitch_range])
    process = subprocess.run(  # noqa: S603 - this very interpreter, no outside input
        [sys.executable, "-m", "facediff.speech.espeak"],
        input=request.encode(),
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    if process.returncode != 0:
        raise FaceDiffError(f"espeak-ng failed in its own process: {process.stderr.decode(errors='replace')[-300:]}")
    header, pcm = process.stdout.split(b"\n", 1)
    rate, events = json.loads(header)
    return int(rate), pcm, [(int(sample), str(ipa)) for sample, ipa in events]


def _serve() -> None:
    """Answer one request of `_speak_elsewhere`: JSON in, a JSON line and the samples out."""
    text, name, rate, pitch, pitch_range = json.loads(sys.stdin.buffer.read())
    answer = _speak_here(text, EspeakVoice(name, rate, pitch, pitch_range))
    sys.stdout.buffer.write(json.dumps([answer[0], answer[2]]).encode() + b"\n" + answer[1])


def _finish(rate: int, pcm: bytes, events: list[tuple[int, str]]) -> Utterance:
    """Resample to 16 kHz and turn events into spans."""
    import soxr

    native = np.frombuffer(pcm, dtype="<i2").astype(np.float32) / 32768.0
    if native.size == 0:
        raise FaceDiffError("espeak-ng returned no samples; give it a text with words")
    samples = soxr.resample(native, rate, SAMPLE_RATE, quality="HQ").astype(np.float32)
    end = native.size / rate
    starts = [min(sample / rate, end) for sample, _ in events]
    phonemes = [
        SpokenPhoneme(start, stop, ipa)
        for start, stop, (_, ipa) in zip(starts, [*starts[1:], end], events, strict=True)
        if stop > start
    ]
    return Utterance(samples, tuple(_with_closures(phonemes)))


def _with_closures(phonemes: list[SpokenPhoneme]) -> list[SpokenPhoneme]:
    """Give voiceless plosives their silent closure.

    In espeak-ng p, t, k and ch start at the burst. The silence before it, in which the lips or the tongue are shut
    already, belongs to the previous sound there.
    """
    result: list[SpokenPhoneme] = []
    for phoneme in phonemes:
        if result and result[-1].ipa and phoneme.ipa[:1] in _VOICELESS_PLOSIVES:
            before = result[-1]
            start = phoneme.start - min(_CLOSURE, 0.35 * (before.end - before.start))
            result[-1] = SpokenPhoneme(before.start, start, before.ipa)
            phoneme = SpokenPhoneme(start, phoneme.end, phoneme.ipa)
        result.append(phoneme)
    return result


if __name__ == "__main__":
    _serve()
