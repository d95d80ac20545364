"""Recordings of people with the phones of their TextGrids, in both alphabets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.errors import FaceDiffError
from facediff.speech.text_grids import read_text_grid
from facediff.synthetic.recordings import phones_of, read_aligned, recordings_of, speakers_of

PHONES = [(0.0, 0.3, "sil"), (0.3, 0.45, "M"), (0.45, 0.8, "AA1"), (0.8, 0.9, "M"), (0.9, 1.1, "AH0"), (1.1, 1.4, "")]
IN_IPA = [(start, end, ipa) for (start, end, _), ipa in zip(PHONES, ["", "m", "ɑ", "m", "ʌ", ""], strict=True)]
WORDS = [(0.0, 0.3, ""), (0.3, 1.1, 'ma"ma'), (1.1, 1.4, "")]
Tier = tuple[str, list[tuple[float, float, str]]]


def short_format(*tiers: Tier) -> str:
    lines = ['File type = "ooTextFile"', 'Object class = "TextGrid"', "", "0", "1.4", "<exists>", str(len(tiers))]
    for name, intervals in tiers:
        lines += ['"IntervalTier"', f'"{name}"', "0", "1.4", str(len(intervals))]
        for start, end, text in intervals:
            lines += [f"{start}", f"{end}", '"' + text.replace('"', '""') + '"']
    return "\n".join(lines) + "\n"


@pytest.fixture
def people(tmp_path: Path) -> Path:
    """Two speakers with two recordings each; one of them in a chapter's folder, as LibriSpeech has it."""
    random = np.random.default_rng(0)
    for speaker in ("84/121123", "174"):
        folder = tmp_path / "people" / speaker
        folder.mkdir(parents=True)
        for number in (1, 2):
            noise = 0.1 * random.standard_normal(round(1.4 * 22_050))
            soundfile.write(folder / f"a-{number}.{'flac' if number == 1 else 'wav'}", noise, 22_050)
            (folder / f"a-{number}.TextGrid").write_text(short_format(("words", WORDS), ("phones", PHONES)))
    return tmp_path / "people"


def test_phones_of_the_arpabet_become_ipa(people: Path) -> None:
    path = people / "174" / "a-1.TextGrid"
    assert read_text_grid(path) == {"words": WORDS, "phones": PHONES}
    assert [(p.start, p.end, p.ipa) for p in phones_of(path)] == IN_IPA


def test_ipa_is_taken_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.TextGrid"
    path.write_text(
        short_format(("84 - phones", [(0.0, 0.2, "spn"), (0.2, 0.4, "y"), (0.4, 1.4, "tʃ")])), encoding="utf-8"
    )
    assert [p.ipa for p in phones_of(path)] == ["", "y", "tʃ"]  # the ARPAbet's y would be j


def test_a_recording_is_read_with_its_phones(people: Path) -> None:
    assert [path.name for path in speakers_of(people)] == ["174", "84"]
    (stem, _) = recordings_of(people / "174", 9)
    spoken = read_aligned(stem)
    assert len(spoken.samples) == round(1.4 * 16_000)
    assert [p.ipa for p in spoken.phonemes] == [ipa for _, _, ipa in IN_IPA]
    soundfile.write(people / "174" / "a-1.flac", np.zeros(8000), 16_000)
    with pytest.raises(FaceDiffError, match=r"a-1.TextGrid: .*ends at 1.40 s and a-1.flac at 0.50"):
        read_aligned(stem)
    with pytest.raises(FaceDiffError, match="no aligned recording"):
        speakers_of(people / "174")


def test_a_recording_in_two_formats_is_one_and_capitals_do_not_matter(people: Path) -> None:
    first = people / "174" / "a-2.wav"
    soundfile.write(first.with_suffix(".flac"), *soundfile.read(first))
    assert [stem.name for stem in recordings_of(people / "174", 100)] == ["a-1", "a-2"]
    first.with_suffix(".flac").unlink()
    first.rename(first.with_suffix(".WAV"))
    assert len(read_aligned(first.with_suffix("")).samples)
