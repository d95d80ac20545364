"""Speech repeats bit for bit and has its phonemes in time."""

import ctypes
import signal
import time

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.speech import espeak
from facediff.synthetic.sentences import SENTENCES
from facediff.utils import SAMPLE_RATE

pytest.importorskip("espeakng_loader")
VOICE = espeak.EspeakVoice("en-us+f2", 158, 55, 55)


def test_same_text_same_samples_in_this_process_and_in_a_fresh_one() -> None:
    first, other, again = (espeak.speak(text, VOICE) for text in ("Bob mops.", "Pam hums.", "Bob mops."))
    assert np.array_equal(first.samples, again.samples)
    assert first.phonemes == again.phonemes
    assert not np.array_equal(first.samples[:4000], other.samples[:4000])
    fresh = espeak._finish(*espeak._speak_elsewhere("Bob mops.", VOICE))
    assert np.array_equal(first.samples, fresh.samples)
    assert first.phonemes == fresh.phonemes


def test_noise_does_not_start_from_the_clock() -> None:
    breathy = espeak.EspeakVoice("en-gb-x-rp+f3", 150, 60, 70)
    before = espeak.speak("Bob mops.", breathy)
    time.sleep(1.1)
    assert np.array_equal(before.samples, espeak.speak("Bob mops.", breathy).samples)


def test_a_library_that_is_loaded_already_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = espeak.speak("Bob mops.", VOICE)
    monkeypatch.setattr(espeak, "_is_loaded", lambda library: True)
    assert np.array_equal(espeak.speak("Bob mops.", VOICE).samples, expected.samples)


def test_ctrl_c_while_speaking_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    read = ctypes.string_at

    def interrupt(pointer: object, count: int) -> bytes:
        signal.raise_signal(signal.SIGINT)
        return read(pointer, count)  # type: ignore[arg-type]

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        monkeypatch.setattr(ctypes, "string_at", interrupt)
        with pytest.raises(KeyboardInterrupt):
            espeak.speak("Bob mops.", VOICE)
    finally:
        signal.signal(signal.SIGINT, before)


def test_phonemes_follow_one_another_and_the_sound() -> None:
    said = espeak.speak(SENTENCES[0], VOICE)
    length = said.samples.size / SAMPLE_RATE
    for before, after in zip(said.phonemes[:-1], said.phonemes[1:], strict=True):
        assert before.end == after.start
        assert before.end > before.start
    assert said.phonemes[-1].end == pytest.approx(length, abs=1e-3)
    spoken = "".join(p.ipa for p in said.phonemes)
    assert spoken.count("m") >= 4
    vowel = next(p for p in said.phonemes if "ɑ" in p.ipa)
    middle = said.samples[int(vowel.start * 16000) : int(vowel.end * 16000)]
    assert np.abs(middle).max() > 0.1


def test_unknown_voice_and_missing_package_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FaceDiffError, match="no voice 'nobody'"):
        espeak.speak("Hello.", espeak.EspeakVoice("nobody", 150, 50, 50))
    monkeypatch.setitem(__import__("sys").modules, "espeakng_loader", None)
    with pytest.raises(FaceDiffError, match=r"facediff\[puppet\]"):
        espeak.speak("Hello.", VOICE)
