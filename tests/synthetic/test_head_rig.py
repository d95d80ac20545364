"""The head of the second edition: quads, symmetry, and shapes that neither tear nor cross it."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from facediff.spaces.arkit import ARKIT, LEFT_AND_RIGHT
from facediff.synthetic.head.mesh import QuadMesh
from facediff.synthetic.head.parts import EYE_CENTRE, EYE_RADIUS, build_head
from facediff.synthetic.head.rig import SHAPES, eyelid_pairs, head_shapes, lip_pairs, turned

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def mesh() -> QuadMesh:
    return build_head()


def pose(mesh: QuadMesh, **weights: float) -> Array:
    """The average head with some weights; a name without a side stands for both."""
    vertices, shapes = mesh.vertices.copy(), head_shapes()
    for name, weight in weights.items():
        for side in ("Left", "Right") if name in LEFT_AND_RIGHT else ("",):
            vertices += weight * shapes[name + side]
    return vertices


TOUCHING = 0.03  # mm: lips and lids that meet lie on one another
APART = 1e-3


def crossings(vertices: Array, faces: NDArray[np.int64], among: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Pairs of an edge and a triangle that it pierces, of those that are no neighbours on the surface."""
    faces = faces[np.isin(faces, among).all(axis=1)]
    edges = np.unique(np.sort(np.concatenate([faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1), axis=0)
    near: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        near.setdefault(a, {a}).add(b)
        near.setdefault(b, {b}).add(a)
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    low = np.minimum(np.minimum(first, second), third)
    high = np.maximum(np.maximum(first, second), third)
    pairs = []
    for number, (start, end) in enumerate(edges.tolist()):
        p, q = vertices[start], vertices[end]
        candidates = np.flatnonzero((low <= np.maximum(p, q)).all(axis=1) & (high >= np.minimum(p, q)).all(axis=1))
        close = near[start] | near[end]
        candidates = np.array([face for face in candidates if close.isdisjoint(faces[face].tolist())], np.int64)
        if not len(candidates):
            continue
        # Möller and Trumbore, "Fast, minimum storage ray-triangle intersection" (1997), for a segment.
        u_axis, v_axis = second[candidates] - first[candidates], third[candidates] - first[candidates]
        across = np.cross(q - p, v_axis)
        determinant = (u_axis * across).sum(axis=1)
        usable = np.abs(determinant) > 1e-12
        scale = 1.0 / np.where(usable, determinant, 1.0)
        off = p - first[candidates]
        u = (off * across).sum(axis=1) * scale
        turned_off = np.cross(off, u_axis)
        v, t = turned_off @ (q - p) * scale, (v_axis * turned_off).sum(axis=1) * scale
        hit = usable & (u > APART) & (v > APART) & (u + v < 1 - APART) & (t > 0) & (t < 1)
        normal = np.cross(u_axis, v_axis)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        depth = np.minimum(np.abs((off * normal).sum(axis=1)), np.abs(((q - first[candidates]) * normal).sum(axis=1)))
        hit &= depth > TOUCHING
        pairs += [(number, int(face)) for face in candidates[hit]]
    return pairs


def test_every_part_looks_outwards(mesh: QuadMesh) -> None:
    """No neighbours disagree on the side they show, and every part with an inside has a positive volume."""
    faces = mesh.faces
    directed = np.concatenate([faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    assert len(np.unique(directed, axis=0)) == len(directed)
    count = len(mesh.vertices)
    links = coo_array((np.ones(len(directed)), tuple(directed.T)), (count, count))
    label = connected_components(links, directed=False)[1][faces[:, 0]]
    first, second, third = (mesh.vertices[faces[:, corner]] for corner in range(3))
    for part in np.unique(label):
        triangles = label == part
        centre = first[triangles].mean(axis=0)
        corners = (points[triangles] - centre for points in (first, second, third))
        volume = np.linalg.det(np.stack(list(corners), axis=1)).sum() / 6
        assert volume > 100 or triangles.sum() < 10  # lashes and glints are flat


def test_the_head_is_made_of_quads_and_symmetric(mesh: QuadMesh) -> None:
    assert 4500 < len(mesh.vertices) < 6000
    triangles = (mesh.quads[:, 1] == mesh.quads[:, 2]) | (mesh.quads[:, 2] == mesh.quads[:, 3])
    assert triangles.mean() < 0.05
    assert np.allclose(mesh.vertices[mesh.mirror], mesh.vertices * [-1, 1, 1])
    assert np.array_equal(mesh.mirror[mesh.mirror], np.arange(len(mesh.vertices)))
    edges = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() <= 2


def test_faces_look_outwards(mesh: QuadMesh) -> None:
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    skin = np.isin(mesh.faces, mesh.both("skin", "hair")).all(axis=1)
    outward = (normals * (corners.mean(axis=1) - np.array([0.0, 0.0, 0.0])))[:, [0, 2]].sum(axis=1)
    assert (outward[skin] > 0).mean() > 0.97
    ball = np.isin(mesh.faces, mesh.both("ball_")).all(axis=1) & (corners.mean(axis=1)[:, 0] > 0)
    assert ((normals[ball] * (corners[ball].mean(axis=1) - EYE_CENTRE)).sum(axis=1) > 0).all()


def test_shapes_are_those_of_arkit(mesh: QuadMesh) -> None:
    shapes = head_shapes()
    assert len(ARKIT) == 52
    assert tuple(shapes) == SHAPES
    for name, field in shapes.items():
        assert field.shape == mesh.vertices.shape, name
        assert np.abs(field).max() > 1.0, name  # mm
    for name in LEFT_AND_RIGHT:
        left, right = shapes[f"{name}Left"], shapes[f"{name}Right"]
        assert np.allclose(right[mesh.mirror], left * [-1, 1, 1], atol=1e-9), name


FURTHER_WEIGHTS: list[dict[str, float]] = [
    {"eyeBlink": 1.0},
    {"mouthPucker": 1.0, "jawOpen": 0.1},
    {"eyeBlink": 0.5},
    {"jawOpen": 0.6},
    {"mouthSmile": 1.0, "cheekSquint": 0.6},
    {"mouthStretch": 0.8, "mouthLowerDown": 0.5, "jawOpen": 0.15},
    {"browInnerUp": 1.0, "browOuterUp": 1.0, "eyeWide": 1.0},
    {"browDown": 1.0, "noseSneer": 1.0},
]


@pytest.mark.parametrize(
    "weights",
    [
        {},
        {"jawOpen": 0.4, "mouthClose": 0.4, "mouthPress": 0.5},
        *(pytest.param(weights, marks=pytest.mark.slow) for weights in FURTHER_WEIGHTS),
    ],
    ids=lambda weights: "+".join(weights) or "rest",
)
def test_skin_never_crosses_itself(mesh: QuadMesh, weights: dict[str, float]) -> None:
    skin = mesh.both("skin", "mouth_far", "mouth_near", "mouth_front", "lip_", "eye_", "lid_", "nostril")
    one_side = skin[(mesh.vertices[skin, 2] > 30.0) & (mesh.vertices[skin, 0] > -3.0)]
    assert crossings(pose(mesh, **weights), mesh.faces, one_side) == []


def test_a_closure_closes_at_every_opening_of_the_jaw(mesh: QuadMesh) -> None:
    upper, lower = lip_pairs(mesh)
    for opening, pucker in product((0.0, 0.2, 0.5, 1.0), (0.0, 0.6)):
        vertices = pose(mesh, jawOpen=opening, mouthClose=opening, mouthPucker=pucker, mouthSmile=0.5)
        assert np.linalg.norm(vertices[upper] - vertices[lower], axis=1).max() < 0.2, (opening, pucker)
    vertices = pose(mesh, jawOpen=0.5)
    assert np.linalg.norm(vertices[upper] - vertices[lower], axis=1).max() > 8.0


def test_lids_meet_in_front_of_the_ball(mesh: QuadMesh) -> None:
    upper, lower = eyelid_pairs(mesh)
    assert (pose(mesh)[upper, 1] - pose(mesh)[lower, 1]).max() > 8.0
    shut = pose(mesh, eyeBlink=1.0)
    assert np.linalg.norm(shut[upper] - shut[lower], axis=1).max() < 0.6
    left = [mesh.groups[name] for name in ("eye_edge", "lid_edge", "lid_behind")]
    for weight in (0.0, 0.25, 0.5, 0.75, 1.0):
        distances = np.linalg.norm(pose(mesh, eyeBlink=weight)[np.concatenate(left)] - EYE_CENTRE, axis=1)
        assert distances.min() > EYE_RADIUS - 0.9, weight  # a straight way cuts less than a millimetre into the ball


def test_eyeballs_stay_balls_when_they_turn(mesh: QuadMesh) -> None:
    ball = np.concatenate([mesh.groups[name] for name in mesh.groups if name.startswith("ball_")])
    for name in ("eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeLookDown"):
        distances = np.linalg.norm(pose(mesh, **{name: 1.0})[ball] - EYE_CENTRE, axis=1)
        assert np.allclose(distances, EYE_RADIUS, atol=0.06), name


def test_a_turned_head_keeps_its_shape(mesh: QuadMesh) -> None:
    angles = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 30.0, 0.0], [0.0, 0.0, 15.0], [5.0, -8.0, 3.0]])
    motion = turned(np.stack([mesh.vertices] * len(angles)), angles)
    assert np.allclose(motion[0], mesh.vertices)
    picks = np.arange(0, len(mesh.vertices), 97)
    distances = np.linalg.norm(motion[:, picks, None] - motion[:, None, picks], axis=-1)
    assert np.allclose(distances, distances[0])
    tip = int(np.argmax(mesh.vertices[:, 2]))
    assert motion[1, tip, 1] < motion[0, tip, 1]  # a positive pitch takes the chin and the nose down
    assert motion[2, tip, 0] > motion[0, tip, 0]  # a positive yaw turns the face to its left, where x grows
    crown = int(np.argmax(mesh.vertices[:, 1]))
    assert motion[3, crown, 0] > motion[0, crown, 0]  # a positive roll leans it towards the left shoulder
