"""Folders of BIWI, VOCASET and 3DMEAD in the published layout, with ten vertices."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import soundfile

from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset

VERTICES = 10


class MiniBiwi(Biwi):
    n_vertices = VERTICES


class MiniVocaset(Vocaset):
    n_vertices = VERTICES


class MiniMead(Mead3D):
    n_vertices = VERTICES


def write(root: Path, names: list[str], subjects: set[str], *, frames: int = 6, rate: int = 16000) -> Path:
    """The smallest folder in the peers' layout."""
    for folder in ("wav", "vertices_npy", "regions"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    templates = {subject: rng.normal(size=(VERTICES, 3)) for subject in sorted(subjects)}
    for name in names:
        subject = next(s for s in subjects if name.startswith(s))
        motion = templates[subject].ravel() + rng.normal(0, 0.01, (frames, VERTICES * 3))
        np.save(root / "vertices_npy" / f"{name}.npy", motion)
        soundfile.write(root / "wav" / f"{name}.wav", rng.uniform(-0.1, 0.1, frames * rate // 25), rate)
    (root / "templates.pkl").write_bytes(pickle.dumps(templates, protocol=2))
    (root / "regions" / "lve.txt").write_text("0, 1, 2")
    (root / "regions" / "fdd.txt").write_text("5,6")
    return root


def names_of(data: SpeechMotionDataModule) -> dict[str, list[str]]:
    return {s: [clip.name for clip in data.clips(s)] for s in ("train", "val", "test_a", "test_b")}


SEEN = ["F2", "F3", "F4", "M3", "M4", "M5"]


UNSEEN = ["F1", "F5", "F6", "F7", "F8", "M1", "M2", "M6"]
