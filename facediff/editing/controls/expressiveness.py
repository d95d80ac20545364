"""Larger or smaller motion, region by region, with soft borders between regions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import allocate_like
from facediff.animation.options import Scales, scales_text
from facediff.editing.controls.eyelids import Eyes
from facediff.errors import OptionError, check_known
from facediff.utils.hints import Range, read
from facediff.utils.numerics import Array, Floats, Integers, nearest_distances, smooth_step

ALL = "all"  # The name of all vertices that no other name is given for
FALL_OFF = 0.06
"""Width of a region's soft border, as a share of the face's size (the diagonal of its box): about 2 cm on a head."""
HIGHEST = 4.0  # Motion more than this many times as large does not look like a face's any more


def read_factors(scales: Scales | None, option: str = "expressiveness", highest: float = HIGHEST) -> dict[str, float]:
    """Factors by region: ``1.2`` (all), or ``upper_face=1.5,lips=0.9``; empty for None.

    Example:
        >>> read_factors("upper_face=1.5,all=1.1")
        {'upper_face': 1.5, 'all': 1.1}
    """
    if scales is None:
        return {}
    factors: dict[str, float] = {}
    text = scales_text(scales)
    for word in text.split(","):
        name, equals, number = word.rpartition("=")
        name = name.strip() if equals else ALL
        try:
            factor = read(Annotated[float, Range(0, highest)], number.strip())
        except ValueError:
            factor = None
        if not name or factor is None or name in factors:
            raise OptionError(
                option,
                f"expected a factor from 0 to {highest:g} (1.2), or one for each region (upper_face=1.5,lips=0.9)",
                text,
            )
        factors[name] = factor
    return factors


def check_factors(factors: Iterable[str], regions: Mapping[str, object], name: str) -> None:
    """Refuse a region that the face called ``name`` does not have."""
    check_known(name, "region", factors, [*regions, ALL])


def scaled_regions(
    animation: Animation, factors: Mapping[str, float | Floats], eyes: Eyes | None = None
) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3) that go further from the neutral face, or less far; the head must not sway yet.

    Args:
        animation: with the regions that are named.
        factors: by region, a number or one for each frame (T,); ``all`` covers the vertices outside of the others.
        eyes: where they are known, the closing of the lids is left as it is: a blink stays a blink, and lids that meet
            do not run through each other.
    """
    weights = region_weights(animation.template, animation.regions, list(factors), animation.name)
    lids, closing = (np.zeros(0, np.int64), None) if eyes is None or eyes.closing is None else eyes.lids()
    vertices = allocate_like(animation.vertices)
    count = len(animation.vertices)
    in_frames = {name: np.broadcast_to(np.asarray(value, np.float64), count) for name, value in factors.items()}
    amounts: dict[str, float] = {}
    for index, frame in enumerate(animation.vertices):
        before, amounts = amounts, {name: float(values[index]) for name, values in in_frames.items()}
        # Factors mostly stand still, and blending the regions costs as much as scaling a frame.
        if amounts != before:
            factor = weights.factors(amounts).astype(np.float32)
        offsets = frame - animation.template
        scaled = factor[:, None] * offsets
        if closing is not None:
            # The closing of the lids stays as it was before scaling.
            share = np.clip((offsets[lids] * closing).sum(-1) / (closing**2).sum(-1), 0.0, 1.0)
            scaled[lids] += ((1.0 - factor[lids]) * share)[:, None] * closing
        vertices[index] = animation.template + scaled
    return vertices


@dataclass(frozen=True, eq=False)
class RegionWeights:
    """How much each region counts at each vertex."""

    names: tuple[str, ...]  # the regions but for ``all``
    weights: Array  # (regions, V), between 0 and 1
    rest: Array  # (V,) the remainder, for ``all``

    def factors(self, factors: Mapping[str, float]) -> Array:
        """The factor of every vertex (V,), from factors of the regions and ``all`` (1 if absent)."""
        of_regions = np.array([factors[region] for region in self.names]) @ self.weights
        return np.asarray(of_regions + self.rest * factors.get(ALL, 1.0))


def region_factors(
    template: Floats,
    regions: Mapping[str, Integers],
    factors: Mapping[str, float],
    name: str = "expressiveness",
    fall_off: float | None = None,
) -> Array:
    """The factor of every vertex (V,), a blend of the regions' factors.

    A region weighs 1 on its own vertices and falls to 0 over ``fall_off`` outside of it, by the distance d in the
    neutral face: 1 − s(d / fall_off) with s(t) = 3t² − 2t³. Where weights sum to more than 1 they are divided by their
    sum, and the remainder to 1 belongs to ``all``: together they are a partition of unity. With a region's factor f and
    the factor g of the rest, factors at x and y differ by at most 1.5 |f − g| |x − y| / fall_off, since a distance
    changes no faster than its place, and s no faster than 1.5.

    Args:
        template: (V, 3) the neutral face.
        regions: vertex indices by name.
        factors: by region, or ``all`` (1 if absent).
        name: of the face, for the message.
        fall_off: in the template's unit; :data:`FALL_OFF` of the face's size if None.
    """
    return region_weights(template, regions, list(factors), name, fall_off).factors(factors)


def region_weights(
    template: Floats,
    regions: Mapping[str, Integers],
    names: Sequence[str],
    name: str = "expressiveness",
    fall_off: float | None = None,
) -> RegionWeights:
    """The weights of regions at every vertex; arguments as in :func:`region_factors`."""
    check_factors(names, regions, name)
    points = np.asarray(template, np.float64)
    width = FALL_OFF * float(np.linalg.norm(np.ptp(points, axis=0))) if fall_off is None else fall_off
    region_names = tuple(region for region in names if region != ALL)
    weights = np.zeros((len(region_names), len(points)))
    for row, region in zip(weights, region_names, strict=True):
        distances = np.full(len(points), np.inf)
        members = with_jaw(points, regions) if region == "lips" else regions[region]
        if len(members):  # a face that was carried to a mesh without the region has none
            distances = nearest_distances(points, points[members], width)
        row[:] = 1.0 - smooth_step(distances / max(width, 1e-12))
    # Where regions overlap, their weights are made to sum to one; without it, two factors of 1 would scale by 2.
    total = weights.sum(axis=0)
    weights /= np.maximum(total, 1.0)
    return RegionWeights(region_names, weights, np.clip(1.0 - total, 0.0, None))


def with_jaw(points: Array, regions: Mapping[str, Integers]) -> Integers:
    """The lips and all vertices below them (V,): lips that open further by themselves leave the chin behind."""
    lips, brows = regions["lips"], regions.get("upper_face", ())
    if not len(lips) or not len(brows):
        return lips
    down = points[lips].mean(0) - points[brows].mean(0)
    depth = points @ (down / max(float(np.linalg.norm(down)), 1e-12))
    return np.union1d(lips, np.flatnonzero(depth > depth[lips].max()))


def rest_weights(template: Floats, regions: Mapping[str, Integers]) -> npt.NDArray[np.float32]:
    """How far each vertex (V,) of a neutral face (V, 3) goes to rest in pauses: all that speech moves."""
    # Fading into the upper face as regions fade elsewhere.
    return region_factors(np.asarray(template, np.float32), regions, {"upper_face": 0.0, ALL: 1.0}).astype(np.float32)
