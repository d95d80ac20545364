"""From landmarks in pictures to a face without head motion: pose, gaps, resampling, smoothing, gaze.

Landmarks are in pixels, x to the right, y down and z away from the viewer. Faces are in millimetres, y up and z to the
viewer, and as large as the canonical face of the model; the head's size in the picture is in its scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.data.reconstructions import resample_frames
from facediff.data.track.model import POINTS, FaceModel
from facediff.data.track.topology import EYE_CORNERS, IRIS, LIP_PAIRS, sharpness, without_webs
from facediff.mesh.alignment import fit_similarities
from facediff.spaces.rotations import convert

Array = npt.NDArray[np.float64]

MILLIMETRES = 10.0  # to a unit of the canonical face, a centimetre
ROUNDS = 3
SHARP, SOFT = (3e4, 0.05), (1e4, 0.1)
"""White acceleration in mm²/s³ and variance in mm² of the smoother, for lips and lids, and for the rest. Chosen on
rendered faces with known motion and on a talker with known words: closures stay, and there is no lag."""
EVEN = 0.1  # of a frame: times that lie so near to even ones are even
EYE_RADIUS = 12.0  # millimetres from the eye's centre to the iris


@dataclass(frozen=True)
class PosedFaces:
    """Faces without head motion, and the motion."""

    faces: Array  # (T, 478, 3) in millimetres, irises included; NaN where no face was visible
    angles: Array  # (T, 3) pitch (chin down), yaw (to the face's left) and roll (towards its left shoulder) in degrees
    scales: Array  # (T,) pixels to a millimetre
    centres: Array  # (T, 2) centre of the head in pixels


def upright(landmarks: npt.NDArray[np.floating]) -> Array:
    """Landmarks with y up and z to the viewer."""
    return np.asarray(landmarks, np.float64) * (1.0, -1.0, -1.0)


def pose(landmarks: npt.NDArray[np.floating], target: Array, weights: Array) -> PosedFaces:
    """Lay landmarks (T, 478, 3) onto a face (468, 3) in millimetres by the weighted points, with scale."""
    points = upright(landmarks)
    visible = np.isfinite(points).all(axis=(1, 2))
    basis = np.flatnonzero(weights)
    rotations, shifts, scales = fit_similarities(points[visible][:, basis], target[basis], weights[None, basis], True)
    faces, angles = np.full(points.shape, np.nan), np.full((len(points), 3), np.nan)
    sizes, centres = np.full(len(points), np.nan), np.full((len(points), 2), np.nan)
    faces[visible] = scales[:, None, None] * (points[visible] @ rotations.swapaxes(1, 2)) + shifts[:, None]
    # The head's rotation takes the face to the picture, the inverse of the fit's.
    columns = rotations[:, :2].reshape(-1, 6)
    yaw, pitch, roll = np.degrees(convert(columns, "six_d", "euler")).T
    angles[visible] = np.stack([pitch, yaw, -roll], axis=1)
    sizes[visible], centres[visible] = 1 / scales, points[visible].mean(axis=1)[:, :2] * (1, -1)
    return PosedFaces(faces, angles, sizes, centres)


def median_face(landmarks: npt.NDArray[np.floating], model: FaceModel) -> Array:
    """A person's median face (468, 3) in millimetres, from landmarks (N, 478, 3), as large as the canonical face."""
    canonical = MILLIMETRES * model.canonical
    basis = np.flatnonzero(model.weights)
    face = canonical
    for _ in range(ROUNDS):
        face = np.median(pose(landmarks, face, model.weights).faces[:, :POINTS], axis=0)
        rotation, shift, scale = fit_similarities(face[None, basis], canonical[basis], model.weights[None, basis], True)
        face = scale * face @ rotation[0].T + shift[0]
    return face


def interpolated(values: Array, times: Array, new_times: Array) -> Array:
    """Values (T, ...) at rising times, linearly at other ones; constant before the first and after the last."""
    rows = values.reshape(len(values), -1)
    low = np.clip(np.searchsorted(times, new_times, side="right") - 1, 0, max(0, len(times) - 2))
    high = np.minimum(low + 1, len(times) - 1)
    lengths = np.where(high > low, times[high] - times[low], 1.0)
    share = ((new_times - times[low]) / lengths)[:, None].clip(0, 1)
    return ((1 - share) * rows[low] + share * rows[high]).reshape(len(new_times), *values.shape[1:])


def filled(values: Array, times: Array) -> Array:
    """Values (T, ...) in which NaN is replaced by interpolation between its neighbours."""
    visible = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    return values if visible.all() else interpolated(values[visible], times[visible], times)


def resampled(values: Array, times: Array, rate: float) -> Array:
    """Values (T, ...) at times as frames at a constant rate from the first time on: filtered if the times are even."""
    step = float(times[-1] - times[0]) / (len(times) - 1)
    count = int((times[-1] - times[0]) * rate + 1e-6) + 1
    if np.abs(times - np.linspace(times[0], times[-1], len(times))).max() < EVEN * step:
        # Rates that differ by less than a part of a frame over the clip are one.
        same = abs(step * rate - 1) * len(times) < EVEN
        return values if same else np.asarray(resample_frames(values, 1 / step, rate))[:count]
    return interpolated(values, times, times[0] + np.arange(count) / rate)


def smooth(motion: Array, rate: float, acceleration: float, variance: float) -> Array:
    """The Rauch-Tung-Striebel smoother of motion (T, ...): position and velocity with white acceleration, no lag.

    Args:
        motion: any number of coordinates over time.
        rate: frames a second.
        acceleration: spectral density of the acceleration, in the motion's unit²/s³.
        variance: of the noise of a coordinate.
    """
    rows = motion.reshape(len(motion), -1)
    step = 1 / rate
    move = np.array([[1, step], [0, 1]])
    noise = acceleration * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    means = np.zeros((len(rows), 2, rows.shape[1]))
    covariances = np.zeros((len(rows), 2, 2))
    means[0, 0], covariances[0] = rows[0], np.diag([variance, acceleration])
    for t in range(1, len(rows)):
        mean, covariance = move @ means[t - 1], move @ covariances[t - 1] @ move.T + noise
        gain = covariance[:, 0] / (covariance[0, 0] + variance)
        means[t] = mean + gain[:, None] * (rows[t] - mean[0])
        covariances[t] = covariance - np.outer(gain, covariance[0])
    for t in range(len(rows) - 2, -1, -1):
        predicted = move @ covariances[t] @ move.T + noise
        gain = covariances[t] @ move.T @ np.linalg.inv(predicted)
        means[t] += gain @ (means[t + 1] - move @ means[t])
    return means[:, 0].reshape(motion.shape)


def smooth_soft(motion: Array, rate: float) -> Array:
    """Motion smoothed as the face outside of lips and lids."""
    return smooth(motion, rate, *SOFT)


def smooth_by_region(faces: Array, rate: float, triangles: npt.NDArray[np.int64]) -> Array:
    """Faces (T, 478, 3) smoothed: little at lips and lids, more elsewhere."""
    weights = sharpness(without_webs(triangles), faces.shape[1])[:, None]
    return weights * smooth(faces, rate, *SHARP) + (1 - weights) * smooth_soft(faces, rate)


def horizontal_gaze(faces: Array) -> Array:
    """Angle of the gaze to the face's left in degrees (T,), mean of both eyes, from faces with irises."""
    angles = []
    for side, corners in EYE_CORNERS.items():
        offset = faces[:, IRIS[side], 0] - faces[:, list(corners), 0].mean(axis=1)
        angles.append(np.degrees(np.arcsin(np.clip(offset / EYE_RADIUS, -1, 1))))
    return np.mean(angles, axis=0)


def iris_width(faces: Array) -> float:
    """Median diameter of the irises in millimetres, which people have at 11.7 ± 0.5."""
    rims = [faces[:, [first + 1, first + 3]] for first in IRIS.values()]
    return float(np.median([np.linalg.norm(rim[:, 0] - rim[:, 1], axis=1) for rim in rims]))


def pair_distances(faces: npt.NDArray[np.floating], pairs: npt.ArrayLike = LIP_PAIRS) -> Array:
    """Mean distance of pairs of vertices (T,), of the inner lips if no others are given, of faces (T, V, 3)."""
    upper, lower = np.asarray(pairs).T
    return np.asarray(np.linalg.norm(faces[:, upper] - faces[:, lower], axis=-1).mean(axis=-1))
