"""Pose, smoothing and resampling against their formulas."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.data.track.face import (
    MILLIMETRES,
    filled,
    horizontal_gaze,
    median_face,
    pair_distances,
    pose,
    resampled,
    smooth,
)
from facediff.data.track.model import POINTS
from facediff.data.track.topology import EYE_CORNERS, IRIS, LIPS, sharpness, without_webs
from facediff.spaces.rotations import convert, matrices
from tests.fakes.people import CodedTracker, Look, face_model


def landmarks(angles: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """A still face with pitch, yaw and roll in degrees (T, 3), in pixels."""
    model = face_model()
    still = CodedTracker(model).landmarks(Look().picture())
    assert still is not None
    face = (still[0] - (300, 200, 0)) * (1, -1, -1) / 10
    pitch, yaw, roll = np.radians(angles).T
    turns = matrices(convert(np.stack([yaw, pitch, -roll], axis=1), "euler", "quaternion"))
    posed = scales[:, None, None] * (face @ turns.swapaxes(1, 2))
    return posed * (1, -1, -1) + (300, 200, 0)


def test_pose_takes_the_head_out_and_reports_it() -> None:
    random = np.random.default_rng(0)
    angles, scales = random.uniform(-20, 20, (30, 3)), random.uniform(8, 12, 30)
    model = face_model()
    points = landmarks(angles, scales)
    points[7] = np.nan
    posed = pose(points, MILLIMETRES * model.canonical, model.weights)
    seen = np.arange(30) != 7
    np.testing.assert_allclose(posed.angles[seen], angles[seen], atol=1e-4)
    np.testing.assert_allclose(posed.scales[seen], scales[seen] / 10, rtol=1e-4)
    assert np.ptp(posed.faces[seen], axis=0).max() < 1e-3
    assert np.isnan(posed.faces[7]).all()


def test_the_median_face_is_as_large_as_the_canonical_face() -> None:
    model = face_model()
    face = median_face(landmarks(np.zeros((9, 3)), np.full(9, 5.0)), model)
    np.testing.assert_allclose(face, MILLIMETRES * model.canonical, atol=0.6)


def test_the_smoother_is_the_least_squares_solution() -> None:
    """White acceleration is a penalty on what position and velocity do between frames."""
    rate, q, r, count = 25.0, 3e4, 0.05, 12
    noisy = np.random.default_rng(1).normal(0, 1, (count, 3))
    step = 1 / rate
    move = np.array([[1, step], [0, 1]])
    noise = np.linalg.inv(q * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]))
    system, right = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, 3))
    prior = np.diag([1 / r, 1 / q])
    system[:2, :2] += prior
    right[:2] += prior @ np.stack([noisy[0], np.zeros(3)])
    for t in range(1, count):
        system[2 * t, 2 * t] += 1 / r
        right[2 * t] += noisy[t] / r
        change = np.concatenate([-move, np.eye(2)], axis=1)
        system[2 * t - 2 : 2 * t + 2, 2 * t - 2 : 2 * t + 2] += change.T @ noise @ change
    np.testing.assert_allclose(smooth(noisy, rate, q, r), np.linalg.solve(system, right)[::2], atol=1e-8)


def test_smoothing_has_no_lag() -> None:
    motion = np.sin(2 * np.pi * 3 * np.arange(100) / 25)[:, None]
    smoothed = smooth(motion, 25, 3e4, 0.05)[10:-10, 0]
    scores = [np.corrcoef(smoothed, np.roll(motion[:, 0], lag)[10:-10])[0, 1] for lag in (-1, 0, 1)]
    assert int(np.argmax(scores)) == 1
    assert scores[1] > 0.999


@pytest.mark.parametrize("rate", [25.0, 30.0, 29.97])
def test_even_times_are_filtered_and_others_interpolated(rate: float) -> None:
    times = np.arange(120) / rate
    motion = np.sin(2 * np.pi * times)[:, None]
    grid = np.arange(int(times[-1] * 25 + 1e-6) + 1) / 25
    np.testing.assert_allclose(resampled(motion, times, 25)[5:-5, 0], np.sin(2 * np.pi * grid)[5:-5], atol=2e-3)
    uneven = np.sort(np.random.default_rng(0).uniform(0, 4, 120))
    values = resampled(uneven[:, None], uneven, 25)[:, 0]
    np.testing.assert_allclose(values, uneven[0] + np.arange(len(values)) / 25, atol=1e-9)


def test_gaps_are_lines() -> None:
    times = np.array([0.0, 0.1, 0.3, 0.4])
    values = np.array([[0.0], [np.nan], [3.0], [4.0]])
    np.testing.assert_allclose(filled(values, times)[:, 0], [0, 1, 3, 4])


def test_gaze_is_the_angle_of_the_irises() -> None:
    faces = np.zeros((1, 478, 3))
    for side, corners in EYE_CORNERS.items():
        faces[:, list(corners), 0] = [-10, 10]
        faces[:, IRIS[side], 0] = 12 * np.sin(np.radians(15))
    np.testing.assert_allclose(horizontal_gaze(faces), 15)
    assert pair_distances(faces)[0] == 0


def test_webs_are_dropped_and_lips_stay_sharp() -> None:
    model = face_model()
    open_faces = without_webs(model.triangles)
    assert 0 < len(open_faces) < len(model.triangles)
    weights = sharpness(open_faces, POINTS)
    assert (weights[list(LIPS)] == 1).all()
    assert {0.0, 1 / 3, 2 / 3, 1.0} >= {*np.round(weights, 12)} - {*np.round([1 / 3, 2 / 3], 12)}
