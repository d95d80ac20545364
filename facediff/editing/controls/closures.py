"""Lips that meet at p, b and m, at the times of an alignment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facediff.animation import Animation
from facediff.animation.animation import measured, metres_per_unit
from facediff.editing.controls.expressiveness import ALL, region_factors
from facediff.editing.controls.procedural import EDITED, copied, with_metadata
from facediff.errors import FaceDiffError
from facediff.utils.numerics import Array, smooth_step

RAMP = 0.08  # Seconds in which lips come together, and part again
BUDGET = 12.0  # Largest displacement of a vertex in millimetres, by default
LEAST = 1e-4  # Opening in metres below which the animation does not show how the face opens its mouth


def close_lips(animation: Animation, closures: Sequence[tuple[float, float]], budget: float = BUDGET) -> Animation:
    """Let the lips touch in stretches of time, smoothly, by moving no vertex further than a budget.

    How this face opens its mouth is taken from the animation itself: each vertex's motion is regressed on the signed
    opening, the mean distance of the inner-lip pairs along the direction in which they part. At a closure, the excess
    of the opening over the neutral face's is taken back; motion that does not open the mouth, such as rounding, stays.
    Frames without a closure nearby, and frames in which the lips meet already, are unchanged bit for bit.

    Args:
        animation: with inner-lip pairs.
        closures: start and end of each, in seconds.
        budget: millimetres; a closure that would need more stays open by the rest.
    """
    if animation.inner_lip_pairs is None or not len(animation.inner_lip_pairs):
        raise FaceDiffError(
            f"{animation.name}: does not say which vertices of the inner lips meet; use a model or a mesh with "
            f"regions/inner_lip_pairs.txt"
        )
    bumps = closure_weights(closures, len(animation.vertices), animation.frame_rate)
    upper, lower = animation.inner_lip_pairs.T
    metre = 1 / metres_per_unit(animation.unit)
    rest = np.asarray(animation.template, np.float64)
    still = rest[upper] - rest[lower]
    gaps = measured(
        animation.vertices,
        lambda vertices: np.asarray(vertices[:, upper], np.float64) - vertices[:, lower] - still,
    )
    apart = np.linalg.norm(gaps, axis=-1).mean(1)
    # The widest fifth of the frames gives the direction in which lips part: at rest, gaps have none.
    widest = gaps[apart >= np.quantile(apart, 0.8)].mean(0)
    if apart.max(initial=0) < LEAST * metre or not bumps.any():
        return animation
    direction = widest / np.maximum(np.linalg.norm(widest, axis=-1, keepdims=True), 1e-12)
    opening = (gaps * direction).sum(-1).mean(1)
    shape = _shape_of_opening(animation, opening)
    # Moving by the shape changes the opening by about 1; exactly by this much.
    per_unit = float(((shape[upper] - shape[lower]) * direction).sum(-1).mean())
    if per_unit < 0.2:
        return animation  # this face does not open its mouth
    # Lips pressed together more firmly than at rest are left as they are.
    excess = np.maximum(opening, 0) / per_unit
    reach = float(np.linalg.norm(shape, axis=-1).max()) or 1.0
    amounts = bumps * excess
    largest = np.maximum(amounts.max(axis=1, keepdims=True) * reach, 1e-12)
    amounts = (amounts * np.minimum(1.0, budget / 1000 * metre / largest)).max(axis=0)
    if not amounts.any():
        return animation
    vertices = copied(animation.vertices)
    for frame in np.flatnonzero(amounts):
        vertices[frame] -= (amounts[frame] * shape).astype(np.float32)
    moved = float(amounts.max()) * reach
    note = f"lips closed at {bumps.any(axis=1).sum()} p, b, m (moved by up to {1000 * moved / metre:.1f} mm)"
    return with_metadata(animation, vertices, EDITED, note)


def closure_weights(closures: Sequence[tuple[float, float]], frames: int, frame_rate: float) -> Array:
    """How far the lips are to be closed by each closure in each frame (closures, frames), 0 to 1.

    A weight is 1 in the middle half of a closure, at one frame at least, and rises and falls over :data:`RAMP` seconds.
    """
    middles = (np.arange(frames) + 0.5) / frame_rate
    weights = []
    for start, end in closures:
        centre, half = (start + end) / 2, max((end - start) / 4, 0.5 / frame_rate)
        away = np.maximum(np.abs(middles - centre) - half, 0)
        weights.append(1 - smooth_step(np.minimum(away / RAMP, 1)))
    return np.array(weights).reshape(len(weights), frames)


def _shape_of_opening(animation: Animation, opening: Array) -> Array:
    """How far each vertex moves (V, 3) when the mouth opens by 1, by regression over the frames; not the upper face."""
    centred = opening - opening.mean()
    total = float(centred @ centred)
    slope = np.zeros(animation.template.shape)
    for amount, frame in zip(centred, animation.frames(), strict=True):
        slope += amount * np.asarray(frame, np.float64)
    # Brows and lids move with speech without opening the mouth, and must not follow it when it closes.
    weights = np.ones(len(slope))
    if "upper_face" in animation.regions:
        weights = region_factors(animation.template, animation.regions, {"upper_face": 0.0, ALL: 1.0})
    return np.asarray(slope / max(total, 1e-20) * weights[:, None])
