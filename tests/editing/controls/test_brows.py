"""Where brows are: on the built-in face, on a mesh of another topology, and where a file says it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation
from facediff.animation.options import AnimationControls
from facediff.editing.controls.brows import brows_of
from facediff.editing.controls.controlled_face import apply_controls
from facediff.editing.controls.direction import Direction, Key
from facediff.errors import FaceDiffError
from tests.fakes.small_face import CONTROLS, F1, build_face, build_rig


def size(field: np.ndarray) -> float:
    return float(np.linalg.norm(field, axis=-1).max())


def test_brows_of_the_built_in_face_are_those_of_its_rig(make_animation: Callable[..., Animation]) -> None:
    raised = make_animation(1, browInnerUp=0.5, browOuterUp=0.5)
    offsets = raised.vertices[0] - raised.template
    found = brows_of(raised.template, raised.faces, raised.regions, "m")
    np.testing.assert_allclose(found.up * size(offsets) / 0.001, offsets, atol=1e-6)
    assert [size(found.up), size(found.down)] == pytest.approx([0.001, 0.001])
    where = np.linalg.norm(found.down, axis=-1) > 0.0005
    assert found.down[where, 1].max() < 0, "down they go"


def test_a_file_says_where_they_are(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    animation = make_animation(1)
    named = [int(each) for each in animation.regions["upper_face"][:20]]
    file = tmp_path / "eyes.json"
    file.write_text(json.dumps({"brows": named}))
    keys = Direction([Key(0, "brows", 3.0)])
    made = apply_controls(animation, AnimationControls(direction=keys, eyes=file))
    moved = made.vertices[0] - animation.vertices[0]
    np.testing.assert_allclose(moved[named], np.tile([0, 0.003, 0], (20, 1)), atol=1e-6)
    assert not moved[animation.regions["lips"]].any()


def test_a_mesh_without_a_face_is_asked_for_them() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    with pytest.raises(FaceDiffError, match="brows"):
        brows_of(ball.vertices, ball.faces, {}, "m")
    with pytest.raises(FaceDiffError, match="brows"):
        brows_of(ball.vertices, None, {}, "m")


@pytest.mark.slow
def test_brows_are_carried_to_another_topology() -> None:
    """On a finer mesh in centimetres they are the rig's own, interpolated."""
    rig = build_rig(F1)
    fine = trimesh.Trimesh(rig.neutral, build_face().faces, process=False).subdivide()
    found = brows_of(100 * fine.vertices, fine.faces, {}, "cm")
    raised = rig.fields[CONTROLS.index("inner_brow_up")] + rig.fields[CONTROLS.index("outer_brow_up")]
    np.testing.assert_allclose(found.up[: len(raised)], 0.1 * raised / size(raised), atol=0.05)
    assert size(found.up) == pytest.approx(0.1)
