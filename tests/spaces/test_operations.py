"""Permutation by name, forms of rotation and resampling."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Reference
from scipy.spatial.transform import Slerp

from facediff.errors import FaceDiffError
from facediff.spaces import Space, layout
from facediff.spaces.layouts import parametric
from facediff.spaces.operations import permuted, resampled, with_rotations

ORDERS = ("arkit", "arkit_51", "live_link", "audio2face", "mediapipe")


def by_name(values: np.ndarray, space: Space) -> dict[str, float]:
    return {name.casefold(): float(value) for name, value in zip(space.channels, values[0], strict=True)}


def test_permuted_keeps_every_value_under_its_name_in_all_orders() -> None:
    for first, second in permutations(ORDERS, 2):
        source, target = layout(first), layout(second)
        values = np.random.default_rng(0).random((1, len(source.channels)))
        moved, space = permuted(values, source, target)
        own, new = by_name(values, source), by_name(moved, space)
        absent = {name.casefold() for name in space.absent}
        assert all(new[name] == own[name] for name in new if name in own)
        assert all(name in absent and new[name] == 0 for name in new if name not in own), (first, second)


def test_permuted_of_capitals_and_back_is_exact() -> None:
    source = layout("live_link")
    capitals = Space("arkit", tuple(name[:1].upper() + name[1:] for name in source.channels[:52]))
    values = np.random.default_rng(1).random((3, 52)).astype(np.float32)
    moved, space = permuted(values, capitals, layout("arkit"))
    assert moved.dtype == np.float32
    assert not space.absent
    assert np.array_equal(permuted(moved, space, capitals)[0], values)


def test_permuted_keeps_absence_through_a_third_order() -> None:
    values, space = permuted(np.ones((1, 51)), layout("arkit_51"), layout("arkit"))
    _, again = permuted(values, space, layout("audio2face"))
    assert again.absent == ("tongueOut",)


def test_permuted_refuses_other_versions_and_forms() -> None:
    flame = parametric("flame", ["expression 3"], version="2020")
    with pytest.raises(FaceDiffError, match="2023"):
        permuted(np.zeros((1, 3)), flame, parametric("flame", ["expression 3"], version="2023"))
    with pytest.raises(FaceDiffError, match="jaw"):
        permuted(np.zeros((1, 106)), layout("flame_artalk"), layout("flame_diffposetalk_model"))


def test_with_rotations_and_back_is_the_same_motion() -> None:
    space = layout("flame_artalk")
    values = np.random.default_rng(2).normal(0, 0.5, (20, 106))
    for form in ("six_d", "quaternion", "euler"):
        other, written = with_rotations(values, space, form)
        assert other.shape[1] == len(written.channels)
        back, again = with_rotations(other, written, "axis_angle")
        assert again == space
        assert np.abs(back - values).max() < 1e-6


def test_resampled_rotations_are_scipys_slerp_and_weights_linear() -> None:
    space = parametric("flame", ["expression 2", ("head", "axis_angle")])
    values = np.random.default_rng(3).normal(0, 1, (6, 5))
    new = resampled(values, space, 25.0, 60.0)
    times, new_times = np.arange(6) / 25, np.arange(len(new)) / 60
    assert len(new) == 13
    assert np.allclose(new[:, 0], np.interp(new_times, times, values[:, 0]))
    expected = Slerp(times, Reference.from_rotvec(values[:, 2:]))(new_times).as_matrix()
    assert np.abs(Reference.from_rotvec(new[:, 2:]).as_matrix() - expected).max() < 1e-9
    assert np.array_equal(resampled(values, space, 30.0, 30.0), values)
