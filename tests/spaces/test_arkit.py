"""ARKit's names: Live Link Face's columns, pairs and spellings."""

from __future__ import annotations

import csv

import pytest

from facediff.spaces.arkit import ARKIT, ROTATIONS, arkit_name, live_link_name, mirror_pairs

# The first line of a recording of Live Link Face, as many public readers of such recordings state it.
HEADER = (
    "Timecode,BlendShapeCount,EyeBlinkLeft,EyeLookDownLeft,EyeLookInLeft,EyeLookOutLeft,EyeLookUpLeft,EyeSquintLeft,"
    "EyeWideLeft,EyeBlinkRight,EyeLookDownRight,EyeLookInRight,EyeLookOutRight,EyeLookUpRight,EyeSquintRight,"
    "EyeWideRight,JawForward,JawRight,JawLeft,JawOpen,MouthClose,MouthFunnel,MouthPucker,MouthRight,MouthLeft,"
    "MouthSmileLeft,MouthSmileRight,MouthFrownLeft,MouthFrownRight,MouthDimpleLeft,MouthDimpleRight,MouthStretchLeft,"
    "MouthStretchRight,MouthRollLower,MouthRollUpper,MouthShrugLower,MouthShrugUpper,MouthPressLeft,MouthPressRight,"
    "MouthLowerDownLeft,MouthLowerDownRight,MouthUpperUpLeft,MouthUpperUpRight,BrowDownLeft,BrowDownRight,BrowInnerUp,"
    "BrowOuterUpLeft,BrowOuterUpRight,CheekPuff,CheekSquintLeft,CheekSquintRight,NoseSneerLeft,NoseSneerRight,"
    "TongueOut,HeadYaw,HeadPitch,HeadRoll,LeftEyeYaw,LeftEyePitch,LeftEyeRoll,RightEyeYaw,RightEyePitch,RightEyeRoll"
)


def test_the_columns_are_those_of_the_recordings() -> None:
    assert ["Timecode", "BlendShapeCount", *map(live_link_name, ARKIT), *ROTATIONS] == next(csv.reader([HEADER]))
    assert len(set(ARKIT)) == 52


def test_pairs_are_left_and_right_of_one_name() -> None:
    pairs = [(ARKIT[left], ARKIT[right]) for left, right in mirror_pairs()]
    assert all(left.replace("Left", "Right") == right != left for left, right in pairs)
    assert len(pairs) * 2 == sum(name.endswith(("Left", "Right")) for name in ARKIT)
    assert mirror_pairs(("jawOpen", "eyeBlinkRight", "eyeBlinkLeft", "eyeWideLeft")) == [(2, 1)]


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("JawOpen", "jawOpen"),
        ("jaw_open", "jawOpen"),
        ("17 - browInnerUp", "browInnerUp"),
        ("eyeBlink_L", "eyeBlinkLeft"),
        ("EYE_BLINK_RIGHT", "eyeBlinkRight"),
        ("blendShape1.mouthSmile_R", "mouthSmileRight"),
        ("mouthLeft", "mouthLeft"),
        ("viseme_aa", None),
        ("jawOpenWide", None),
        ("", None),
    ],
)
def test_spellings(written: str, name: str | None) -> None:
    assert arkit_name(written) == name


@pytest.mark.parametrize("name", ARKIT)
def test_every_name_is_itself_in_either_case(name: str) -> None:
    assert arkit_name(name) == arkit_name(live_link_name(name)) == arkit_name(name.upper()) == name
