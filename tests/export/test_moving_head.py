"""A head that moves as a whole, in files: a node of its own in .glb, columns of a table, an array of an .npz."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from facediff.animation import Animation, read_archive
from facediff.animation.options import AnimationControls
from facediff.editing.controls.controlled_face import apply_controls
from facediff.editing.controls.direction import Direction, Key
from facediff.errors import FaceDiffError
from facediff.export import ExportOptions, write_animations
from facediff.spaces.files import read_parameters
from facediff.spaces.rotations import convert
from tests.fakes.clicks import clicks
from tests.fakes.glb_reader import Reader

DEGREES = {"head.pitch": 8.0, "head.yaw": -12.0, "head.roll": 5.0}


@pytest.fixture
def turned() -> Animation:
    """It goes from rest to the angles in two seconds, and stays there."""
    keys = [Key(time, name, value) for name, far in DEGREES.items() for time, value in ((0.0, 0.0), (2.0, far))]
    return apply_controls(clicks(), AnimationControls(direction=Direction(keys)))


def test_head_is_taken_out_again(turned: Animation) -> None:
    still = turned.still()
    assert still.head is None
    np.testing.assert_allclose(still.vertices, clicks().vertices, atol=1e-4)  # of 50 mm, in single precision
    assert np.abs(turned.vertices - clicks().vertices).max() > 5
    np.testing.assert_array_equal(turned.vertices[0], clicks().vertices[0])
    plain = clicks()
    assert plain.still() is plain


@pytest.mark.parametrize("unit", [None, "m"])
def test_archive_keeps_it_in_any_unit(turned: Animation, tmp_path: Path, unit: str | None) -> None:
    write_animations(tmp_path / "a.npz", [turned], ExportOptions(output_unit=unit))
    read = read_archive(tmp_path / "a.npz")
    factor = 1.0 if unit is None else 0.001
    np.testing.assert_allclose(read.still().vertices, factor * clicks().vertices, atol=1e-4 * factor)
    np.testing.assert_array_equal(read.part(slice(10, 20)).head, np.asarray(read.head)[10:20])
    with pytest.raises(FaceDiffError, match="head"):
        Animation("a", read.vertices, read.template, 25, head=np.zeros((3, 6)))


def test_glb_has_a_node_that_turns_the_face(turned: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [turned])
    read = Reader(tmp_path / "a.glb")
    nodes = read.gltf.nodes
    (root,) = read.gltf.scenes[0].nodes
    assert (nodes[root].name, nodes[root].children) == ("head", [0])
    motion = read.gltf.animations[0]
    curves = {channel.target.path: motion.samplers[channel.sampler] for channel in motion.channels}
    rotations, shifts = (read.values(curves[path].output).astype(float) for path in ("rotation", "translation"))
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=1), 1, atol=1e-6)
    assert len(read.primitive.targets) <= 2, "the face itself only opens its mouth"
    for frame in (0, 16, 31, 74):
        face = read.at(frame / 25)
        made = Rotation.from_quat(rotations[frame]).apply(face) + shifts[frame]
        np.testing.assert_allclose(made, 0.001 * turned.vertices[frame], atol=6e-5)
    write_animations(tmp_path / "b.glb", [clicks()])
    assert [node.name for node in Reader(tmp_path / "b.glb").gltf.nodes] == ["clicks"]


def test_table_has_its_angles_and_weights_without_it(turned: Animation, tmp_path: Path) -> None:
    from facediff.editing.blendshapes import SolveOptions, solve, write_live_link, write_weights
    from facediff.editing.shapes import ShapeSet

    rest = clicks().template.astype(float)
    opening = np.zeros((1, *rest.shape))
    opening[:, 8:, 1] = -20.0
    shapes = ShapeSet(("jawOpen",), rest, opening)
    weights, plain = (solve(each, shapes, SolveOptions()) for each in (turned, clicks()))
    np.testing.assert_allclose(weights.values, plain.values, atol=1e-4)
    write_live_link(tmp_path / "w.csv", weights)
    clip = read_parameters(tmp_path / "w.csv")
    turn = next(turn for turn in clip.space.rotations if turn.joint == "head")
    axis_angle = convert(clip.values[:, list(turn.channels)], turn.form, "axis_angle")
    np.testing.assert_allclose(axis_angle, weights.head, atol=1e-6)
    with (tmp_path / "w.csv").open(newline="") as stream:
        row = list(csv.DictReader(stream))[60]
    # The app's columns are radians, mirrored: yaw and roll have the other sign.
    assert turned.head is not None
    yaw, pitch, roll = Rotation.from_rotvec(turned.head[60, :3]).as_euler("YXZ")
    assert [float(row[f"Head{axis}"]) for axis in ("Yaw", "Pitch", "Roll")] == pytest.approx(
        [-yaw, pitch, -roll], abs=1e-6
    )
    assert json.loads((tmp_path / "w.json").read_text())["rotations_absent"] == ["eyes"]
    write_weights(tmp_path / "plain.csv", weights)
