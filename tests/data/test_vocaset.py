"""VOCASET: splits against hand-written lists, and its frame rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.cli.benchmark import truth_words
from facediff.errors import FaceDiffError
from tests.fakes.mini import VERTICES, MiniVocaset, names_of, write

VOCASET_TRAIN = [
    "FaceTalk_170728_03272_TA",
    "FaceTalk_170904_00128_TA",
    "FaceTalk_170725_00137_TA",
    "FaceTalk_170915_00223_TA",
    "FaceTalk_170811_03274_TA",
    "FaceTalk_170913_03279_TA",
    "FaceTalk_170904_03276_TA",
    "FaceTalk_170912_03278_TA",
]


VOCASET_VAL = ["FaceTalk_170811_03275_TA", "FaceTalk_170908_03277_TA"]


VOCASET_TEST = ["FaceTalk_170809_00138_TA", "FaceTalk_170731_00024_TA"]


def test_vocaset_has_the_splits_of_the_field_and_counts_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    people = [*VOCASET_TRAIN, *VOCASET_VAL, *VOCASET_TEST]
    everything = [f"{p}_sentence{n:02d}" for p in people for n in range(1, 41)]
    absent = [f"{VOCASET_TRAIN[0]}_sentence07", f"{VOCASET_TEST[1]}_sentence40"]
    there = [name for name in everything if name not in absent]
    data = MiniVocaset(root=str(write(tmp_path, there, set(people), frames=1)))
    expected = {
        "train": [f"{p}_sentence{n:02d}" for p in VOCASET_TRAIN for n in range(1, 41)],
        "val": [f"{p}_sentence{n:02d}" for p in VOCASET_VAL for n in range(21, 41)],
        "test_a": [],
        "test_b": [f"{p}_sentence{n:02d}" for p in VOCASET_TEST for n in range(21, 41)],
    }
    assert names_of(data) == {s: sorted(n for n in names if n in there) for s, names in expected.items()}
    assert [len(expected[s]) for s in ("train", "val", "test_b")] == [320, 40, 40]
    assert data.identities == VOCASET_TRAIN
    assert data.missing_clips() == {"train": absent[:1], "val": [], "test_b": absent[1:]}
    data.prepare_data()
    assert "1 of train, 1 of test_b" in capsys.readouterr().out
    assert data.test_splits == ["test_b"]
    sample = data.dataset("test_b")[0]
    assert sample.identity == -1
    assert int(sample.reference_name[-2:]) < 21


def test_sixty_stored_frames_a_second_become_thirty_by_every_second(tmp_path: Path) -> None:
    subject = VOCASET_TRAIN[0]
    root = write(tmp_path, [f"{subject}_sentence01", f"{subject}_sentence02"], {subject}, frames=7)
    stored = np.load(root / "vertices_npy" / f"{subject}_sentence01.npy").reshape(7, VERTICES, 3)
    data = MiniVocaset(root=str(root))
    clip = data.corpus.clips[f"{subject}_sentence01"]
    template = data.corpus.templates[subject]
    expected = torch.from_numpy(stored[::2].astype("f4")) - template
    assert data.corpus.frames(clip) == 4
    assert torch.equal(data.corpus.read_motion(clip), expected)
    assert torch.equal(data.corpus.read_motion(clip, 1, 3), expected[1:3])
    assert len(data.corpus.read_audio(clip, 0, 3)) == 3 * 16000 // 30
    # A prepared folder says what it holds.
    (root / "manifest.json").write_text('{"corpus": "vocaset", "frame_rate": 30, "unit": "mm"}')
    prepared = MiniVocaset(root=str(root))
    assert prepared.corpus.frames(prepared.corpus.clips[clip.name]) == 7
    assert prepared.assets().unit == "mm"
    assert truth_words(prepared) == (str(root),)  # and a benchmark's predictions are scored at it
    assert truth_words(data)[1:] == ("--truth-stride", "2")
    (root / "manifest.json").write_text('{"frame_rate": 50}')
    with pytest.raises(FaceDiffError, match=r"frame_rate is 50.*30 frames"):
        _ = MiniVocaset(root=str(root)).corpus
    (root / "manifest.json").write_text("{")
    with pytest.raises(FaceDiffError, match=r"manifest\.json: not readable as JSON"):
        _ = MiniVocaset(root=str(root)).corpus
