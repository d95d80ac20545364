"""A miniature corpus and two methods whose motion is the truth's and known numbers more."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from facediff.data.corpus import read_templates
from facediff.evaluation.figures import FigureData, find_clips
from facediff.mesh.mesh_files import read_mesh
from tests.fakes.tiny import RATE, VERTICES

CLIPS = ("A_e06", "A_e07", "B_e06")


@pytest.fixture(scope="session")
def methods(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {name: tmp_path_factory.mktemp("methods") / name for name in ("ours", "theirs")}
    for number, folder in enumerate(folders.values()):
        folder.mkdir()
        for place, clip in enumerate(CLIPS):
            noise = np.random.default_rng([number, place]).normal(0, 2e-3, (len(load(tiny_root, clip)), VERTICES, 3))
            moved = (load(tiny_root, clip) + noise).astype("f4")
            np.save(folder / f"{clip}_condition_{clip[0]}.npy", moved if number else moved.reshape(len(moved), -1))
    return folders


@pytest.fixture(scope="session")
def own_material(tiny_root: Path, methods: dict[str, Path]) -> FigureData:
    return make_material(tiny_root, methods)


@pytest.fixture
def damaged(tiny_root: Path, methods: dict[str, Path], tmp_path: Path) -> Callable[..., FigureData]:
    """The material with one of ours' files replaced."""

    def make(array: NDArray[np.floating], clip: str = "A_e06") -> FigureData:
        shutil.copytree(methods["ours"], tmp_path / "ours", dirs_exist_ok=True)
        np.save(tmp_path / "ours" / f"{clip}_condition_A.npy", array)
        return make_material(tiny_root, {"ours": tmp_path / "ours"})

    return make


def make_material(root: Path, methods: dict[str, Path], **options: object) -> FigureData:
    templates = read_templates(root / "templates.pkl", VERTICES)
    truths, found = find_clips(methods, root / "vertices_npy", subjects=list(templates))
    mesh = read_mesh(root / "tiny.ply")
    made = FigureData(truths, found, VERTICES, float(RATE), 1, "m", templates, mesh.faces, mesh.vertices, corpus=root)
    return replace(made, **options)  # type: ignore[arg-type]


def load(root: Path, clip: str) -> NDArray[np.float64]:
    path = root / "vertices_npy" / f"{clip}.npy"
    return np.load(path).astype(np.float64).reshape(-1, VERTICES, 3)


@pytest.fixture
def read(tiny_root: Path, methods: dict[str, Path]) -> Callable[[str, str], NDArray[np.float64]]:
    """What a file says, read in plain NumPy: of the truth or of a method."""

    def reader(name: str, clip: str) -> NDArray[np.float64]:
        if name == "truth":
            return load(tiny_root, clip)
        path = methods[name] / f"{clip}_condition_{clip[0]}.npy"
        return np.load(path).astype(np.float64).reshape(-1, VERTICES, 3)

    return reader
