"""Where a topology's eyelids and eyeballs are, and how the lids shut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.directing.layers import Array, smooth_step
from facediff.errors import FaceDiffError

Indices = npt.NDArray[np.int64]

GIVE = (
    "give --eyes FILE, which says where lids and eyeballs are (docs/directing.md shows one for FLAME and for any mesh)"
)
STILL = 0.01
"""Vertices that a blink moves by less than this share of its largest way are left alone."""
MEET = 0.12
"""Where the lids meet, from the lower (0) to the upper edge (1): the lower lid hardly rises in a blink."""
AHEAD = 0.025
"""The shut upper lid lies further out by this share of the eye's width: its way is straight, the eyeball is round."""
REACH = 0.4
"""How far from the edges the skin follows, as a share of the eye's width."""


@dataclass(frozen=True, eq=False)
class Eyes:
    """The eyes of a face.

    Attributes:
        closing: (V, 3) way from open to shut lids, in the face's unit; zero wherever a blink moves nothing. None if it
            is not known.
        eyeballs: vertices of each eyeball.
        source: who says so, for messages.

    Raises:
        FaceDiffError: if the closing moves nothing or is not finite, or an eyeball is no set of four vertices or more.
    """

    closing: npt.NDArray[np.float32] | None
    eyeballs: tuple[Indices, ...]
    source: str

    def __post_init__(self) -> None:
        if self.closing is not None and not (np.isfinite(self.closing).all() and self.closing.any()):
            raise FaceDiffError(f"{self.source}: its blink moves nothing, or holds NaN; give the shape of shut eyes")
        if any(len(ball) < 4 for ball in self.eyeballs):
            raise FaceDiffError(f"{self.source}: an eyeball of less than four vertices has no centre; name all of them")

    def lids(self) -> tuple[Indices, npt.NDArray[np.float32]]:
        """The vertices (L,) that a blink moves, and their ways (L, 3).

        Raises:
            FaceDiffError: if the way is not known.
        """
        if self.closing is None:
            raise FaceDiffError(f"{self.source}: does not say how the lids shut; {GIVE}")
        way = np.linalg.norm(self.closing, axis=-1)
        chosen = np.flatnonzero(way > STILL * way.max())
        return chosen, self.closing[chosen]


def sphere_centre(points: npt.NDArray[np.floating]) -> Array:
    """Centre (3,) of the sphere nearest to points (N, 3), which may be a part of it only, by linear least squares.

    |x − c|² = r² is linear in c and r² − |c|²: 2 x·c + (r² − |c|²) = |x|².
    """
    middle = np.asarray(points, np.float64).mean(axis=0)
    local = np.asarray(points, np.float64) - middle
    solution = np.linalg.lstsq(
        np.concatenate([2.0 * local, np.ones((len(local), 1))], axis=1), (local**2).sum(axis=1), rcond=None
    )[0]
    return np.asarray(middle + solution[:3])


def closing_of_lids(
    template: npt.NDArray[np.floating], lids: list[tuple[Indices, Indices]], rigid: Indices | None = None
) -> npt.NDArray[np.float32]:
    """How lids shut (V, 3), from the vertices of their edges alone.

    Both edges run from one corner of the eye to the other. Each edge vertex goes to the line between them at its own
    share of the way along; the skin around follows its nearest edge vertices, less and less up to 0.4 of the eye's
    width away.

    Args:
        template: (V, 3) the neutral face with open eyes, y up and z to the viewer.
        lids: for each eye the vertices of the upper and of the lower edge.
        rigid: vertices that do not follow (eyeballs).
    """
    places = np.asarray(template, np.float64)
    closing = np.zeros_like(places)
    for upper, lower in lids:
        top, bottom = places[upper], places[lower]
        if np.linalg.norm(top[0] - bottom[0]) > np.linalg.norm(top[0] - bottom[-1]):
            bottom = bottom[::-1]
            lower = lower[::-1]
        width = max(float(np.linalg.norm(np.ptp(edge, axis=0))) for edge in (top, bottom))
        edge = np.concatenate([upper, lower])
        way = np.concatenate([_ways(top, bottom, width), _ways(bottom, top, width)])
        way[len(upper) :] *= MEET
        way[: len(upper)] *= 1.0 - MEET
        way[: len(upper), 2] += AHEAD * width * _arch(top)
        way[len(upper) :, 2] += 0.5 * AHEAD * width * _arch(bottom)
        distance = np.linalg.norm(places[:, None] - places[edge], axis=-1)
        near = np.flatnonzero(distance.min(axis=1) < REACH * width)
        share = 1.0 - smooth_step(distance[near].min(axis=1) / (REACH * width))
        # Inverse distances to the fourth power: at an edge vertex its own way alone, in between a blend.
        pull = 1.0 / np.maximum(distance[near], 1e-6 * width) ** 4
        blended = share[:, None] * (pull @ way) / pull.sum(axis=1, keepdims=True)
        larger = np.linalg.norm(blended, axis=1) > np.linalg.norm(closing[near], axis=1)
        closing[near[larger]] = blended[larger]
    if rigid is not None:
        closing[rigid] = 0.0
    return closing.astype(np.float32)


def _along(edge: Array) -> Array:
    """Share of the way along an edge (N, 3) at each of its vertices (N,), 0 to 1."""
    steps = np.linalg.norm(np.diff(edge, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / max(float(steps.sum()), 1e-12)


def _ways(edge: Array, other: Array, width: float) -> Array:
    """From each vertex of an edge (N, 3) to the other edge, at the same share of the way along."""
    if len(edge) < 2 or len(other) < 2 or width <= 0:
        raise FaceDiffError("lids: an edge needs two vertices at least, from one corner of the eye to the other")
    at, knots = _along(edge), _along(other)
    target = np.stack([np.interp(at, knots, other[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(target - edge)


def _arch(edge: Array) -> Array:
    """1 in the middle of an edge, 0 at the corners (N,)."""
    return np.asarray(np.sin(np.pi * _along(edge)))
