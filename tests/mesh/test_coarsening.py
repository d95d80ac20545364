"""Down-sampling: what holds for any mesh, and a sphere's surface."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from facediff.mesh.hierarchy import Coarse, Operator, Pooling, coarsen
from facediff.mesh.mesh import surface_area
from tests.fakes.biwi import faces_of
from tests.fakes.meshes import relief, sphere, together

ROOT = Path(__file__).parents[2]
Mesh = tuple[np.ndarray, np.ndarray]


def head() -> Mesh:
    """A sheet with a border, two eyeballs behind it, and two vertices in no face, one of them the first."""
    ball, faces = sphere(6, 8)
    points, corners = together(relief(20, 22), (0.1 * ball + [0.3, 0.2, 0.8], faces), (0.1 * ball, faces))
    return np.concatenate([[[0, 0, 2.0]], points, [[0.5, 0.5, 0.5]]]), corners + 1


def flat() -> Mesh:
    """BIWI's fake topology, all in one plane."""
    row, column = np.divmod(np.arange(64), 8)
    return np.stack([column, -row, 0 * row], -1).astype(float), faces_of(64)


MESHES: dict[str, Callable[[], Mesh]] = {
    "sphere": lambda: sphere(15, 20),
    "head": head,
    "flat": flat,
    "two triangles": lambda: (np.eye(8, 3), np.array([[0, 1, 2], [5, 6, 7]])),
    "no faces": lambda: (np.random.default_rng(0).normal(size=(21, 3)), np.zeros((0, 3), int)),
    "one place": lambda: (np.zeros((12, 3)), np.array([[0, 1, 2], [2, 3, 4]])),
}


def dense(operator: Operator) -> np.ndarray:
    matrix = np.zeros(operator.shape)
    np.add.at(matrix, (operator.rows, operator.columns), operator.weights)
    return matrix


def made(name: str, pooling: Pooling, factor: float = 4) -> tuple[np.ndarray, np.ndarray, Coarse]:
    points, faces = MESHES[name]()
    return points, faces, coarsen(points, faces, int(np.ceil(len(points) / factor)), pooling)


@pytest.mark.parametrize("factor", [1, 1.2, 4, 1000])
@pytest.mark.parametrize("pooling", ["select", "mean"])
@pytest.mark.parametrize("name", MESHES)
def test_operators_of_any_mesh(name: str, pooling: Pooling, factor: float) -> None:
    points, faces, coarse = made(name, pooling, factor)
    count = int(np.ceil(len(points) / factor))
    assert coarse.template.shape == (count, 3)
    assert coarse.down.shape == (count, len(points))
    assert (np.diff(coarse.down.rows) >= 0).all()
    assert coarse.down.weights.min() >= 0
    np.testing.assert_allclose(dense(coarse.down).sum(1), 1, atol=1e-6)
    values = np.random.default_rng(1).normal(size=(len(points), 2))
    np.testing.assert_allclose(coarse.down.apply(values), dense(coarse.down) @ values, atol=1e-9)
    assert sorted(set(coarse.clusters)) == list(range(count))  # every vertex is in one cluster, none is empty
    down = dense(coarse.down)
    members = coarse.clusters == np.arange(count)[:, None]
    if pooling == "mean":
        np.testing.assert_allclose(down, members / members.sum(1, keepdims=True), atol=1e-7)
    else:
        assert (down.max(1) == 1).all()
        assert members[down > 0].all()
    np.testing.assert_allclose(coarse.template, down @ points, atol=1e-6)
    if len(coarse.faces):
        assert all(len(set(face)) == 3 for face in coarse.faces.tolist())
        assert len({frozenset(face) for face in coarse.faces.tolist()}) == len(coarse.faces)
    if factor == 1:
        np.testing.assert_array_equal(down, np.eye(count))
        np.testing.assert_array_equal(coarse.faces, faces)


def test_the_chosen_vertex_is_the_one_nearest_to_the_mean() -> None:
    points, _, coarse = made("head", "select")
    for row, chosen in enumerate(coarse.down.columns):
        members = np.flatnonzero(coarse.clusters == row)
        away = np.linalg.norm(points[members] - points[members].mean(0), axis=1)
        assert np.linalg.norm(points[chosen] - points[members].mean(0)) == pytest.approx(away.min())


def test_parts_stay_apart_and_loose_vertices_join_the_nearest() -> None:
    points, _, coarse = made("head", "select")
    parts = np.repeat([0, 1, 2], [440, 50, 50])
    clusters = coarse.clusters[1:-1]
    assert all(len(set(parts[clusters == cluster])) == 1 for cluster in set(clusters))
    for loose in (0, len(points) - 1):
        near = np.linalg.norm(points[1:-1] - points[loose], axis=1).argmin()
        assert coarse.clusters[loose] == clusters[near]


@pytest.mark.parametrize("pooling", ["select", "mean"])
def test_a_spheres_surface_survives(pooling: Pooling) -> None:
    points, faces = sphere(40, 50)
    count = -(-len(points) // 4)
    coarse = coarsen(points, faces, count, pooling)
    assert len(coarse.faces) == 2 * count - 4  # Euler: a closed surface without handles
    assert surface_area(coarse.template, coarse.faces) == pytest.approx(surface_area(points, faces), rel=0.02)
    corners = coarse.template[coarse.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = (normals * corners.mean(1)).sum(1)
    assert np.mean(outwards > 0) > 0.99
    sizes = np.bincount(coarse.clusters)
    assert np.quantile(sizes, 0.95) <= 12


def test_the_unit_does_not_matter() -> None:
    points, faces = relief(24, 20)
    coarse, other = coarsen(points, faces, 120), coarsen(1024 * points, faces, 120)
    np.testing.assert_array_equal(coarse.clusters, other.clusters)


def test_a_border_stays_where_it_is() -> None:
    points, faces = relief(40, 36)
    coarse = coarsen(points, faces, 360)
    assert surface_area(coarse.template, coarse.faces) == pytest.approx(surface_area(points, faces), rel=0.03)


def test_equal_bytes_in_another_process(tmp_path: Path) -> None:
    program = (
        "import sys; import numpy as np\n"
        "from facediff.mesh.hierarchy import coarsen\n"
        "from tests.fakes.meshes import relief\n"
        "c = coarsen(*relief(30, 25), 190)\n"
        "sys.stdout.buffer.write(b''.join(np.ascontiguousarray(x).tobytes() for x in "
        "(c.template, c.faces, c.clusters, c.down.columns)))"
    )
    runs = [subprocess.run([sys.executable, "-c", program], capture_output=True, cwd=ROOT, timeout=100) for _ in "ab"]
    assert runs[0].returncode == 0, runs[0].stderr
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout) > 1000
