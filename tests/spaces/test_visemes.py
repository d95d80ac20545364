"""Visemes from ARKit's weights: poses, linearity, silence and blinks."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.spaces import layout
from facediff.spaces.arkit import ALPHABETICAL
from facediff.spaces.operations import permuted
from facediff.spaces.visemes import SETS, VisemeSet, poses, viseme_map, visemes


@pytest.mark.parametrize("viseme_set", ["oculus", "vrm"])
def test_a_visemes_own_pose_has_it_as_its_largest_weight(viseme_set: VisemeSet) -> None:
    rows = poses(viseme_set)
    weights, space = visemes(rows, layout("arkit"), viseme_set)
    assert space.channels == SETS[viseme_set]
    own = weights[:, 1:] if viseme_set == "oculus" else weights[:, : len(rows)]
    assert own.argmax(1).tolist() == list(range(len(rows)))
    assert np.diag(own).min() > 0.4


def test_the_map_is_the_ridge_regression_that_the_module_states() -> None:
    rows = poses("oculus")
    x = np.random.default_rng(0).random(52)
    # By its definition: the weights of the poses of least squared distance, with the squares of the weights.
    stacked = np.concatenate([rows.T, np.sqrt(0.02) * np.eye(len(rows))])
    expected = np.linalg.lstsq(stacked, np.concatenate([x, np.zeros(len(rows))]), rcond=None)[0]
    assert np.allclose(x @ viseme_map("oculus"), expected)


def test_a_face_at_rest_is_silent_and_order_does_not_matter() -> None:
    rest, _ = visemes(np.zeros((1, 52)), layout("arkit"), "oculus")
    assert rest[0].tolist() == [1.0, *[0.0] * 14]
    values = np.random.default_rng(1).random((4, 52))
    other, space = permuted(values, layout("arkit"), layout("live_link"))
    assert np.allclose(visemes(other, space, "oculus")[0], visemes(values, layout("arkit"), "oculus")[0])


def test_blinks_add_up_to_each_eyes() -> None:
    values = np.zeros((1, 52), np.float32)
    values[0, ALPHABETICAL.index("eyeBlinkLeft")] = 0.9
    values[0, ALPHABETICAL.index("eyeBlinkRight")] = 0.3
    weights, space = visemes(values, layout("arkit"), "vrm")
    assert weights[0, [space.index(name) for name in ("Blink", "Blink_L", "Blink_R")]] == pytest.approx([0.3, 0.6, 0.0])
