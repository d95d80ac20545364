"""Miniature corpora for the check: true names and splits, few vertices."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import soundfile

from facediff.data import Biwi, Mead3D, Vocaset
from facediff.data.check import CheckReport
from tests.fakes import biwi, vocaset

BIWI, VOCASET, MEAD = (f"tests.data.check.small.{name}" for name in ("SmallBiwi", "SmallVocaset", "SmallMead"))
"""Import paths of the data modules below."""

MEAD_VERTICES = 40
MEAD_FRAMES = {
    "M003_001_0_0": 20,
    "M003_033_0_0": 21,
    "M003_037_0_0": 22,
    "M003_024_1_2": 23,
    "W009_026_4_1": 24,
    "W009_028_6_0": 25,
    "M032_001_0_0": 26,
    "W040_030_7_2": 27,
}
"""Frames of each clip. By sentence, the last two speakers are in no split; by identity, all are in one."""


class SmallBiwi(Biwi):
    """The fake of BIWI; complete with the fake's three people and four sentences."""

    n_vertices = biwi.VERTICES

    @classmethod
    def expected_clips(cls) -> dict[str, list[str]]:
        return {
            "train": ["F2_e01", "F2_e02", "M3_e01", "M3_e02"],
            "val": ["F2_e33", "M3_e33"],
            "test_a": ["F2_e37", "M3_e37"],
            "test_b": ["F1_e37"],
        }


class SmallVocaset(Vocaset):
    """The fake of VOCASET."""

    n_vertices = vocaset.VERTICES


class SmallMead(Mead3D):
    """A few clips of 3DMEAD."""

    n_vertices = MEAD_VERTICES


def write_small_mead(root: Path) -> Path:
    """ProbTalk3D's layout: motion in ``vertex/`` as (T, V, 3), speech at 16 kHz."""
    rng = np.random.default_rng(5)
    for folder in ("vertex", "wav", "regions"):
        (root / folder).mkdir(parents=True)
    templates = {name[:4]: rng.normal(0, 0.05, (MEAD_VERTICES, 3)).astype("f4") for name in MEAD_FRAMES}
    for name, frames in MEAD_FRAMES.items():
        motion = np.repeat(templates[name[:4]][None], frames, 0)
        motion[:, :10, 1] -= 0.005 * np.sin(np.arange(frames, dtype="f4"))[:, None]
        np.save(root / "vertex" / f"{name}.npy", motion)
        soundfile.write(root / "wav" / f"{name}.wav", 0.1 * rng.normal(size=frames * 640).clip(-3, 3), 16000)
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    biwi.write_regions(root, MEAD_VERTICES, ",")
    faces = biwi.faces_of(MEAD_VERTICES)
    (root / "FLAME.ply").write_bytes(biwi.ply_bytes(templates["M003"], faces, "float", "int"))
    return root


def kinds(report: CheckReport, severity: str = "error") -> list[str]:
    return [finding.kind for finding in report.findings if finding.severity == severity]


def message(report: CheckReport, kind: str) -> str:
    return next(finding.message for finding in report.findings if finding.kind == kind)


def rows(report: CheckReport) -> dict[tuple[str | None, str], tuple[object, ...]]:
    return {
        (row["way"], row["split"]): tuple(row[key] for key in ("expected", "present", "missing", "frames", "seconds"))
        for row in report.splits
    }
