"""Lips touch where an alignment says so, by no more than the budget, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.closures import RAMP, close_lips, closure_weights

CLOSURES = [(0.96, 1.08), (2.0, 2.04)]


@pytest.fixture
def animation() -> Animation:
    """Upper lip, lower lip, chin and brow: the mouth opens and closes, the lips round, the brow goes up; in metres."""
    template = np.array([[0, 0.001, 0], [0.01, 0.001, 0], [0, 0, 0], [0.01, 0, 0], [0, -0.04, 0], [0, 0.09, 0]])
    times = (np.arange(75) + 0.5) / 25
    opening = 0.006 * (1.2 + np.sin(2 * np.pi * 1.3 * times))
    vertices = np.repeat(template[None], 75, 0)
    vertices[:, [0, 1], 1] += 0.2 * opening[:, None]
    vertices[:, [2, 3], 1] -= 0.8 * opening[:, None]
    vertices[:, 4, 1] -= 0.7 * opening
    vertices[:, :4, 2] += 0.003 * np.cos(2 * np.pi * 2.1 * times)[:, None]
    vertices[:, 5, 1] += 0.002 * np.sin(2 * np.pi * 0.5 * times)
    regions = {"lips": np.arange(4), "upper_face": np.array([5])}
    return Animation(
        name="a",
        vertices=vertices.astype(np.float32),
        template=template.astype(np.float32),
        frame_rate=25.0,
        regions=regions,
        inner_lip_pairs=np.array([[0, 2], [1, 3]]),
    )


def opening(animation: Animation) -> np.ndarray:
    gaps = animation.vertices[:, [0, 1]] - animation.vertices[:, [2, 3]]
    return np.linalg.norm(gaps, axis=-1).mean(1) - 0.001


def test_lips_meet_at_closures_and_other_frames_are_untouched(animation: Animation) -> None:
    made = close_lips(animation, CLOSURES)
    middles = (np.arange(75) + 0.5) / 25
    inside = [np.argmin(np.abs(middles - (start + end) / 2)) for start, end in CLOSURES]
    assert opening(animation)[inside].min() > 0.002
    np.testing.assert_allclose(opening(made)[inside], 0, atol=1e-5)
    away = np.min([np.abs(middles - (start + end) / 2) - (end - start) / 2 for start, end in CLOSURES], axis=0)
    np.testing.assert_array_equal(made.vertices[away > RAMP + 0.02], animation.vertices[away > RAMP + 0.02])
    assert opening(made).min() > -1e-5
    assert "closed" in made.metadata["edited"]


def test_rounding_and_brow_stay_while_the_chin_follows(animation: Animation) -> None:
    made = close_lips(animation, CLOSURES)
    moved = made.vertices - animation.vertices
    np.testing.assert_array_equal(moved[:, 5], 0)
    assert np.abs(moved[:, :4, 2]).max() < 0.1 * np.abs(moved[:, :4, 1]).max()
    frame = np.abs(moved[:, 2, 1]).argmax()
    np.testing.assert_allclose(moved[frame, 4, 1] / moved[frame, 2, 1], 0.7 / 0.8, rtol=1e-3)


@pytest.mark.parametrize("budget", [0.5, 2.0])
@pytest.mark.parametrize("unit", [("m", 1.0), ("mm", 1000.0)])
def test_no_vertex_is_moved_further_than_the_budget(
    animation: Animation, budget: float, unit: tuple[str, float]
) -> None:
    scaled = replace(
        animation, vertices=animation.vertices * unit[1], template=animation.template * unit[1], unit=unit[0]
    )
    made = close_lips(scaled, CLOSURES, budget)
    moved = np.linalg.norm(made.vertices - scaled.vertices, axis=-1).max() / unit[1] * 1000
    assert 0.98 * budget < moved < 1.02 * budget
    assert (opening(made) <= opening(scaled) + 1e-4).all()


def test_closing_is_smooth(animation: Animation) -> None:
    weights = closure_weights([(0.5, 0.6)], 400, 400.0)[0]
    assert weights.max() == 1
    assert np.abs(np.diff(weights)).max() <= 1.5 / (RAMP * 400) + 1e-9  # the steepest slope of 3t² − 2t³
    assert weights[[0, -1]].max() == 0
    # Even a closure shorter than a frame has a frame in which it is complete.
    assert closure_weights([(0.5, 0.51)], 50, 25.0).max() == 1


def test_closed_mouth_and_no_closures_stay_as_they_are(animation: Animation) -> None:
    still = replace(animation, vertices=np.repeat(animation.template[None], 75, 0))
    assert close_lips(still, CLOSURES) is still
    assert close_lips(animation, []) is animation
