"""Parts of the built-in head: lids, eyeballs, brows, shapes and named places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import main
from facediff.editing.controls.brows import brows_of
from facediff.editing.controls.eyelids import puppet_eyes
from facediff.editing.landmarks import NAMES, known_topology, puppet_landmarks
from facediff.editing.shapes import read_shapes
from facediff.spaces.arkit import ALPHABETICAL
from facediff.synthetic.head.parts import build_head
from facediff.synthetic.head.rig import eyelid_pairs
from facediff.synthetic.known_faces import built_in_shapes, known_face, resting_heads

MESH = build_head()


def gap(vertices: np.ndarray) -> float:
    """Largest distance in mm between facing vertices of the lids' edges."""
    upper, lower = eyelid_pairs(MESH)
    return 1000.0 * float(np.linalg.norm(vertices[upper] - vertices[lower], axis=1).max())


@pytest.mark.parametrize(("stretch", "open_mm", "shut_mm"), [(1.0, 8.0, 0.8), (1.2, 9.0, 2.0)])
def test_lids_shut_over_eyeballs(stretch: float, open_mm: float, shut_mm: float) -> None:
    face = resting_heads()["M4"] * stretch  # the stretched one is nobody's
    eyes = puppet_eyes(face, MESH.faces)
    assert eyes is not None
    assert eyes.closing is not None
    assert gap(face) > open_mm
    assert gap(face + eyes.closing) < shut_mm
    for ball, sign in zip(eyes.eyeballs, (1, -1), strict=True):
        assert (np.sign(face[ball, 0]) == sign).all()


def test_a_speaker_is_recognised_by_the_face() -> None:
    face = known_face(resting_heads()["F5"].astype(np.float32), MESH.faces)
    assert face is not None
    assert face.speaker == "F5"
    assert face.distance < 1e-6
    assert known_face(MESH.vertices[:-1], MESH.faces) is None
    assert known_face(MESH.vertices, MESH.faces[::-1]) is None
    assert known_face(MESH.vertices, MESH.faces[:, ::-1]) is not None  # version 1 had some parts inside out


def test_brows_rise() -> None:
    brows = brows_of(resting_heads()["F1"], MESH.faces, {}, "m")
    moved = np.linalg.norm(brows.up, axis=1) > 0.0005
    assert (brows.up[moved, 1] > 0).all()
    assert (MESH.vertices[moved, 1] > 20).all()
    assert brows.down[np.linalg.norm(brows.down, axis=1) > 0.0005, 1].max() < 0


def test_shapes_are_arkits_and_the_speakers_own(tmp_path: Path) -> None:
    neutral, faces, shapes = built_in_shapes("M1")
    assert tuple(shapes) == ALPHABETICAL
    assert np.array_equal(faces, MESH.faces)
    assert np.allclose(neutral, resting_heads()["M1"], atol=1e-7)
    deltas = np.stack(list(shapes.values())) - neutral
    assert main(["blendshapes", "--write-puppet-shapes", str(tmp_path / "m1"), "--identity", "M1"]) == 0
    for folder in (Path("puppet"), tmp_path / "m1"):
        own = read_shapes(folder, neutral)
        assert own.absent == ()
        order = [list(shapes).index(name) for name in own.names]
        assert np.allclose(own.deltas, deltas[order], atol=1e-6)


def test_named_places_lie_where_they_say() -> None:
    places = puppet_landmarks()
    known = known_topology(resting_heads()["M3"])
    assert known is not None
    assert known.topology == "puppet"
    assert known.vertices == places
    at = {name: MESH.vertices[places[name]] for name in NAMES}
    heights = ["nose_bridge", "nose_tip", "nose_base", "upper_lip_top", "upper_lip_middle", "lower_lip_middle"]
    heights += ["lower_lip_bottom", "chin"]
    assert [at[name][1] for name in heights] == sorted((at[name][1] for name in heights), reverse=True)
    assert all(at[name][0] == 0 for name in heights)
    across = ["eye_outer_right", "eye_inner_right", "eye_inner_left", "eye_outer_left"]
    assert [at[name][0] for name in across] == sorted(at[name][0] for name in across)
    assert at["nose_base"][2] < at["nose_tip"][2] - 8
