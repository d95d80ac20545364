"""Laying one mesh onto another of unknown unit, axes and vertices: by size, then nearest points, then planes."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import torch

from facediff.retarget.surface import Surface, nearest
from facediff.topology import Similarity, align, face_size

Array = npt.NDArray[np.float64]

SAMPLES = 400
"""Vertices of each mesh by which starts are compared."""
FINE_SAMPLES = 1500
"""Vertices of the moved mesh by which the placing is refined."""
COARSE_ROUNDS, FINE_ROUNDS = 30, 60
TRIMMED = 0.8
"""Share of the nearest pairs that counts, so that a neck or hair that one mesh lacks does not."""
CLEARLY = 0.9
"""Another start than the meshes' own axes must fit better by this factor."""
TUKEY = 4.685
SETTLED = 1e-10


def place(moved: Surface, goal: Surface, start: Similarity | None = None) -> Similarity:
    """The similarity that lays one surface onto another.

    Starts are the 24 turns of one frame of axes into another and the turns of principal axes, with sizes made equal;
    the best by nearest vertices, both ways and trimmed, is refined by nearest points of the surface: Besl and McKay, "A
    method for registration of 3-D shapes", PAMI 1992, and Chen and Medioni, "Object modelling by registration of
    multiple range images", IVC 1992 (distances to planes).

    Args:
        moved: what to lay.
        goal: onto what.
        start: where to begin; looked for if None.
    """
    return _refined(moved, goal, start or _start(moved, goal))


def _start(moved: Surface, goal: Surface) -> Similarity:
    random = np.random.default_rng(0)
    source, target = (_some(surface, SAMPLES, random) for surface in (moved, goal))
    trials = []
    for rotation in (np.eye(3), *_turns(), *_principal_turns(source, target)):
        scale = face_size(target) / face_size(source)
        trial = Similarity(rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale)
        for _ in range(5):
            trial, apart = _by_vertices(source, target, trial)
        trials.append((apart, trial))
    own, (least, best) = trials[0], min(trials, key=lambda pair: pair[0])
    found = best if least < CLEARLY * own[0] else own[1]
    for _ in range(COARSE_ROUNDS):
        found, _ = _by_vertices(source, target, found)
    return found


def _by_vertices(source: Array, target: Array, current: Similarity) -> tuple[Similarity, float]:
    """One round of nearest vertices, both ways; and how far apart the pairs were, as a share of the size."""
    laid = current.apply(source)
    away = torch.cdist(torch.from_numpy(laid), torch.from_numpy(target)).numpy()
    to, back = away.argmin(axis=1), away.argmin(axis=0)
    pairs = np.concatenate([np.stack([np.arange(len(source)), to]), np.stack([back, np.arange(len(target))])], axis=1)
    apart = away[pairs[0], pairs[1]]
    counted = apart <= np.quantile(apart, TRIMMED)
    found = align(source[pairs[0]], target[pairs[1]], weights=counted.astype(np.float64), scale=True)
    return found, float(apart[counted].mean() / face_size(target))


def _refined(moved: Surface, goal: Surface, start: Similarity) -> Similarity:
    """Gauss-Newton on distances to the planes at the nearest points, with Tukey's biweight."""
    random = np.random.default_rng(0)
    used = np.unique(moved.faces)
    used = used if len(used) <= FINE_SAMPLES else np.sort(random.choice(used, FINE_SAMPLES, replace=False))
    points, normals, found = moved.vertices[used], moved.normals[used], start
    for _ in range(FINE_ROUNDS):
        laid = found.apply(points)
        there = nearest(goal, laid, normals @ found.rotation.T, size=0.0)
        spread = max(1.4826 * float(np.median(there.distances)), 1e-9 * goal.size)
        weights = np.square(np.clip(1.0 - np.square(there.distances / (TUKEY * spread)), 0.0, None))
        weights *= there.cosines > 0.5
        if np.count_nonzero(weights) < 20:
            break
        step = _towards_planes(laid, there.points, there.normals, weights, goal.size)
        found = found.then(step)
        if np.abs(step.apply(laid) - laid).max() < SETTLED * goal.size:
            break
    return found


def _towards_planes(points: Array, goals: Array, normals: Array, weights: Array, size: float) -> Similarity:
    """The small similarity with the least weighted squared distances to planes, to first order."""
    centre = points.mean(axis=0)
    arms = (points - centre) / size
    rows = np.concatenate(
        [np.cross(arms, normals), normals, (arms * normals).sum(axis=1, keepdims=True)], axis=1
    )  # turn, shift, growth; the turn about the centre
    left = ((goals - points) * normals).sum(axis=1) / size
    weighted = rows * weights[:, None]
    # What planes do not tell (the turn of a ball) stays as it is.
    turn, shift, growth = np.split(np.linalg.lstsq(weighted.T @ rows, weighted.T @ left, rcond=1e-9)[0], [3, 6])
    rotation = _rotation(turn)
    scale = float(np.exp(np.clip(growth[0], -0.5, 0.5)))
    return Similarity(rotation, centre + size * shift - scale * rotation @ centre, scale)


def _rotation(vector: Array) -> Array:
    """Rotation by a vector's length about it (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def _turns() -> list[Array]:
    """The proper turns that take axes to axes, without the one that does nothing."""
    made = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(3)):
                made.append(turn)
    return made


def _principal_turns(source: Array, target: Array) -> list[Array]:
    """The four proper turns of principal axes into one another."""
    axes = [np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2] for points in (source, target)]
    turns = [axes[1].T @ np.diag(signs) @ axes[0] for signs in itertools.product((1.0, -1.0), repeat=3)]
    return [turn for turn in turns if np.linalg.det(turn) > 0]


def _some(surface: Surface, count: int, random: np.random.Generator) -> Array:
    used = np.unique(surface.faces)
    return surface.vertices[random.choice(used, min(count, len(used)), replace=False)]
