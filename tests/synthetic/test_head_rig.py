"""The built-in head: quads, symmetry, and shapes that close lips and lids."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from facediff.spaces.arkit import ARKIT, LEFT_AND_RIGHT
from facediff.synthetic.cast import CAST
from facediff.synthetic.corpus import resting_head
from facediff.synthetic.head.mesh import QuadMesh
from facediff.synthetic.head.parts import EYE_CENTRE, EYE_RADIUS, build_head
from facediff.synthetic.head.people import coloured
from facediff.synthetic.head.rig import SHAPES, eyelid_pairs, head_shapes, lip_pairs

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


def test_the_corpus_3_has_the_same_heads(mesh: QuadMesh) -> None:
    """Sums with random weights; where they change, the corpus is another and needs another number."""
    random = np.random.default_rng(0)
    skin, shapes = mesh.vertices, np.stack(list(head_shapes().values()))
    heads = np.stack([resting_head(member) for member in CAST.values()])
    colours = np.stack([coloured(mesh, member.complexion) for member in CAST.values()])
    *found, shade = ((array * random.normal(size=array.shape)).sum() for array in (skin, shapes, heads, colours))
    assert found == pytest.approx([-147.88375299, 325.27987299, 46.88441127], rel=1e-6)
    assert shade == pytest.approx(-49668.93, abs=5)  # the rounding of a few may differ
    assert (mesh.faces * random.integers(1, 99, mesh.faces.shape)).sum() == 4819478937


def test_the_head_is_made_of_quads_and_symmetric(mesh: QuadMesh) -> None:
    assert 4500 < len(mesh.vertices) < 6000
    triangles = (mesh.quads[:, 1] == mesh.quads[:, 2]) | (mesh.quads[:, 2] == mesh.quads[:, 3])
    assert triangles.mean() < 0.05
    assert np.allclose(mesh.vertices[mesh.mirror], mesh.vertices * [-1, 1, 1])
    assert np.array_equal(mesh.mirror[mesh.mirror], np.arange(len(mesh.vertices)))
    edges = np.sort(np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() <= 2


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
