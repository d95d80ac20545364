"""A small ragged corpus of files in many forms, and the released scripts' arithmetic again in plain NumPy."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from facediff.evaluation import EvaluationReport, evaluate
from facediff.metrics import PROTOCOLS, Region
from facediff.utils.pickles import load_pickle

VERTICES = 20
LIPS = (1, 2, 7, 11)
UPPER = (0, 5, 13, 18, 19)
LENGTHS = {"A_e01": 9, "A_e02": 1, "A_e03": 14, "B_C_e01": 6, "B_C_e02": 11}
OF_VERTICES = [name for name, setting in PROTOCOLS.items() if not setting.of_parameters]
Array = NDArray[Any]
# How files in the wild differ, one form a clip.
FORMS = (
    lambda array: array.astype("<f4").reshape(len(array), -1),
    lambda array: array.astype("<f8"),
    lambda array: np.asfortranarray(array.astype("<f4").reshape(len(array), -1)),
    lambda array: array.astype(">f4"),
    lambda array: array.astype("<f2").reshape(len(array), -1),
)


@dataclass
class Files:
    """Where everything lies, and what the files say, read again in float64."""

    root: Path

    @property
    def truth(self) -> Path:
        return self.root / "vertices_npy"

    def method(self, name: str = "ours") -> Path:
        return self.root / name

    def write(self, path: Path, array: Array, form: int = 0) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, FORMS[form % len(FORMS)](array))

    def read(self, path: Path) -> Array:
        return np.load(path).astype(np.float64).reshape(-1, VERTICES, 3)

    @property
    def templates(self) -> dict[str, Array]:
        loaded: dict[str, Array] = load_pickle(self.root / "templates.pkl")
        return loaded

    def evaluate(self, *methods: str, **options: object) -> EvaluationReport:
        """The evaluator with this corpus's regions and templates."""
        defaults: dict[str, Any] = {
            "lips": Region.from_indices("lips", LIPS),
            "upper_face": Region.from_indices("upper", UPPER),
            "templates": {name: torch.from_numpy(still).float() for name, still in self.templates.items()},
            "n_vertices": VERTICES,
            "bootstrap": 0,
        }
        folders = {method: self.method(method) for method in methods or ("ours",)}
        return evaluate(folders, options.pop("truth", self.truth), **{**defaults, **options})


def write_corpus(root: Path, *, seed: int = 0) -> Files:
    """Truth of two people, one with an underscore in the name, and predictions of two methods for all clips."""
    files = Files(root)
    rng = np.random.default_rng(seed)
    templates = {name: rng.uniform(-1, 1, (VERTICES, 3)).astype(np.float32) for name in ("A", "B_C")}
    (root / "regions").mkdir(parents=True)
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    (root / "regions" / "lve.txt").write_text(", ".join(map(str, (*LIPS, LIPS[0]))))
    (root / "regions" / "fdd.txt").write_text(",".join(map(str, UPPER)))
    for place, (clip, frames) in enumerate(LENGTHS.items()):
        subject = clip.rpartition("_")[0]
        motion = 0.1 * rng.standard_normal((frames, VERTICES, 3))
        files.write(files.truth / f"{clip}.npy", templates[subject] + motion, place)
        for method, noise in (("ours", 0.02), ("theirs", 0.05)):
            error = noise * rng.standard_normal(motion.shape)
            # The forms of one clip's two files differ.
            path = files.method(method) / f"{clip}_condition_{subject}.npy"
            files.write(path, templates[subject] + 0.8 * motion + error, place + 1)
    return files


@pytest.fixture(scope="session")
def shared_files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """For tests that do not write."""
    return write_corpus(tmp_path_factory.mktemp("evaluate") / "corpus")


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return write_corpus(tmp_path / "corpus")


def expected(truths: list[Array], predictions: list[Array], templates: list[Array]) -> dict[str, float]:
    """Every protocol's numbers from whole arrays, as the released scripts have them, cut to the shorter."""
    pairs = []
    for true, predicted in zip(truths, predictions, strict=True):
        frames = min(len(true), len(predicted))
        pairs.append((true[:frames], predicted[:frames]))
    true_all = np.concatenate([true for true, _ in pairs])
    predicted_all = np.concatenate([predicted for _, predicted in pairs])
    lips = np.array([np.square(true_all[:, v] - predicted_all[:, v]).sum(-1) for v in LIPS]).max(0)
    distances = np.linalg.norm(true_all - predicted_all, axis=2)
    signed = []
    for (true, predicted), still in zip(pairs, templates, strict=True):
        spread = [
            np.mean([np.std(np.square(motion[:, v] - still[v]).sum(-1)) for v in UPPER]) for motion in (true, predicted)
        ]
        signed.append(spread[0] - spread[1])
    ends = np.cumsum([0, *(len(true) for true, _ in pairs)])
    each = [lips[start:stop].mean() for start, stop in zip(ends, ends[1:], strict=False)]
    absolute = np.mean(np.abs(signed))
    return {
        "paper/mve": distances.mean(),
        "paper/lve": lips.mean(),
        "paper/fdd": absolute,
        "paper_text/mve": distances.max(1).mean(),
        "paper_text/lve": np.sqrt(lips).mean(),
        "paper_text/fdd": absolute,
        "codetalker/lve": lips.mean(),
        "codetalker/fdd": np.mean(signed),
        "facediffuser/mve": distances.mean(),
        "facediffuser/lve": lips.mean(),
        "facediffuser/fdd": np.mean(signed),
        "facediffuser/fdd_absolute": absolute,
        "diffspeaker/lve": np.mean(each),
        "diffspeaker/fdd": np.mean(signed),
        "meshtalk/lve": np.sqrt(lips).mean(),
        "unitalker/mve": distances.mean(),
        "unitalker/lve": lips.mean(),
    }


def scores_of(report: EvaluationReport, method: int = 0) -> dict[str, float]:
    return {f"{score.protocol}/{score.metric}": score.value for score in report.methods[method].scores}
