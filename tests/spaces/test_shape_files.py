"""Folders of blendshapes: ICT-FaceKit's, whose halves are put together and whose other heads are left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facediff.spaces.shape_files import read_shape_files

REST = np.random.default_rng(0).normal(size=(5, 3))
FACES = "f 1 2 3 4\nf 3 4 5\n"  # a quad and a triangle


def write(path: Path, vertices: np.ndarray) -> None:
    path.write_text("".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices) + FACES)


def test_read_shape_files_of_an_ict_facekit_folder(tmp_path: Path) -> None:
    moves = {
        name: np.random.default_rng(seed).normal(size=(5, 3))
        for seed, name in enumerate(
            ("browInnerUp_L", "browInnerUp_R", "cheekPuff_L", "cheekPuff_R", "jawOpen", "eyeBlink_L"), start=1
        )
    }
    write(tmp_path / "generic_neutral_mesh.obj", REST)
    for name, move in moves.items():
        write(tmp_path / f"{name}.obj", REST + move)
    for number in (0, 99):
        write(tmp_path / f"identity{number:03d}.obj", REST + 1)
    files = read_shape_files(tmp_path)
    assert set(files.names) == {"jawOpen", "eyeBlink_L", "browInnerUp", "cheekPuff"}
    assert files.neutral is not None
    assert np.abs(files.neutral - REST).max() < 1e-6
    puffed = files.shapes[files.names.index("cheekPuff")] - files.neutral
    assert np.abs(puffed - moves["cheekPuff_L"] - moves["cheekPuff_R"]).max() < 1e-6
    assert len(files.notes) == 2
