"""What pieces of a head do that the animation's face lacks: teeth, tongues, eyeballs, lashes, hair, a body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.editing.face_features import Features
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


@dataclass(frozen=True, eq=False)
class Loose:
    """Pieces that move as a whole: with the jaw, or not at all. All others follow the skin."""

    jaw: Indices  # vertices of lower teeth and a tongue
    still: Indices  # vertices of all that stands still
    place: Nearest  # (1,) the place of the jaw on the source


def loose_pieces(source: Surface, laid: Surface, features: Features, seen: Features, alone: list[Indices]) -> Loose:
    """Sort the pieces of a mesh that is laid onto a source by where they are.

    Teeth and tongues lie behind the lips; those below the gap between both rows of teeth follow the jaw. What else lies
    inside the head stands still, and so does what is large, such as hair or a body, unless it lies about the mouth as a
    beard does. What lies in front of the skin, such as brows and lashes, follows it.

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
    alone = [some for some in alone if len(some) and not seen.skin[some].any()]
    if not alone:
        return Loose(np.zeros(0, np.int64), np.zeros(0, np.int64), place)
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
    large = extent > LARGE * width
    lower = oral & (middle[:, 1] < _gap(middle[oral, 1], mouth[1], width))
    still = ~lower & (oral | inside | (large & ~about))
    return Loose(which[np.repeat(lower, counts)], which[np.repeat(still, counts)], place)


def _gap(heights: Array, line: float, width: float) -> float:
    """The height between upper and lower teeth: a gap near the line between the lips, else that line."""
    ordered = np.sort(heights)
    gaps, between = np.diff(ordered), 0.5 * (ordered[1:] + ordered[:-1])
    # Upper teeth reach below the line; a wide gap above it is that to the palate.
    worth = np.minimum(gaps, CAP * width) - np.abs(between - line + OVERBITE * width)
    worth = np.where(gaps > ROW * width, worth, 0.0)
    return float(between[worth.argmax()]) if len(worth) and worth.max() > 0 else line
