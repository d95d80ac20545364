"""Aligned recordings as voices: both formats of TextGrids, both alphabets, and a corpus that speaks with them."""

from __future__ import annotations

import csv
import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data import Puppet
from facediff.errors import FaceDiffError
from facediff.synthetic.cast import member_of
from facediff.synthetic.corpus import generate, performed_clips, resting_head
from facediff.synthetic.recordings import phones_of, read_text_grid, recordings_of, speakers_of
from facediff.synthetic.voices import Delivery, installed_voices, open_voice

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


def test_a_recording_is_a_voice(people: Path) -> None:
    voice = open_voice(f"aligned:{people / '174' / 'a-1'}")
    spoken = voice.speak("whatever", Delivery(rate=2.0))
    assert len(spoken.samples) == round(1.4 * 16_000)
    assert [p.ipa for p in spoken.phonemes] == [ipa for _, _, ipa in IN_IPA]
    assert "aligned" not in installed_voices()
    assert [said.text for said in recordings_of(str(people / "84"), 9)] == ['ma"ma', 'ma"ma']
    soundfile.write(people / "174" / "a-1.flac", np.zeros(8000), 16_000)
    with pytest.raises(FaceDiffError, match=r"a-1.TextGrid: .*ends at 1.40 s and a-1.flac at 0.50"):
        voice.speak()
    with pytest.raises(FaceDiffError, match="no such recording"):
        open_voice(f"aligned:{people / 'nobody'}").speak()
    (people / "empty").mkdir()
    with pytest.raises(FaceDiffError, match="no aligned recording"):
        speakers_of(people / "174")


def test_a_recording_in_two_formats_is_one_and_capitals_do_not_matter(people: Path) -> None:
    speaker = next(path for path in sorted(people.iterdir()) if path.is_dir())
    first = next(iter(sorted(speaker.rglob("*.wav"))))
    soundfile.write(first.with_suffix(".flac"), *soundfile.read(first))
    voices = [recording.voice for recording in recordings_of(str(speaker), 100)]
    assert len(voices) == len(set(voices))
    first.with_suffix(".flac").unlink()
    first.rename(first.with_suffix(".WAV"))
    assert len(open_voice(f"aligned:{first.with_suffix('')}").speak().samples)


def test_recordings_add_a_speaker_for_each_person(people: Path, tmp_path: Path) -> None:
    """Drawn speakers keep their voices and clips, and whoever has a single recording has a style reference too."""
    (people / "174" / "a-1.flac").unlink()
    data = Puppet(root=str(tmp_path / "corpus"), drawn_speakers=3, recordings=str(people))
    voices = data.voices
    assert [Path(voice).name for voice in voices] == ["174", "84"]
    assert data.identities[-5:] == ["X01", "X02", "X03", "P001", "P002"]
    clips, without = performed_clips(3, voices), performed_clips(3)
    assert clips[: len(without)] == without
    assert [(clip.name, Path(clip.voice).name) for clip in clips[len(without) :]] == [
        ("P001_e01", "a-2"),
        ("P001_e02", "a-2"),
        ("P002_e01", "a-1"),
        ("P002_e02", "a-2"),
    ]
    assert len({clip.mood for clip in clips[-4:-2]}) == 2
    faces = [resting_head(member_of(name)) for name in ("X01", "X02", "P001", "P002")]
    assert all(np.abs(one - other).max() > 1e-3 for one, other in itertools.combinations(faces, 2))
    generate(tmp_path / "corpus", drawn=3, people=voices, only=["P002_e01"], progress=False)
    with (tmp_path / "corpus" / "phonemes" / "P002_e01.csv").open(encoding="utf-8") as stream:
        phonemes = list(csv.DictReader(stream))
    assert "".join(row["ipa"] for row in phonemes) == "mɑmʌ"
    speech, rate = soundfile.read(tmp_path / "corpus" / "wav" / "P002_e01.wav")
    assert rate == 16_000
    assert len(np.load(tmp_path / "corpus" / "weights_npy" / "P002_e01.npy")) == len(speech) / 640


def test_two_folders_of_recordings_are_kept_apart(
    people: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each run with the one would otherwise make the corpus of the other anew; a relative path is the same folder."""
    others = shutil.copytree(people, tmp_path / "others")
    monkeypatch.chdir(tmp_path)
    roots = [Puppet(drawn_speakers=3, recordings=str(folder)).root for folder in (people, others, Path("people"))]
    assert roots[0] != roots[1]
    assert roots[0] == roots[2]
    grid = next(people.rglob("*.TextGrid"))
    grid.write_text(grid.read_text() + "\n")  # corrected: the corpus of before has other phones
    assert Puppet(drawn_speakers=3, recordings=str(people)).root != roots[0]
