"""Motion files that are damaged, absurd or hostile are refused by name."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.data.corpus import Corpus
from facediff.errors import FaceDiffError
from tests.speech.test_audio import wave

FACE = np.random.default_rng(0).normal(size=(9, 3))


def corpus(root: Path, clip: str = "A_01") -> Corpus:
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    (root / "wav" / f"{clip}.wav").write_bytes(wave(body=bytes(32_000)))
    np.save(root / "vertices_npy" / f"{clip}.npy", np.tile(FACE.ravel(), (25, 1)).astype(np.float32))
    (root / "templates.pkl").write_bytes(pickle.dumps({"A": FACE}))
    return Corpus(root, 9, 25.0)


def test_hidden_files_are_no_clips(tmp_path: Path) -> None:
    corpus(tmp_path)
    for place in ("wav/._A_01.wav", "vertices_npy/._A_01.npy"):  # as macOS adds them on disks of other systems
        (tmp_path / place).write_bytes(b"\0\5\x16\7")
    assert list(Corpus(tmp_path, 9, 25.0).clips) == ["A_01"]


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300, 3e37, -3e37])
def test_motion_that_is_not_finite_is_refused_by_frame(value: float, tmp_path: Path) -> None:
    opened = corpus(tmp_path)
    motion = np.tile(FACE.ravel(), (25, 1))
    motion[7, 3] = value
    np.save(tmp_path / "vertices_npy" / "A_01.npy", motion)
    with pytest.raises(FaceDiffError, match=r"A_01\.npy: frame 7"):
        opened.read_motion(opened.clips["A_01"])


def test_weights_are_averaged_and_projected_as_their_vertices_are(tmp_path: Path) -> None:
    opened, random = corpus(tmp_path), np.random.default_rng(1)
    (tmp_path / "vertices_npy" / "A_01.npy").unlink()
    (tmp_path / "weights_npy").mkdir()
    (tmp_path / "rigs").mkdir()
    rig = np.concatenate([FACE[None] + 0.01, random.normal(size=(4, 9, 3))]).astype(np.float32)
    weights = random.random((25, 4)).astype(np.float32)
    np.save(tmp_path / "rigs" / "A.npy", rig)
    np.save(tmp_path / "weights_npy" / "A_01.npy", weights)
    clip, into = opened.clips["A_01"], torch.from_numpy(random.normal(size=(27, 5)).astype(np.float32))
    motion = np.einsum("tk,kvc->tvc", weights, rig[1:]) + rig[0] - FACE
    np.testing.assert_allclose(opened.read_motion(clip), motion, atol=1e-5)
    np.testing.assert_allclose(opened.mean_motion(clip), motion.mean(0), atol=1e-5)
    kept: dict[str, torch.Tensor] = {}
    for _ in range(2):  # the second time from what is kept of the speaker's shapes
        projected = opened.read_projected(clip, lambda offsets: offsets.flatten(1) @ into - 3.0, kept)
        np.testing.assert_allclose(projected, motion.reshape(25, 27) @ into.numpy() - 3.0, atol=1e-4)
    weights[7, 2] = math.nan
    np.save(tmp_path / "weights_npy" / "A_01.npy", weights)
    for read in (opened.mean_motion, lambda clip: opened.read_projected(clip, torch.relu, kept)):
        with pytest.raises(FaceDiffError, match=r"A_01\.npy: frame 7"):
            read(clip)
