"""Shapes from folders and .glb files: names, units, axes and everything that may be wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.editing.shapes import ShapeSet, read_shapes
from facediff.errors import FaceDiffError
from tests.fakes.glb_targets import glb_with_targets
from tests.fakes.meshes import write_obj

RNG = np.random.default_rng(0)
GRID = np.array([[x, y, 0.3 * np.sin(2 * x) * np.cos(y)] for y in range(6) for x in range(6)]) * 0.03
FACES = np.array(
    [
        f
        for y in range(5)
        for x in range(5)
        for f in ((6 * y + x, 6 * y + x + 1, 6 * y + x + 7), (6 * y + x, 6 * y + x + 7, 6 * y + x + 6))
    ]
)
DELTAS = {name: RNG.normal(0, 0.004, GRID.shape) for name in ("jawOpen", "EyeBlink_L", "browInnerUp", "fancy")}
NAMES = ("eyeBlinkLeft", "browInnerUp", "fancy", "jawOpen")  # files in the order of their names


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_obj(tmp_path / "Neutral.obj", GRID, FACES)
    for name, delta in DELTAS.items():
        write_obj(tmp_path / f"{name}.obj", GRID + delta, FACES)
    (tmp_path / "notes.txt").write_text("not a mesh")
    return tmp_path


def check(made: ShapeSet, deltas: dict[str, np.ndarray] = DELTAS) -> None:
    known = {"EyeBlink_L": "eyeBlinkLeft"}
    assert set(made.names) == {known.get(name, name) for name in deltas}
    for name, delta in deltas.items():
        assert made.deltas[made.names.index(known.get(name, name))] == pytest.approx(delta, rel=1e-6, abs=2e-8)


def test_a_folder_of_obj(folder: Path) -> None:
    made = read_shapes(folder, GRID.astype(np.float32))
    check(made)
    assert made.names == NAMES
    assert made.extra == ("fancy",)
    assert len(made.absent) == 49
    assert any("fancy" in note for note in made.notes)


def test_a_folder_of_ply(tmp_path: Path) -> None:
    for name, delta in {"basis": 0 * GRID, **DELTAS}.items():
        trimesh.Trimesh(GRID + delta, FACES, process=False).export(tmp_path / f"{name}.ply")
    made = read_shapes(tmp_path, GRID)
    assert made.deltas[made.names.index("jawOpen")] == pytest.approx(DELTAS["jawOpen"], abs=1e-7)


def test_shapes_in_another_unit_and_with_z_up_are_laid_onto_the_template(folder: Path) -> None:
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    for name, delta in {"Neutral": 0 * GRID, **DELTAS}.items():
        write_obj(folder / f"{name}.obj", 100 * (GRID + delta) @ turn.T + 7, FACES)
    made = read_shapes(folder, GRID)
    check(made)
    assert any("turned by 90°" in note for note in made.notes)
    assert any("scaled by 0.01" in note for note in made.notes)


def test_without_a_neutral_face_the_template_is_it(tmp_path: Path) -> None:
    deltas = {f"shape{k}": np.where(np.arange(36)[:, None] % 9 == k, RNG.normal(0, 0.01, (36, 3)), 0) for k in range(9)}
    for name, delta in deltas.items():
        write_obj(tmp_path / f"{name}.obj", GRID + delta, FACES)
    made = read_shapes(tmp_path, GRID)
    check(made, deltas)
    assert any("no neutral face" in note for note in made.notes)
    with pytest.raises(FaceDiffError, match="add the face at rest that they were made from as neutral.obj"):
        read_shapes(tmp_path, GRID + 0.005 * np.sin(100 * GRID[:, :1]))


def test_shapes_that_differ_among_themselves_are_refused(folder: Path) -> None:
    write_obj(folder / "fancy.obj", GRID[:30], FACES[:40])
    with pytest.raises(FaceDiffError, match=r"fancy.obj: has 30 vertices, or other triangles, and Neutral.obj 36"):
        read_shapes(folder, GRID)
    write_obj(folder / "fancy.obj", GRID, FACES[::-1])
    with pytest.raises(FaceDiffError, match="or other triangles, and Neutral.obj"):
        read_shapes(folder, GRID)
    broken = GRID.copy()
    broken[3, 1] = np.nan
    write_obj(folder / "fancy.obj", broken, FACES)
    with pytest.raises(FaceDiffError, match=r"fancy.obj: holds NaN"):
        read_shapes(folder, GRID)
    for file in folder.glob("*.obj"):
        file.unlink()
    with pytest.raises(FaceDiffError, match="holds 0 shapes"):
        read_shapes(folder, GRID)


@pytest.mark.parametrize("sparse", [False, True])
def test_targets_of_a_glb(tmp_path: Path, sparse: bool) -> None:
    deltas = {name: np.where(RNG.uniform(size=(36, 1)) < 0.5, delta, 0.0) for name, delta in DELTAS.items()}
    glb_with_targets(GRID, FACES, deltas, sparse=sparse).write(tmp_path / "a.glb")
    check(read_shapes(tmp_path / "a.glb", GRID), deltas)
    # glTF is in metres: a template in centimetres takes shapes a hundred times as large.
    made = read_shapes(tmp_path / "a.glb", 100 * GRID, "cm")
    check(made, {name: 100 * delta for name, delta in deltas.items()})


def test_parts_of_one_mesh_are_put_together(tmp_path: Path) -> None:
    file = glb_with_targets(GRID, FACES, DELTAS)
    file.content["meshes"][0]["primitives"] *= 2
    file.write(tmp_path / "a.glb")
    made = read_shapes(tmp_path / "a.glb", np.concatenate([GRID, GRID]))
    assert made.deltas[:, :36] == pytest.approx(made.deltas[:, 36:])
