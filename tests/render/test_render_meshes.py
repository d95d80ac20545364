"""Normals, winding, edges and hollows of meshes."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from facediff.render.meshes import (
    VertexSums,
    face_outward,
    hollowness,
    is_open,
    vertex_normals,
)

MakeSphere = Callable[..., tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]]


def test_vertex_normals_of_a_sphere_are_its_positions(sphere: MakeSphere) -> None:
    vertices, faces = sphere(40, 80)
    normals = vertex_normals(vertices, faces)
    assert np.degrees(np.arccos(np.clip((normals * vertices).sum(axis=1), -1, 1))).max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)


def test_vertex_normals_weight_faces_by_area() -> None:
    # Two faces share vertex 0: one in the plane z = 0 with area 2, one in the plane x = 0 with area 0.5.
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    normal = vertex_normals(vertices, np.array([[0, 1, 2], [0, 3, 4]], np.int32))[0]
    np.testing.assert_allclose(normal, np.array([0.5, 0, 2]) / np.hypot(0.5, 2))


def test_vertex_normals_are_finite_without_faces() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], dtype=float)
    np.testing.assert_array_equal(vertex_normals(vertices, np.array([[0, 1, 2]], np.int32))[3], [0, 0, 1])


def test_face_outward_turns_either_winding(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    vertices = vertices + 7  # the origin is outside: only the flux decides
    np.testing.assert_array_equal(face_outward(faces, vertices), faces)
    np.testing.assert_array_equal(face_outward(faces[:, ::-1], vertices), faces)
    front = faces[vertices[faces][:, :, 2].min(axis=1) > 7.2]
    np.testing.assert_array_equal(face_outward(front[:, ::-1], vertices), front)


def test_is_open(sphere: MakeSphere) -> None:
    _, faces = sphere()
    assert not is_open(faces)
    assert is_open(faces[1:])


def test_hollowness_is_positive_in_hollows_and_negative_on_ridges(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    dented = vertices.copy()
    dented[500] *= 0.8
    sums = VertexSums(faces, len(vertices))
    assert hollowness(dented, vertex_normals(dented, faces), sums)[500] > 0.3
    assert hollowness(vertices, vertex_normals(vertices, faces, sums), sums).max() < 0
