"""VOCASET from its raw distribution: rows to clips, 60 to 30 frames a second, the sound, and damaged data."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data.preparation import PreparationReport, prepare
from facediff.data.prepare import vocaset
from facediff.data.prepare.vocaset import read_samples
from facediff.errors import FaceDiffError
from facediff.utils.pickles import load_pickle
from tests.fakes.vocaset import (
    CLIPS,
    RATE,
    TRAIN,
    frames_of,
    motion_of,
    speech_of,
    write_raw_vocaset,
)

NAMES = sorted(f"{subject}_{sentence}" for subject, sentences in CLIPS.items() for sentence in sentences)
CLIP = f"{TRAIN}_sentence01"


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """One sentence of one person, 25 frames."""
    return write_raw_vocaset(tmp_path / "raw", clips={TRAIN: ["sentence01"]}, frames=25)


def prepared(raw: Path, **options: object) -> tuple[Path, PreparationReport]:
    out = raw.parent / "out"
    return out, prepare(vocaset.plan(raw, **options), out, workers=1)  # type: ignore[arg-type]


def problem(raw: Path) -> str:
    """Why the one clip fails."""
    report = prepared(raw)[1]
    assert list(report.failed) == [CLIP]
    return report.failed[CLIP]


def change(path: Path, key: str, value: object) -> None:
    """Replace what a raw pickle says of the one clip, or of the one person."""
    content = load_pickle(path)
    if path.name == "templates.pkl":
        content[TRAIN] = value
    elif key:
        content[TRAIN]["sentence01"][key] = value
    else:
        content[TRAIN]["sentence01"] = value
    path.write_bytes(pickle.dumps(content))


def test_every_second_frame_is_used_unchanged(tmp_path: Path) -> None:
    out, report = prepared(write_raw_vocaset(tmp_path / "raw"))
    assert sorted(report.clips) == NAMES
    for subject, sentences in CLIPS.items():
        for sentence in sentences:
            motion = np.load(out / "vertices_npy" / f"{subject}_{sentence}.npy")
            expected = motion_of(subject, sentence, frames_of(subject, sentence))[::2]
            assert motion.dtype == np.float32
            assert np.array_equal(motion, expected.reshape(len(expected), -1))
            assert report.clips[f"{subject}_{sentence}"] == len(expected)


def test_all_60_frames_a_second_can_be_kept(raw: Path) -> None:
    out, report = prepared(raw, frame_rate=60)
    motion = np.load(out / "vertices_npy" / f"{CLIP}.npy")
    assert np.array_equal(motion, motion_of(TRAIN, "sentence01", 25).reshape(25, -1))
    assert report.totals["seconds"] == pytest.approx(25 / 60, abs=1e-3)
    assert '"frame_rate": 60.0' in (out / "manifest.json").read_text()


def test_speech_is_resampled_to_16_khz(raw: Path) -> None:
    out, _ = prepared(raw)
    samples, rate = soundfile.read(out / "wav" / f"{CLIP}.wav")
    assert rate == 16000
    assert len(samples) == pytest.approx(25 / 60 * 16000, abs=1)
    speech = speech_of(TRAIN, "sentence01", 25) / 32768
    expected = np.interp(np.arange(len(samples)) / 16000, np.arange(len(speech)) / RATE, speech)
    assert np.abs(samples - expected)[200:-200].max() < 0.01


@pytest.mark.parametrize(("samples", "frames"), [(20 / 60 * RATE, 20), (RATE, 25)])
def test_as_many_frames_are_used_as_both_motion_and_sound_have(raw: Path, samples: float, frames: int) -> None:
    change(raw / "raw_audio_fixed.pkl", "audio", np.ones(round(samples), np.int16))
    out, _ = prepared(raw, frame_rate=60)
    assert len(np.load(out / "vertices_npy" / f"{CLIP}.npy")) == frames


RAMP = np.linspace(-20000, 20000, 500).astype(np.int16)


@pytest.mark.parametrize(
    "audio",
    [
        RAMP,
        RAMP.astype(np.int64),
        RAMP.astype(np.int32)[None],
        RAMP.tolist(),
        RAMP.astype(np.float64),
        RAMP / 32768,
        np.stack([RAMP, RAMP]),
        np.stack([RAMP, RAMP], 1),
    ],
    ids=["int16", "int64", "row", "list", "float of 16 bit", "float", "channels first", "channels last"],
)
def test_sound_of_any_type_means_the_same(audio: object) -> None:
    samples, rate = read_samples({"audio": audio, "sample_rate": np.int64(22050)}, "A sentence01")
    assert rate == 22050
    mono = samples if samples.ndim == 1 else samples.mean(1)
    np.testing.assert_allclose(mono, RAMP / 32768, atol=1e-7)


@pytest.mark.parametrize(
    "entry",
    [
        np.ones(9, np.int16),
        {"audio": RAMP},
        {"audio": RAMP, "sample_rate": 0},
        {"audio": np.zeros(0, np.int16), "sample_rate": RATE},
        {"audio": RAMP.astype(np.uint8), "sample_rate": RATE},
        {"audio": np.array([1, 100_000]), "sample_rate": RATE},
        {"audio": np.array([0.1, np.nan] * 5000), "sample_rate": RATE},
    ],
)
def test_sound_of_another_form_is_refused(raw: Path, entry: object) -> None:
    change(raw / "raw_audio_fixed.pkl", "", entry)
    assert f"{TRAIN} sentence01: its sound in raw_audio_fixed.pkl" in problem(raw)


@pytest.mark.parametrize("row", [25, -1])
def test_a_row_beyond_the_array_is_refused(raw: Path, row: int) -> None:
    change(raw / "subj_seq_to_idx.pkl", "", {**{i: i for i in range(7)}, 7: row})
    assert (
        f"sentence01: frame 7 is row {row} in subj_seq_to_idx.pkl, but {raw / 'data_verts.npy'} has 25 rows"
        in problem(raw)
    )


def test_frames_are_in_the_order_of_their_numbers_and_gaps_are_noted(raw: Path) -> None:
    change(raw / "subj_seq_to_idx.pkl", "", {4: 9, 0: 3, 2: 7, 1: 5})
    out, report = prepared(raw, frame_rate=60)
    motion = np.load(out / "vertices_npy" / f"{CLIP}.npy")
    assert np.array_equal(motion, np.load(raw / "data_verts.npy")[[3, 5, 7, 9]].reshape(4, -1))
    assert any(CLIP in note and "leaves out some of the frames up to 4" in note for note in report.notes)


def test_sentences_that_were_never_recorded_are_counted(tmp_path: Path) -> None:
    raw = write_raw_vocaset(tmp_path / "raw")
    audio = load_pickle(raw / "raw_audio_fixed.pkl")
    del audio[TRAIN]["sentence02"]
    (raw / "raw_audio_fixed.pkl").write_bytes(pickle.dumps(audio))
    templates = load_pickle(raw / "templates.pkl")
    gone = sorted(CLIPS)[-1]
    del templates[gone]
    (raw / "templates.pkl").write_bytes(pickle.dumps(templates))
    _, report = prepared(raw)
    assert report.sound
    assert f"{TRAIN}_sentence02" not in report.clips
    assert report.missing[f"{TRAIN}_sentence02"].startswith("not in raw_audio_fixed.pkl;")
    assert report.missing[f"{TRAIN}_sentence03"].startswith("not in subj_seq_to_idx.pkl nor in raw_audio_fixed.pkl;")
    assert "templates.pkl; no clip of" in report.missing[f"template of {gone}"]
    assert not any(gone in name for name in report.clips)
    complete = sum(map(len, CLIPS.values())) - 1 - len(CLIPS[gone])
    assert len(report.clips) == complete
    assert len([name for name in report.missing if "_TA_" in name]) == 40 * (len(CLIPS) - 1) - complete


def test_names_from_pickles_cannot_leave_the_folder(raw: Path) -> None:
    for name in ("subj_seq_to_idx.pkl", "raw_audio_fixed.pkl", "templates.pkl"):
        content = load_pickle(raw / name)
        content["../../evil"] = content.pop(TRAIN)
        (raw / name).write_bytes(pickle.dumps(content))
    with pytest.raises(FaceDiffError, match=r'clip name "\.\./\.\./evil_sentence01"'):
        prepared(raw)
