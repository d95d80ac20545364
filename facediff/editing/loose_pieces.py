"""What pieces of a head do that the animation's face lacks: teeth, tongues, eyeballs, lashes, hair, a body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.editing.face_features import LIDS, Features
from facediff.editing.surface import Nearest, Surface, nearest

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

ORAL = 0.9  # Pieces whose middle is so near to the mouth's, in its widths, are teeth or a tongue
SMALL = 1.6  # and are no larger than this
ROW = 0.06  # Between the rows of teeth lies a gap of at least this share of the mouth's width
CAP = 0.12  # A wider gap than this share says no more
OVERBITE = 0.05  # So far below the line between the lips, in widths, both rows meet
LARGE = 2.0  # Pieces larger than so many widths are hair, glasses, a beard or a body
ABOUT, BEARD = 1.2, 0.1  # A large piece of which so much lies within so many widths of the mouth is a beard
BELOW = 0.5  # and its middle is no further above the mouth than this share of its width
ON_SKIN = 0.08  # A piece no further from the skin than this share of the mouth's width lies on it; others are worn
TOUCHES = 0.05  # What is nearer than this to a thing that is worn, and nearer than to the skin, belongs to it
LASH, LASHES = 0.1, 1.5  # Lashes begin so near to a lid's edge, and are no wider, in widths of the eye


@dataclass(frozen=True, eq=False)
class Loose:
    """Pieces that move as a whole: with the jaw, or not at all. All others follow the skin."""

    jaw: Indices  # vertices of lower teeth and a tongue
    still: Indices  # vertices of all that stands still
    place: Nearest  # (1,) the place of the jaw on the source
    followers: Indices  # (A,) vertices of what lies on the mesh's own skin and moves with it
    follower_corners: Indices  # (A, 3) the skin's vertices that they move with
    follower_weights: Array  # (A, 3)


def loose_pieces(source: Surface, laid: Surface, features: Features, seen: Features, alone: list[Indices]) -> Loose:
    """Sort the pieces of a mesh that is laid onto a source by where they are.

    Teeth and tongues lie behind the lips; those below the gap between both rows of teeth follow the jaw. What else lies
    inside the head stands still, and so does what is large, such as hair or a body, unless it lies about the mouth as a
    beard does, and what is worn in front of the skin, such as glasses. Brows and a beard move with the skin that they
    lie on, and lashes with the edge of their lid.

    Args:
        source: the animation's face.
        laid: the mesh, in the source's place.
        features: openings of the source's face.
        seen: those of the mesh's.
        alone: vertices of each of the mesh's pieces that has no partner among the source's pieces.
    """
    from scipy.spatial import cKDTree

    mouth, width = seen.mouth.centre, seen.mouth.width
    place = nearest(
        Surface(source.vertices, source.faces[features.skin[source.faces[:, 0]]]),
        features.mouth.centre[None] - [[0.0, 0.45 * features.mouth.width, 0.0]],
        np.array([[0.0, 0.0, 1.0]]),
    )
    none = np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 3))
    alone = [some for some in alone if len(some) and not seen.skin[some].any()]
    if not alone:
        return Loose(none[0], none[0], place, *none)
    which, starts = np.concatenate(alone), np.cumsum([0, *(len(some) for some in alone[:-1])])
    points, counts = laid.vertices[which], np.array([len(some) for some in alone])

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts) / counts.reshape(-1, *(1,) * (values.ndim - 1)))

    middle = mean(points)
    extent = (np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)).max(axis=1)
    skin = laid.vertices[seen.skin]
    near = cKDTree(skin).query(points)[1]
    # Behind the nearest skin, by its normal, for most of a piece's vertices: eyeballs and gums poke through here and
    # there.
    inside = mean((np.einsum("nd,nd->n", points - skin[near], laid.normals[seen.skin][near]) < 0).astype(float)) > 0.7
    # Lips protrude, so that the line between them lies behind what hangs in front, such as a moustache.
    oral = (
        (np.linalg.norm(middle - mouth, axis=1) < ORAL * width) & (extent < SMALL * width) & (middle[:, 2] < mouth[2])
    )
    about = mean((np.linalg.norm(points - mouth, axis=1) < ABOUT * width).astype(float)) > BEARD
    about &= middle[:, 1] < mouth[1] + BELOW * width
    large = extent > LARGE * width
    lower = oral & (middle[:, 1] < _gap(middle[oral, 1], mouth[1], width))
    # What lies between the lids belongs to the eyeball: an iris, a cornea, a reflection.
    between = mean(_between_lids(points, seen).astype(float)) > 0.6
    lash = _lashes(points, starts, extent, seen) & ~oral & ~large & ~between
    still = ~lower & ~lash & (oral | inside | between | (large & ~about))
    # What else is there lies on the skin, or is worn in front of it.
    left = np.flatnonzero(~lower & ~lash & ~still)
    some = np.flatnonzero(np.isin(np.repeat(np.arange(len(alone)), counts), left))
    on_skin = (
        nearest(
            Surface(laid.vertices, laid.faces[seen.skin[laid.faces[:, 0]]]), points[some], np.zeros((len(some), 3)), 0.0
        )
        if len(some)
        else None
    )
    if on_skin is not None:
        away = np.zeros(len(which))
        away[some] = on_skin.distances
        worn = np.array([np.median(away[first : first + count]) for first, count in zip(starts, counts, strict=True)])
        worn_piece = (worn > ON_SKIN * width) & ~about
        worn_piece[[k for k in range(len(alone)) if k not in set(left)]] = False
        # Frames of glasses that were large stood still already; their pads touch the nose and belong to them.
        frames = np.repeat(worn_piece | (large & ~about & ~inside & (middle[:, 2] > mouth[2] - width)), counts)
        if frames.any():
            gap = cKDTree(points[frames]).query(points)[0]
            belongs = mean((gap < np.minimum(TOUCHES * width, np.maximum(away, 0.01 * width))).astype(float)) > 0.5
            worn_piece |= belongs & np.isin(np.arange(len(alone)), left)
        still |= worn_piece
        kept = ~np.repeat(worn_piece, counts)[some]
        followers = which[some][kept], on_skin.corners[kept], on_skin.weights[kept]
    else:
        followers = none
    lashes = which[np.repeat(lash, counts)]
    rims = _rim_vertices(laid.vertices, lashes, seen)
    return Loose(
        which[np.repeat(lower, counts)],
        which[np.repeat(still, counts)],
        place,
        np.concatenate([followers[0], lashes]),
        np.concatenate([followers[1], np.repeat(rims[:, None], 3, axis=1)]),
        np.concatenate([followers[2], np.tile([1.0, 0.0, 0.0], (len(lashes), 1))]),
    )


def _between_lids(points: Array, seen: Features) -> Mask:
    """Which points (N, 3) are seen in an eye's opening."""
    chosen = np.zeros(len(points), bool)
    for eye in seen.eyes:
        if eye is not None:
            x, y = points[:, 0], points[:, 1]
            top, bottom = (np.interp(x, side[:, 0], side[:, 1], -np.inf, -np.inf) for side in (eye.upper, eye.lower))
            chosen |= (y < top) & (y > bottom)
    return chosen


def _lashes(points: Array, starts: Indices, extent: Array, seen: Features) -> Mask:
    """Which pieces begin at the edge of a lid."""
    chosen = np.zeros(len(starts), bool)
    for eye in seen.eyes:
        if eye is not None:
            edges = np.concatenate([eye.upper, eye.lower])
            away = np.linalg.norm(points[:, None] - edges[None, ::2], axis=2).min(axis=1)
            near = np.minimum.reduceat(away, starts) < LASH * eye.width
            within = np.maximum.reduceat(away, starts) < 0.5 * eye.width
            chosen |= near & within & (extent < LASHES * eye.width)
    return chosen


def _rim_vertices(vertices: Array, lashes: Indices, seen: Features) -> Indices:
    """The vertex at the edge of a lid (A,) that each vertex of lashes moves with."""
    from scipy.spatial import cKDTree

    seeds = [
        own[seen.codes[own] == code]
        for eye, codes in zip(seen.eyes, LIDS, strict=True)
        if eye is not None
        for own, code in zip((eye.upper_seeds, eye.lower_seeds), codes, strict=True)
    ]
    if not len(lashes):
        return lashes
    rim = np.concatenate(seeds)
    return np.asarray(rim[cKDTree(vertices[rim]).query(vertices[lashes])[1]])


def _gap(heights: Array, line: float, width: float) -> float:
    """The height between upper and lower teeth: a gap near the line between the lips, else that line."""
    ordered = np.sort(heights)
    gaps, between = np.diff(ordered), 0.5 * (ordered[1:] + ordered[:-1])
    # Upper teeth reach below the line; a wide gap above it is that to the palate.
    worth = np.minimum(gaps, CAP * width) - np.abs(between - line + OVERBITE * width)
    worth = np.where(gaps > ROW * width, worth, 0.0)
    return float(between[worth.argmax()]) if len(worth) and worth.max() > 0 else line
