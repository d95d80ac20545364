"""What cannot be shown is refused before anything is written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from facediff.errors import FaceDiffError
from facediff.takes import Take

MOST = 4
"""Takes on one page."""


def check_takes(takes: Sequence[Take], truth: int | None) -> None:
    """Refuse takes that do not make a page.

    Raises:
        FaceDiffError: if there are too few or too many, their clocks differ, one has no mesh or is not finite, or
            ``truth`` numbers none of them.
    """
    if not 1 <= len(takes) <= MOST:
        raise FaceDiffError(f"a page shows 1 to {MOST} takes side by side, not {len(takes)}; choose among them")
    if truth is not None and not 0 <= truth < len(takes):
        raise FaceDiffError(f"truth is number {truth} of {len(takes)} takes; number them from 0")
    first = takes[0]
    for take in takes:
        if take.frame_rate != first.frame_rate:
            raise FaceDiffError(
                f"{take.name}: has {take.frame_rate:g} frames a second and {first.name} {first.frame_rate:g}; takes on "
                f"one page need the same frame rate"
            )
        if len(take.vertices) != len(first.vertices):
            raise FaceDiffError(
                f"{take.name}: has {len(take.vertices)} frames and {first.name} {len(first.vertices)}; takes on one "
                f"page need the same length: cut them, as `facediff view --shortest` does"
            )
        check_take(take)


def check_take(take: Take) -> None:
    """Refuse a take that cannot be drawn.

    Raises:
        FaceDiffError: naming what is wrong.
    """
    if not len(take.triangles) or not np.isfinite(take.template).all():
        raise FaceDiffError(f"{take.name}: its template holds NaN or infinity; give a sound mesh")
    take.refuse_not_finite()
    pairs, count = take.inner_lip_pairs, len(take.template)
    if pairs is not None and len(pairs) and (pairs.ndim != 2 or pairs.shape[1] != 2 or not _within(pairs, count)):
        raise FaceDiffError(
            f"{take.name}: its pairs of inner lips have shape {pairs.shape} and go up to vertex {int(pairs.max())} of "
            f"{count}; expected (pairs, 2) of this mesh"
        )
    if take.colours is not None and take.colours.shape != (count, 3):
        raise FaceDiffError(
            f"{take.name}: its vertex colours have shape {take.colours.shape}; expected ({count}, 3), sRGB 0 to 255"
        )


def _within(indices: np.ndarray, count: int) -> bool:
    return bool(0 <= indices.min() <= indices.max() < count)


def comparable(take: Take, truth: Take) -> bool:
    """Whether a take has the truth's topology, so that its vertices have errors."""
    return take.triangles.shape == truth.triangles.shape and bool((take.triangles == truth.triangles).all())
