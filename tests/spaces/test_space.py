"""The record of a space: what it derives, and that nothing contradictory or foreign becomes one."""

from __future__ import annotations

import json

import pytest

from facediff.errors import FaceDiffError
from facediff.spaces import VERTICES, Rotation, Space

RIGGED = Space(
    "arkit",
    ("jawOpen", "mouthClose", "browInnerUp", "eyeBlinkLeft", "eyeLookInLeft", "HeadPitch", "HeadYaw", "HeadRoll", "L"),
    version="52",
    rig="puppet",
    rig_hash="abc",
    rotations=(Rotation("head", 5, "euler"), Rotation("left_eye", 8, "axis_angle_x")),
    valid_range=(0.0, 1.0),
    absent=("tongueOut",),
    identity="templates",
)


def test_vertices_are_a_space_of_three_numbers_a_point() -> None:
    assert Space() == VERTICES
    assert VERTICES.is_vertices
    assert (VERTICES.dims, VERTICES.channels, VERTICES.head, VERTICES.face) == (3, (), (), ())


def test_channels_fall_into_face_head_and_eyes() -> None:
    assert RIGGED.dims == 1
    assert (RIGGED.face, RIGGED.head, RIGGED.eyes) == ((0, 1, 2, 3, 4), (5, 6, 7), (8,))
    assert sorted((*RIGGED.face, *RIGGED.head, *RIGGED.eyes)) == list(range(len(RIGGED.channels)))


def test_regions_follow_from_names_whatever_their_case() -> None:
    regions = [RIGGED.region(name) for name in ("lips", "upper_face", "eyes")]
    assert regions == [(0, 1), (2,), (3, 4)]
    assert Space("arkit", ("JawOpen", "MouthClose")).region("lips") == (0, 1)
    assert RIGGED.index("JAWOPEN") == 0
    with pytest.raises(FaceDiffError, match="tongueOut"):
        RIGGED.index("tongueOut")


@pytest.mark.parametrize("space", [VERTICES, RIGGED])
def test_records_survive_json(space: Space) -> None:
    assert Space.from_state(json.loads(json.dumps(space.state()))) == space
    assert Space.from_state(space.state()) == space


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("kind", 3),
        ("channels", "jawOpen"),
        ("channels", [1] * 9),
        ("rotations", [{"joint": "head", "start": 0}]),
        ("rotations", [{"joint": "head", "start": 0, "form": []}]),
        ("valid_range", [0]),
        ("valid_range", [0, 10**400]),
    ],
)
def test_foreign_records_are_refused(field: str, value: object) -> None:
    with pytest.raises(FaceDiffError, match="space"):
        Space.from_state({**RIGGED.state(), field: value})
