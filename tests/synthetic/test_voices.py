"""Synthesisers by name; flite by a program that prints what flite prints."""

from __future__ import annotations

import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.synthetic.voices import Delivery, coloured_speech, installed_voices, open_voice

FLITE = """#!{python}
import sys, wave
words = sys.argv[1:]
if words == ["-lv"]:
    print("Voices available: kal awb_time slt ")
else:
    settings = dict(word.split("=") for word in words if "=" in word)
    stretch = float(settings["duration_stretch"])
    with wave.open(words[words.index("-o") + 1], "wb") as sound:
        sound.setnchannels(1); sound.setsampwidth(2); sound.setframerate(8000)
        sound.writeframes(b"\\0\\1" * int(8000 * 0.6 * stretch))
    print(" ".join(f"{{name}}:{{end * stretch:.3f}}" for name, end in
                   [("pau", 0.1), ("m", 0.2), ("aa", 0.4), ("ch", 0.5), ("pau", 0.6)]))
"""


@pytest.fixture
def flite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return _program(tmp_path / "bin" / "flite", FLITE, monkeypatch)


def _program(program: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    program.parent.mkdir()
    program.write_text(text.format(python=sys.executable))
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(program.parent))
    return program


def test_flite_says_when_each_phoneme_is_spoken(flite: Path) -> None:
    assert installed_voices()["flite"] == ["kal", "slt"]
    voice = open_voice("flite:slt")
    utterance = voice.speak("much")
    assert len(utterance.samples) == 9600
    assert [(p.ipa, p.start, p.end) for p in utterance.phonemes] == [
        ("", 0.0, 0.1),
        ("m", 0.1, 0.2),
        ("ɑ", 0.2, 0.4),
        ("tʃ", 0.4, 0.5),
        ("", 0.5, 0.6),
    ]
    slower = voice.speak("much", Delivery(rate=0.5))
    assert slower.phonemes[-1].end == pytest.approx(1.2)


@pytest.mark.parametrize(
    ("change", "to"),
    [("{{end * stretch:.3f}}", "a"), ("{{end * stretch:.3f}}", "nan"), ("int(8000 * 0.6 * stretch)", "0")],
)
def test_a_synthesiser_that_lies_is_named(
    change: str, to: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert change in FLITE
    _program(tmp_path / "bin" / "flite", FLITE.replace(change, to), monkeypatch)
    with pytest.raises(FaceDiffError):
        open_voice("flite:slt").speak("much")


def test_espeak_speaks_alike_and_faster_on_demand() -> None:
    voice = open_voice("espeak:en-us+f2")
    first, again = voice.speak("Bob put both pumps."), voice.speak("Bob put both pumps.")
    assert np.array_equal(first.samples, again.samples)
    assert len(voice.speak("Bob put both pumps.", Delivery(rate=1.3)).samples) < 0.9 * len(first.samples)


def test_colour_of_speech_is_what_it_says() -> None:
    times = np.arange(16_000) / 16_000
    low, high = (np.sin(2 * np.pi * frequency * times).astype(np.float32) for frequency in (250.0, 4000.0))
    louder = coloured_speech(low, 6.0, 2.0)
    assert np.std(louder) / np.std(low) == pytest.approx(10 ** (6 / 20), rel=1e-3)
    assert np.std(coloured_speech(high, 0.0, 2.0)) / np.std(high) == pytest.approx(10 ** (6 / 20), rel=1e-3)
