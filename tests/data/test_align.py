"""Recordings of people with their phones: from TextGrids, from known words and from the sound alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import main
from facediff.data.align import align_recordings, find_recordings, known_words
from facediff.errors import FaceDiffError
from facediff.speech.text_grids import read_text_grid, write_text_grid
from facediff.synthetic.recordings import phones_of, recordings_of, speakers_of
from facediff.synthetic.voices import open_voice
from tests.fakes.aligned import write_aligned

TEXT = "My brother bought a map. Maybe we could meet him in the park tomorrow."


def test_text_grids_are_written_as_they_are_read(tmp_path: Path) -> None:
    tiers = {"words": [(0.5, 1.0, 'say "a"')], "phones": [(0.5, 0.7, "ɑː"), (0.7, 1.0, "b")]}
    write_text_grid(tmp_path / "a.TextGrid", tiers, 1.5)
    read = read_text_grid(tmp_path / "a.TextGrid")
    assert {name: [each for each in tier if each[2]] for name, tier in read.items()} == tiers
    assert all(tier[0][0] == 0 and tier[-1][1] == 1.5 for tier in read.values())
    assert all(a[1] == b[0] for tier in read.values() for a, b in zip(tier, tier[1:], strict=False))


def test_recordings_are_cut_at_pauses_and_times_stay_right(tmp_path: Path) -> None:
    """Every sample of a piece is the recording's at the piece's time, and phones move along."""
    write_aligned(tmp_path / "in" / "anna" / "long.wav", 14.0, [3.0, 3.5, 7.1])
    report = align_recordings(tmp_path / "in", tmp_path / "out", workers=1)
    assert not report.failed
    assert report.speakers == {"anna": 3}  # the last 6.6 s have no pause
    assert 0 < report.closures < report.phones
    whole, _ = soundfile.read(tmp_path / "in" / "anna" / "long.wav")
    times = [3.0, 3.5, 7.1]
    for piece in sorted((tmp_path / "out" / "anna").glob("*.wav")):
        sound, rate = soundfile.read(piece)
        alike = np.flatnonzero(np.abs(whole - sound[0]) < 1e-4)
        place = next(i for i in alike if np.allclose(whole[i : i + 400], sound[:400], atol=1e-4))
        assert np.allclose(whole[place : place + len(sound)], sound, atol=1e-4)
        phones = read_text_grid(piece.with_suffix(".TextGrid"))["phones"]
        assert phones[-1][1] == pytest.approx(len(sound) / rate, abs=1e-3)
        starts = [place / rate + start for start, _, text in phones if not text and start > 0.25]
        assert all(min(abs(start - time) for time in times) < 0.25 for start in starts)
    assert [
        voice.voice.endswith(f"long-{n}") for n, voice in enumerate(recordings_of(str(tmp_path / "out/anna"), 9), 1)
    ]


def test_words_are_aligned_by_pocketsphinx_and_a_corpus_can_speak(tmp_path: Path) -> None:
    said = open_voice("espeak:en-us+f2").speak(TEXT)
    (tmp_path / "in").mkdir()
    soundfile.write(tmp_path / "in" / "7-1-0001.flac", said.samples, 16_000)
    (tmp_path / "in" / "7-1.trans.txt").write_text(f"7-1-0001 {TEXT.upper()}\n")
    assert main(["data", "align", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--workers=1", "--quiet"]) == 0
    grids = sorted((tmp_path / "out" / "7").glob("*.TextGrid"))
    assert [Path(speaker).name for speaker in speakers_of(tmp_path / "out")] == ["7"]
    closing = [p for grid in grids for p in phones_of(grid) if p.ipa in ("p", "b", "m")]
    truth = [p for p in said.phonemes if p.ipa.strip("ˈˌː") in ("p", "b", "m")]
    assert len(closing) == len(truth)
    apart = [abs((a.start + a.end) / 2 - (b.start + b.end) / 2) for a, b in zip(closing, truth, strict=True)]
    assert float(np.median(apart)) < 0.03


def test_what_cannot_be_aligned_is_named_and_the_rest_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_aligned(tmp_path / "in" / "anna" / "a.wav", 4.0, [])
    write_aligned(tmp_path / "in" / "bert" / "b.wav", 4.0, [])
    (tmp_path / "in" / "bert" / "b.TextGrid").unlink()
    (tmp_path / "in" / "bert" / "b.txt").write_text("Zxqwv spoke.")
    write_aligned(tmp_path / "in" / "carl" / "c.wav", 4.0, [])
    (tmp_path / "in" / "carl" / "c.TextGrid").unlink()
    (tmp_path / "in" / "carl" / "c.txt").write_text("Nobody can say all of these words within four seconds. " * 9)
    assert main(["data", "align", str(tmp_path / "in"), "-o", str(tmp_path / "out"), "--workers=1", "--quiet"]) == 1
    out = capsys.readouterr().out
    assert "1 speaker, 1 piece" in out
    assert "not used: " in out
    assert "b.wav: pocketsphinx does not know the word 'zxqwv'" in out
    assert "c.wav: its words could not be found" in out
    with pytest.raises(FaceDiffError, match="holds no recordings"):
        find_recordings(tmp_path / "out" / "bert")


def test_corrected_phones_are_aligned_again_and_no_recording_replaces_another(tmp_path: Path) -> None:
    write_aligned(tmp_path / "in" / "anna" / "a.wav", 4.0, [])
    before = align_recordings(tmp_path / "in", tmp_path / "out", workers=1)
    grid = tmp_path / "in" / "anna" / "a.TextGrid"
    grid.write_text(grid.read_text().replace('"M"', '"K"'))
    after = align_recordings(tmp_path / "in", tmp_path / "out", workers=1)
    assert after.phones == before.phones
    assert after.closures == 0 < before.closures
    (tmp_path / "in" / "anna" / "a.flac").write_bytes((tmp_path / "in" / "anna" / "a.wav").read_bytes())
    with pytest.raises(FaceDiffError, match=r"would be written as .*a\.\w+ is; rename one"):
        align_recordings(tmp_path / "in", tmp_path / "out", workers=1)


def test_a_speaker_is_a_folder_or_the_beginning_of_a_name(tmp_path: Path) -> None:
    for name in ("84-1-0000.flac", "84-1-0001.flac", "anna/tuesday/b.wav", ".hidden/c.wav"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert sorted(find_recordings(tmp_path).values()) == ["84", "84", "anna"]
    (tmp_path / "84-1.trans.txt").write_text("84-1-0000 IT'S TWO\n84-1-0001 IT'S THREE\n")
    assert known_words(tmp_path / "84-1-0001.flac") == "it's three"
