"""The hierarchy's levels, and the files that keep it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.mesh import hierarchy as module
from facediff.mesh.hierarchy import MeshHierarchy, coarsen, mesh_hierarchy
from facediff.mesh.spirals import spirals
from tests.fakes.meshes import relief, sphere, together

MESH = relief(16, 18)


def same(one: MeshHierarchy, other: MeshHierarchy) -> bool:
    try:
        np.testing.assert_equal(asdict(one), asdict(other))
    except AssertionError:
        return False
    return True


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Vertices asked of the simplification, call by call."""
    calls: list[int] = []

    def counted(*args: Any) -> Any:  # noqa: ANN401
        calls.append(args[2])
        return coarsen(*args)

    monkeypatch.setattr(module, "coarsen", counted)
    return calls


def test_levels_follow_from_the_parts(tmp_path: Path) -> None:
    made = mesh_hierarchy(*MESH, levels=2, spiral_length=9, dilation=2, cache=tmp_path)
    template, faces = MESH[0].astype(np.float32).astype(float), MESH[1]
    assert [level.n_vertices for level in made.levels] == [288, 72, 18]
    for level in made.levels[:2]:
        np.testing.assert_array_equal(level.faces, faces)
        np.testing.assert_array_equal(level.spirals, spirals(faces, len(template), 9, 2, template))
        coarse = coarsen(template, faces, -(-len(template) // 4))
        for mine, theirs in ((level.down, coarse.down), (level.up, coarse.up)):
            assert mine is not None
            np.testing.assert_equal(asdict(mine), asdict(theirs))
        template, faces = coarse.template, coarse.faces
    last = made.levels[2]
    assert last.down is last.up is None
    np.testing.assert_array_equal(last.spirals, spirals(faces, 18, 9, 2, template))


@pytest.mark.parametrize("vertices", [23, 64, 1008])
def test_numbers_of_vertices_depend_on_sizes_alone(vertices: int, tmp_path: Path) -> None:
    sizes = [vertices]
    for _ in range(3):
        sizes.append(-(-sizes[-1] // 4))
    ball, faces = sphere(vertices // 7 - 1, 7)
    surface = (np.concatenate([ball, np.ones((vertices - len(ball), 3))]), faces)
    cloud = (np.random.default_rng(0).normal(size=(vertices, 3)), np.array([[0, 1, 2]]))
    for mesh in (surface, cloud):
        assert [level.n_vertices for level in mesh_hierarchy(*mesh, cache=tmp_path).levels] == sizes


def test_the_second_call_reads_the_file(tmp_path: Path, count: list[int]) -> None:
    first = mesh_hierarchy(*MESH, cache=tmp_path)
    assert count == [72, 18, 5]
    second = mesh_hierarchy(*MESH, cache=tmp_path)
    assert len(count) == 3
    assert same(first, second)
    assert len(list(tmp_path.iterdir())) == 1
    assert all(level.spirals.dtype == np.int64 for level in second.levels)


@pytest.mark.parametrize("damage", ["empty", "cut", "bit", "text", "member", "pickle"])
def test_a_damaged_file_is_computed_again(tmp_path: Path, count: list[int], damage: str) -> None:
    first = mesh_hierarchy(*MESH, cache=tmp_path)
    [file] = tmp_path.iterdir()
    whole = file.read_bytes()
    if damage == "member":
        arrays = {name: array for name, array in first.arrays().items() if name != "1.down.columns"}
        np.savez(file, **arrays)
    elif damage == "pickle":
        np.savez(file, **(first.arrays() | {"0.spirals": np.array([print], object)}))
    else:
        broken = bytearray(whole)
        broken[len(whole) // 3] ^= 4
        file.write_bytes({"empty": b"", "cut": whole[:-500], "bit": bytes(broken), "text": b"not a zip"}[damage])
    count.clear()
    assert same(mesh_hierarchy(*MESH, cache=tmp_path), first)
    assert len(count) == 3
    assert file.read_bytes() == whole  # equal input, equal bytes


def test_whatever_matters_is_in_the_key(tmp_path: Path, count: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    points, faces = MESH
    moved = points.copy()
    moved[100, 0] += 1e-3
    calls: list[dict[str, Any]] = [
        {},
        {"template": moved},
        {"faces": faces[:-1]},
        {"faces": faces[::-1]},
        {"levels": 2},
        {"factor": 3},
        {"spiral_length": 11},
        {"dilation": 2},
        {"pooling": "mean"},
        {"vertices": np.arange(200)},
    ]
    for number, options in enumerate(calls, 1):
        mesh_hierarchy(**{"template": points, "faces": faces, "cache": tmp_path, **options})
        assert len(list(tmp_path.iterdir())) == number
    for name, value in (("VERSION", 99), ("version", lambda _: "0.0.1")):
        monkeypatch.setattr(module, name, value)
        number += 1
        mesh_hierarchy(*MESH, cache=tmp_path)
        assert len(list(tmp_path.iterdir())) == number
    before = len(count)
    mesh_hierarchy(points.astype(np.float32), faces.astype(np.uint16), cache=tmp_path)  # only another type
    assert len(count) == before


def test_the_usual_folder_and_none_to_write_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: list[int]
) -> None:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    first = mesh_hierarchy(*MESH)
    assert len(list((tmp_path / "cache" / "topology").glob("*.npz"))) == 1
    (tmp_path / "file").touch()
    assert same(mesh_hierarchy(*MESH, cache=tmp_path / "file"), first)
    assert len(count) == 6


def test_a_face_without_its_eyeballs(tmp_path: Path) -> None:
    ball, corners = sphere(5, 6)
    points, faces = together((0.1 * ball, corners), MESH, (0.1 * ball + 3, corners))
    chosen = np.arange(32, 32 + 288)
    part = mesh_hierarchy(points, faces, vertices=chosen[::-1], cache=tmp_path)
    alone = mesh_hierarchy(*MESH, cache=tmp_path)
    assert part.n_vertices == 352
    assert part.vertices is not None
    np.testing.assert_array_equal(part.vertices, chosen)
    np.testing.assert_equal([asdict(level) for level in part.levels], [asdict(level) for level in alone.levels])
    assert same(mesh_hierarchy(points, faces, vertices=chosen, cache=tmp_path), part)
