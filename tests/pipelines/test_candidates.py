from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.pipelines.animator import Animator
from facediff.pipelines.candidates import Candidate, Placement, perform
from facediff.spaces import Space
from facediff.spaces.arkit import ALPHABETICAL, ARKIT
from facediff.spaces.files import ParameterClip, write_parameters
from facediff.spaces.layouts import layout
from facediff.synthetic.spoken_set import SPEAKER, open_face, spoken_set


def test_weights_move_the_face_as_its_shapes_say() -> None:
    face = open_face()
    values = np.random.default_rng(0).uniform(0, 1, (4, 52)).astype(np.float32)
    placed = Placement(face).values(values, layout("arkit"))
    order = [face.rig.names.index(name) for name in ALPHABETICAL]
    moved = np.tensordot(values.astype(np.float64), face.rig.deltas[order], 1)
    assert np.abs(placed.points - (face.rig.neutral + moved)[:, face.points]).max() < 1e-9


def test_vertices_of_the_built_in_topology_keep_their_displacements() -> None:
    face = open_face()
    rest = face.rig.neutral.astype(np.float32)
    other = (1000 * rest * 1.1).astype(np.float32)  # another head, in millimetres
    shift = np.zeros_like(rest)
    shift[:, 1] = 2.0
    animation = Animation("a", np.stack([other, other + shift]), other, 25, np.asarray(face.rig.faces, np.int32), "mm")
    placed = Placement(face).animation(animation)
    assert np.abs(placed.points[0] - face.rest).max() < 1e-7
    assert np.abs(placed.points[1] - face.rest - [0, 0.002, 0]).max() < 1e-6


def test_flame_without_a_model_is_its_jaw_alone() -> None:
    space = layout("flame_artalk")
    values = np.random.default_rng(0).normal(size=(5, len(space.channels))).astype(np.float32)
    placement = Placement(open_face())
    placed = placement.values(values, space)
    assert placement.jaw is not None
    assert "--flame" in placement.way
    jaw = next(turn for turn in space.rotations if turn.joint == "jaw")
    assert np.array_equal(placed.points[:, placement.jaw, 0].astype(np.float32), values[:, jaw.start])
    head = next(turn for turn in space.rotations if turn.joint == "head")
    assert placed.head is not None
    assert np.allclose(placed.head, values[:, list(head.channels)])


def test_motion_of_another_program_is_read_by_the_clips_names(tmp_path: Path) -> None:
    clips = spoken_set(["en"], 1, 2)
    values = np.random.default_rng(1).uniform(0, 1, (50, 52)).astype(np.float32)
    space = layout("live_link")
    wide = np.pad(values, ((0, 0), (0, len(space.channels) - 52)))
    write_parameters(tmp_path / f"{clips[0].name}.csv", ParameterClip(clips[0].name, wide, space, 30.0))
    candidate = Candidate("theirs", motion=tmp_path)
    lacking = perform(candidate, clips, None)
    assert isinstance(lacking, str)
    assert clips[1].name in lacking
    made = perform(candidate, clips[:1], None)
    assert not isinstance(made, str)
    assert made.frame_rate == pytest.approx(30)
    assert made.seconds is None
    own = Placement(open_face()).values(values, Space("arkit", ARKIT))
    assert np.abs(made.clips[clips[0].name].points - own.points).max() < 1e-5
    # An array in Audio2Face's layout: its mouthClose is the pose of an open jaw with closed lips.
    np.save(tmp_path / f"{clips[1].name}.npy", values[:, [ARKIT.index(name) for name in layout("audio2face").channels]])
    made = perform(replace(candidate, layout="audio2face", frame_rate=30.0), clips[1:], None)
    assert not isinstance(made, str)
    values[:, ARKIT.index("jawOpen")] += values[:, ARKIT.index("mouthClose")]
    own = Placement(open_face()).values(values, Space("arkit", ARKIT))
    assert np.abs(made.clips[clips[1].name].points - own.points).max() < 1e-5


class Exported(Animator):
    """An exported model that was not trained on the face of the clips, and has it."""

    def __init__(self) -> None:
        self.identities, self.other_identities = ["A"], [SPEAKER]
        self.asked: list[object] = []

    def animate(self, *_: object, **options: object) -> Animation:  # type: ignore[override]
        self.asked.append(options.get("identity"))
        rig = open_face().rig
        rest = np.asarray(rig.neutral, np.float32)
        return Animation("a", rest[None], rest, 25, np.asarray(rig.faces, np.int32), "m")


def test_an_exported_model_speaks_by_the_face_of_the_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    model = Exported()
    monkeypatch.setattr("facediff.pipelines.animator.load", lambda *_, **__: model)
    made = perform(Candidate("exported", model="folder"), spoken_set(["en"], 1, 1), None)
    assert not isinstance(made, str), made
    assert {*model.asked} == {SPEAKER}
