"""Rigs: vertices from values, the geometry of channels, and the way back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.blendshapes import encode
from facediff.errors import FaceDiffError
from facediff.mesh.flame import Flame
from facediff.spaces import layout
from facediff.spaces.layouts import parametric
from facediff.spaces.operations import with_rotations
from facediff.spaces.rigs import LinearRig, decode_flame, flame_rig
from facediff.synthetic.known_faces import built_in_rig, write_puppet_shapes
from tests.fakes.flame import write_flame
from tests.mesh.test_flame import turn_by_definition

RNG = np.random.default_rng(5)


def rig_of(channels: int = 4, vertices: int = 7) -> LinearRig:
    names = tuple(f"shape {index}" for index in range(channels))
    return LinearRig(names, RNG.normal(size=(vertices, 3)), RNG.normal(size=(channels, vertices, 3)))


def test_gram_is_the_loss_of_vertices() -> None:
    rig, values, other = rig_of(), RNG.random((6, 4)), RNG.random((6, 4))
    area = RNG.random(7)
    difference = values - other
    moved = rig.decode(values) - rig.decode(other)
    for weights, factor in ((None, np.ones(7)), (area, area)):
        own = np.einsum("tc,cd,td->t", difference, rig.gram(weights), difference)
        assert np.abs(own / (np.square(moved).sum(-1) @ factor) - 1).max() < 1e-6


def test_decode_of_another_neutral_face_and_of_one_channel() -> None:
    rig, other = rig_of(), RNG.normal(size=(7, 3))
    values = np.eye(4)
    assert np.allclose(rig.decode(values, other) - other, rig.deltas)
    assert rig.only(["SHAPE 2", "shape 0"]).decode(np.eye(2)[:1])[0] == pytest.approx(rig.neutral + rig.deltas[2])
    with pytest.raises(FaceDiffError, match="shape 9"):
        rig.only(["shape 9"])


def test_hash_tells_rigs_apart_and_not_neutral_faces() -> None:
    rig = rig_of()
    same = LinearRig(rig.names, rig.neutral + 1, rig.deltas.copy())
    other = LinearRig(rig.names, rig.neutral, rig.deltas * 1.001)
    assert rig.hash == same.hash != other.hash
    assert rig.space.kind == "linear"
    assert rig.space.rig_hash == rig.hash


def test_encode_finds_the_weights_that_a_built_in_face_was_moved_by() -> None:
    rig = built_in_rig()
    assert rig.space.kind == "arkit"
    names = ["jawOpen", "mouthFunnel", "mouthPucker", "mouthSmileLeft", "eyeBlinkRight", "browInnerUp"]
    few = rig.only(names)
    values = RNG.random((12, len(names)))
    animation = Animation("dense", few.decode(values).astype(np.float32), rig.neutral.astype(np.float32), 30.0)
    assert np.abs(encode(animation, few) - values).max() < 2e-3


def test_read_of_a_folder_is_the_rig(tmp_path: Path) -> None:
    write_puppet_shapes(tmp_path / "shapes")
    read, own = LinearRig.read(tmp_path / "shapes"), built_in_rig()
    assert set(read.names) == set(own.names)
    assert np.abs(read.only(own.names).deltas - own.deltas).max() < 1e-8


def test_decode_flame_turns_jaw_and_head_in_every_form(tmp_path: Path) -> None:
    flame = Flame.read(write_flame(tmp_path / "flame.npz", form="npz"))
    space = layout("flame_artalk")
    values = RNG.normal(0, 0.3, (3, 106))
    shape = RNG.normal(size=100)
    vertices = decode_flame(flame, values, space, shape)
    still = flame.vertices(shape, values[:, :100], values[:, 103:])
    head = turn_by_definition(values[1, 100:103])
    # Turned about one point, so that differences between vertices turn alone.
    assert np.allclose(vertices[1] - vertices[1, :1], (still[1] - still[1, :1]) @ head.T)
    assert np.allclose(decode_flame(flame, *with_rotations(values, space, "six_d"), shape), vertices)
    values[:, 100:103] = 0
    assert np.allclose(decode_flame(flame, values, space, shape), still)
    with pytest.raises(FaceDiffError, match="arkit"):
        decode_flame(flame, np.zeros((1, 52)), layout("arkit"))


def test_flame_rig_is_flame_without_rotations(tmp_path: Path) -> None:
    flame = Flame.read(write_flame(tmp_path / "flame.npz", form="npz"))
    rig, values = flame_rig(flame), RNG.normal(size=(4, 100))
    space = parametric("flame", ["expression 100"])
    assert np.allclose(rig.decode(values), decode_flame(flame, values, space))


def test_jaw_of_a_linear_flame_is_its_tangent(tmp_path: Path) -> None:
    flame = Flame.read(write_flame(tmp_path / "model.npz", form="npz"))
    rig = flame_rig(flame, jaw=True)
    values = np.zeros((2, len(rig.names)))
    values[0, rig.names.index("jaw_x")], values[1, rig.names.index("expression_3")] = 0.02, 0.5
    expression = np.zeros((2, 100))
    expression[1, 3] = 0.5
    exact = flame.vertices(np.zeros(0), expression, np.array([[0.02, 0, 0], [0, 0, 0]]))
    moved = np.abs(exact - flame.template).max()
    np.testing.assert_allclose(rig.decode(values), exact, atol=0.02 * moved)
    np.testing.assert_allclose(rig.decode(values)[1], exact[1], atol=1e-12)
