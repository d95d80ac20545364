"""Spirals against orders written down by hand, and what holds for every mesh."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.mesh.spirals import spirals
from tests.fakes.meshes import relief, sphere, together

FAN = np.array([[0, i, i % 6 + 1] for i in range(1, 7)])


def hexagons() -> tuple[np.ndarray, np.ndarray]:
    """A centre (0), six around it (1 … 6) and twelve around these (7 … 18), each ring counter-clockwise from +x."""
    ring = lambda count, radius: [  # noqa: E731
        (radius * np.cos(2 * np.pi * k / count), radius * np.sin(2 * np.pi * k / count), 0.0) for k in range(count)
    ]
    faces = [(0, 1 + k, 1 + (k + 1) % 6) for k in range(6)]
    for k in range(6):
        inner, after = 1 + k, 1 + (k + 1) % 6
        corner, middle, following = 7 + 2 * k, 8 + 2 * k, 7 + (2 * k + 2) % 12
        faces += [(inner, corner, middle), (inner, middle, after), (after, middle, following)]
    return np.array([(0, 0, 0), *ring(6, 1), *ring(12, 2)]), np.array(faces)


def test_a_fan_by_hand() -> None:
    table = spirals(FAN, 7, 7)
    assert table[0].tolist() == [0, 1, 2, 3, 4, 5, 6]
    # Round vertex 1 the fan is open: along the border from 2 over the centre to 6; then what is new round 2, 0, 6.
    assert table[1].tolist() == [1, 2, 0, 6, 3, 4, 5]
    assert table[4].tolist() == [4, 5, 0, 3, 6, 1, 2]


def test_winding_gives_the_direction() -> None:
    assert spirals(FAN[:, ::-1], 7, 7)[0].tolist() == [0, 1, 6, 5, 4, 3, 2]


def test_two_rings_by_hand() -> None:
    points, faces = hexagons()
    # Vertex 1 touches 7, 8 and 18; counter-clockwise from the known neighbour 6 that is 18, 7, 8. Then 2 adds 9 and 10.
    expected = [0, 1, 2, 3, 4, 5, 6, 18, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17]
    table = spirals(faces, 19, 19)
    assert table[0].tolist() == expected
    assert spirals(faces, 19, 12)[0].tolist() == expected[:12]
    # Angles grow by one turn on each ring, which needs no knowledge of the algorithm.
    for ring in (table[0, 1:7], table[0, 7:]):
        turn = np.diff(np.unwrap(np.arctan2(points[ring, 1], points[ring, 0])))
        assert (turn > 0).all()
        assert turn.sum() < 2 * np.pi


def test_dilation_takes_every_second() -> None:
    _, faces = hexagons()
    whole = spirals(faces, 19, 12)
    np.testing.assert_array_equal(spirals(faces, 19, 6, dilation=2), whole[:, ::2])


def test_scarce_vertices_are_not_skipped_by_dilation() -> None:
    assert spirals(FAN, 7, 5, dilation=2)[0].tolist() == [0, 2, 4, 6, 1]
    assert spirals(FAN, 7, 9, dilation=3)[0].tolist() == [0, 3, 6, 1, 2, 4, 5, 0, 0]


def test_where_rings_end_the_nearest_follow() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [0, 3, 0], [0, 0, 4.0]])
    table = spirals(np.array([[0, 1, 2]]), 6, 5, template=points)
    assert table.tolist() == [
        [0, 1, 2, 4, 5],
        [1, 2, 0, 4, 3],
        [2, 0, 1, 4, 5],
        [3, 1, 0, 2, 4],
        [4, 2, 0, 1, 5],
        [5, 0, 1, 2, 4],
    ]


@pytest.mark.parametrize(("length", "dilation"), [(1, 1), (9, 1), (12, 1), (7, 3)])
def test_every_spiral_of_a_closed_part_is_rings(length: int, dilation: int) -> None:
    points, faces = together(sphere(12, 14), relief(9, 8))
    points = np.concatenate([points, [[3, 3, 3], [4, 4, 4]]])  # in no face
    table = spirals(faces, len(points), length, dilation, points)
    assert table.shape == (len(points), length)
    assert (table[:, 0] == np.arange(len(points))).all()
    assert all(len(set(row)) == length for row in table.tolist())
    assert np.array_equal(table, spirals(faces, len(points), length, dilation, points))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    near = np.full((len(points), len(points)), 99)
    near[edges[:, 0], edges[:, 1]] = near[edges[:, 1], edges[:, 0]] = 1
    np.fill_diagonal(near, 0)
    for middle in range(170):  # Floyd and Warshall's shortest paths, on the sphere alone
        near[:170, :170] = np.minimum(near[:170, :170], near[:170, middle, None] + near[middle, :170])
    distance = np.take_along_axis(near, table, 1)[:170]
    assert (np.diff(distance, axis=1) >= 0).all()
    if (length, dilation) == (12, 1):  # a regular vertex: itself, six on the first ring, five on the second
        assert (np.median(distance, axis=0) == [0, *[1] * 6, *[2] * 5]).all()


@pytest.mark.parametrize(
    "faces",
    [
        [[0, 1, 2], [0, 3, 4]],  # two fans that touch in a vertex
        [[0, 1, 2], [0, 2, 1], [0, 1, 3]],  # three faces at an edge
        [[0, 1, 2], [0, 1, 3], [0, 4, 2]],  # wound against one another
        [[0, 0, 1], [1, 2, 3], [2, 4, 3]],  # a face that names a vertex twice
    ],
)
def test_meshes_that_are_no_surface_keep_all_neighbours(faces: list[list[int]]) -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    table = spirals(np.array(faces), 5, 5, template=points)
    assert all(sorted(row) == [0, 1, 2, 3, 4] for row in table.tolist())
    for vertex, row in enumerate(table.tolist()):
        joined = {corner for face in faces if vertex in face and len(set(face)) == 3 for corner in face} - {vertex}
        assert set(row[1 : 1 + len(joined)]) == joined
