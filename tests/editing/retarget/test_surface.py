"""Nearest points, pieces and smooth fields against brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from facediff.editing.correspondence import averaging, part_pairs, pieces, smooth_field
from facediff.editing.surface import Surface, edges_of, nearest

RNG = np.random.default_rng(0)


def ball(level: int = 2, centre: tuple[float, float, float] = (0, 0, 0), radius: float = 1.0) -> Surface:
    mesh = trimesh.creation.icosphere(level)
    return Surface(np.array(mesh.vertices) * radius + centre, np.array(mesh.faces))


def together(*surfaces: Surface) -> Surface:
    before = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
    return Surface(
        np.concatenate([surface.vertices for surface in surfaces]),
        np.concatenate([surface.faces + first for surface, first in zip(surfaces, before, strict=False)]),
    )


def test_no_point_of_the_surface_is_nearer() -> None:
    """Against a dense cloud of points on every triangle of a mesh with long and short ones."""
    mesh = ball(1)
    mesh = Surface(mesh.vertices * [1.0, 3.0, 0.2], mesh.faces)
    points = RNG.normal(0, 1.0, (25, 3))
    found = nearest(mesh, points, np.zeros((25, 3)))
    cloud = RNG.dirichlet([0.5, 0.5, 0.5], 2000) @ mesh.vertices[mesh.faces]
    best = np.linalg.norm(points[:, None] - cloud.reshape(1, -1, 3), axis=2).min(axis=1)
    assert (found.distances <= best + 1e-12).all()
    assert found.weights.min() >= 0
    assert found.weights.sum(axis=1) == pytest.approx(1)
    assert np.einsum("nc,ncd->nd", found.weights, mesh.vertices[found.corners]) == pytest.approx(found.points)
    assert np.linalg.norm(points - found.points, axis=1) == pytest.approx(found.distances)
    assert (best - found.distances).max() < 0.05


def test_of_two_sheets_the_one_that_faces_the_same_way_is_taken() -> None:
    """Two lips that touch: the nearer one faces away."""
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    corners = np.array([[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1.0]])
    lips = Surface(np.concatenate([corners, corners + [0, 0.01, 0]]), np.concatenate([quad, quad[:, ::-1] + 4]))
    up = lips.normals[0]
    assert up == pytest.approx([0, 1, 0])
    at = np.array([[0.2, 0.008, 0.1]] * 2)
    found = nearest(lips, at, np.stack([up, -up]))
    assert (found.corners[0] < 4).all()
    assert (found.corners[1] >= 4).all()
    # Beyond what the choice may cost, the nearer one is taken however it faces.
    far = nearest(lips, at + [0, 0.5, 0], np.stack([up, -up]), size=1e-3)
    assert (far.corners >= 4).all()


def test_normals_of_a_ball_point_away_and_do_not_depend_on_the_cut() -> None:
    mesh = ball(3)
    assert (mesh.normals * mesh.vertices).sum(axis=1) == pytest.approx(1, abs=2e-3)
    cube = trimesh.creation.box()
    normals = Surface(np.array(cube.vertices), np.array(cube.faces)).normals
    assert np.abs(normals) == pytest.approx(np.full((8, 3), 3**-0.5))


def test_pieces_find_their_partners() -> None:
    """Two small balls close to one another in a large one, and their copies a little moved and bent."""
    upper, lower = ball(1, (0, 0.12, 0.5), 0.1), ball(1, (0, -0.12, 0.5), 0.1)
    source = together(ball(2), upper, lower)
    assert len(np.unique(pieces(source))) == 3
    moved = together(lower, ball(1), upper)
    laid = Surface(moved.vertices + [0, 0.03, 0], moved.faces)
    places = part_pairs(source, laid)
    found = places.nearest(laid.vertices, laid.normals)
    count = len(lower.vertices)
    assert (found.corners[:count] >= len(source.vertices) - count).all()
    assert (found.corners[count:-count] < len(source.vertices) - 2 * count).all()
    assert sorted(np.concatenate([some for some, _ in places.parts])) == list(range(len(laid.vertices)))


def test_seams_do_not_part_a_mesh() -> None:
    mesh = ball(1)
    split = Surface(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))
    assert len(np.unique(pieces(split))) == 1


def test_a_smooth_field_solves_its_equations() -> None:
    mesh = ball(2)
    edges = edges_of(mesh.faces)
    assert len(edges) == len(mesh.vertices) + len(mesh.faces) - 2  # Euler
    values, trust = RNG.normal(size=mesh.vertices.shape), RNG.uniform(0, 1, len(mesh.vertices)) ** 3
    laplacian = np.zeros((len(trust),) * 2)
    for a, b in edges:
        laplacian[[a, b], [a, b]] += 1
        laplacian[[a, b], [b, a]] -= 1
    found = smooth_field(values, trust, edges, 2.5)
    exact = np.linalg.solve(np.diag(trust) + 2.5 * laplacian, trust[:, None] * values)
    assert found == pytest.approx(exact, abs=1e-6)
    assert smooth_field(values, np.ones(len(trust)), edges, 0.0) == pytest.approx(values, abs=1e-6)
    assert not smooth_field(values, np.zeros(len(trust)), edges, 1.0).any()


def test_averaging_is_the_mean_of_neighbours_where_trust_is_little() -> None:
    mesh = ball(1)
    trust = np.ones(len(mesh.vertices))
    assert averaging(trust, mesh.faces) is None
    trust[[3, 7]] = 0.25, 0.0
    matrix = averaging(trust, mesh.faces)
    assert matrix is not None
    rows = matrix.toarray()
    for vertex in range(len(trust)):
        near = {int(v) for face in mesh.faces if vertex in face for v in face} - {vertex}
        expected = np.zeros(len(trust))
        expected[list(near)] = (1 - trust[vertex]) / len(near)
        assert rows[vertex] == pytest.approx(expected)


def test_pieces_that_moved_towards_one_anothers_places_keep_their_partners() -> None:
    """The lower of two balls lies nearer to where the upper one was than to its own place."""
    upper, lower = ball(1, (0, 0.12, 0.5), 0.2), ball(1, (0, -0.03, 0.5), 0.2)
    source = together(ball(2), upper, lower)
    laid = Surface(source.vertices + [0, 0.1, 0], source.faces)
    found = part_pairs(source, laid).nearest(laid.vertices, laid.normals)
    count = len(lower.vertices)
    assert (found.corners[-count:] >= len(source.vertices) - count).all()
