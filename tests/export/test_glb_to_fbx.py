"""The script by which Blender makes .fbx: the facts that it reads of a .glb."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import facediff.export
from facediff.animation import Animation
from facediff.export import write_animations
from facediff.spaces import layout
from tests.fakes.avatar import avatar_parts, write_avatar
from tests.fakes.clicks import clicks

SCRIPT = Path(facediff.export.__file__).with_name("glb_to_fbx.py")


def test_frame_rate_and_length_are_read_from_a_face_and_from_an_avatar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "bpy", ModuleType("bpy"))
    facts_of = runpy.run_path(str(SCRIPT))["facts_of"]
    animation = clicks()
    frames = len(animation.vertices)
    write_animations(tmp_path / "face.glb", [animation])
    assert facts_of(str(tmp_path / "face.glb")) == (25.0, frames)
    faster = replace(animation, frame_rate=50.0)
    write_animations(tmp_path / "again.glb", [faster], into=tmp_path / "face.glb")
    assert facts_of(str(tmp_path / "again.glb")) == (50.0, frames)
    write_avatar(tmp_path / "avatar.glb", avatar_parts(rounds=0))  # with an animation of its own, of one second
    spoken = Animation("x", animation.vertices, animation.template, 30.0, faces=animation.faces)
    spoken = spoken.made_of(layout("arkit"), np.zeros((frames, 52), np.float32))
    write_animations(tmp_path / "out.glb", [spoken], into=tmp_path / "avatar.glb", own_shapes=True)
    assert facts_of(str(tmp_path / "out.glb")) == (30.0, frames)
