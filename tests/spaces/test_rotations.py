"""Conversions between forms of rotation against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from facediff.spaces.rotations import convert, slerp
from facediff.spaces.space import Form

FORMS: tuple[Form, ...] = ("axis_angle", "six_d", "quaternion", "euler")


def reference(rotations: Rotation, form: Form) -> np.ndarray:
    if form == "axis_angle":
        return rotations.as_rotvec()
    if form == "quaternion":
        return rotations.as_quat(canonical=True, scalar_first=True)
    if form == "euler":
        return rotations.as_euler("YXZ")
    return np.concatenate([rotations.as_matrix()[:, :, 0], rotations.as_matrix()[:, :, 1]], axis=1)


@pytest.mark.parametrize("source", FORMS)
@pytest.mark.parametrize("target", FORMS)
def test_convert_is_scipys(source: Form, target: Form) -> None:
    rotations = Rotation.random(200, rng=3)
    values = convert(reference(rotations, source), source, target)
    assert np.abs(values - reference(rotations, target)).max() < 1e-6


@pytest.mark.parametrize("form", FORMS)
def test_convert_near_the_poles(form: Form) -> None:
    vectors = np.array([[0, 0, 0], [1e-10, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [np.pi / 2, 0, 0]])
    back = convert(convert(vectors, "axis_angle", form), form, "six_d")
    expected = reference(Rotation.from_rotvec(vectors), "six_d")
    assert np.abs(back - expected).max() < 1e-6


def test_convert_of_a_turn_about_x() -> None:
    angles = np.linspace(-3, 3, 7)[:, None]
    assert np.allclose(convert(angles, "axis_angle_x", "axis_angle")[:, :1], angles)
    assert np.allclose(convert(convert(angles, "axis_angle_x", "quaternion"), "quaternion", "axis_angle_x"), angles)


def test_slerp_is_scipys() -> None:
    ends = Rotation.random(2, rng=1)
    shares = np.linspace(0, 1, 9)
    first, second = (np.tile(row, (9, 1)) for row in ends.as_quat(scalar_first=True))
    own = convert(slerp(first, -second, shares), "quaternion", "six_d")
    assert np.abs(own - reference(Slerp([0, 1], ends)(shares), "six_d")).max() < 1e-9
