"""Motion of parts that the animation's face lacks: teeth, tongues, eyeballs, lashes, hair, a body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.editing.face_features import Features, Opening
from facediff.editing.lid_transfer import LidEdges, along, lid_edges
from facediff.editing.surface import Nearest, Surface, nearest
from facediff.utils.numerics import Array, Indices

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
BETWEEN = 0.6  # A piece of which more than this share is seen in an eye's opening belongs to the eyeball
LASH, LASHES = 0.15, 1.5  # Lashes begin so near to a lid's edge, and are no wider, in widths of the eye
ROOT, SINGLE = 0.3, 0.1  # A piece's root is so much of its way from the lid; narrower, in widths, it is a single lash
RISES = 0.25  # A lash may lie so much of its rise further from its own lid than from the other one


@dataclass(frozen=True, eq=False)
class DetachedParts:
    """Pieces that move as a whole: with the jaw, or not at all. All others follow the skin."""

    jaw: Indices  # vertices of lower teeth and a tongue
    still: Indices  # vertices of all that stands still
    jaw_point: Nearest  # (1,) the point of the source that the jaw moves with
    # (A,) vertices of what lies on the mesh's skin and moves with it, the skin's vertices (A, 3) there, and weights
    followers: tuple[Indices, Indices, Array]


def detached_parts(
    source: Surface, laid: Surface, features: Features, target_features: Features, unpaired: list[Indices]
) -> DetachedParts:
    """Sort the pieces of a mesh that is laid onto a source by where they are.

    Teeth and tongues lie behind the lips; below the gap between both rows of teeth they follow the jaw. Other pieces
    inside the head stand still, and so do large ones, such as hair or a body, unless they lie about the mouth as a
    beard does, and pieces in front of the skin, such as glasses. Brows and a beard move with the skin below them, and
    lashes with the edge of their lid.

    Args:
        source: the animation's face.
        laid: the mesh, in the source's place.
        features: of the source's face.
        target_features: of the mesh.
        unpaired: vertices of each of the mesh's pieces without a partner among the source's pieces.
    """
    from scipy.spatial import cKDTree

    mouth, width = target_features.mouth.centre, target_features.mouth.width
    jaw_point = nearest(
        Surface(source.vertices, source.faces[features.skin[source.faces[:, 0]]]),
        features.mouth.centre[None] - [[0.0, 0.45 * features.mouth.width, 0.0]],
        np.array([[0.0, 0.0, 1.0]]),
    )
    none = np.zeros(0, np.int64), np.zeros((0, 3), np.int64), np.zeros((0, 3))
    unpaired = [some for some in unpaired if len(some) and not target_features.skin[some].any()]
    if not unpaired:
        return DetachedParts(none[0], none[0], jaw_point, none)
    which, starts = np.concatenate(unpaired), np.cumsum([0, *(len(some) for some in unpaired[:-1])])
    points, counts = laid.vertices[which], np.array([len(some) for some in unpaired])

    def mean(values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, starts) / counts.reshape(-1, *(1,) * (values.ndim - 1)))

    middle = mean(points)
    extent = (np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)).max(axis=1)
    skin = laid.vertices[target_features.skin]
    near = cKDTree(skin).query(points)[1]
    # Behind the nearest skin, by its normal, for most of a piece's vertices: eyeballs and gums poke through here and
    # there.
    inside = (
        mean((np.einsum("nd,nd->n", points - skin[near], laid.normals[target_features.skin][near]) < 0).astype(float))
        > 0.7
    )
    # Lips protrude, so that the line between them lies behind what hangs in front, such as a moustache.
    oral = (
        (np.linalg.norm(middle - mouth, axis=1) < ORAL * width) & (extent < SMALL * width) & (middle[:, 2] < mouth[2])
    )
    about = mean((np.linalg.norm(points - mouth, axis=1) < ABOUT * width).astype(float)) > BEARD
    about &= middle[:, 1] < mouth[1] + BELOW * width
    large = extent > LARGE * width
    lower = oral & (middle[:, 1] < _gap(middle[oral, 1], mouth[1], width))
    # What lies between the lids belongs to the eyeball: an iris, a cornea, a reflection.
    between = _between_lids(points, starts, target_features)
    lash = lash_pieces(laid.vertices, unpaired, target_features) & ~oral & ~large
    still = ~lower & ~lash & (oral | inside | between | (large & ~about))
    # What else is there lies on the skin, or is worn in front of it.
    left = ~lower & ~lash & ~still
    lies = np.repeat(left, counts)
    skin_faces = Surface(laid.vertices, laid.faces[target_features.skin[laid.faces[:, 0]]])
    followers = none
    if lies.any():
        on_skin = nearest(skin_faces, points[lies], np.zeros((np.count_nonzero(lies), 3)), 0.0)
        away = np.zeros(len(which))
        away[lies] = on_skin.distances
        distances = [np.median(away[first : first + count]) for first, count in zip(starts, counts, strict=True)]
        worn = (np.array(distances) > ON_SKIN * width) & ~about & left
        # Frames of glasses that were large stood still already; their pads touch the nose and belong to them.
        frames = np.repeat(worn | (large & ~about & ~inside & (middle[:, 2] > mouth[2] - width)), counts)
        if frames.any():
            gap = cKDTree(points[frames]).query(points)[0]
            belongs = mean((gap < np.minimum(TOUCHES * width, np.maximum(away, 0.01 * width))).astype(float)) > 0.5
            worn |= belongs & left
        still |= worn
        rows = ~np.repeat(worn, counts)[lies]
        followers = which[lies][rows], on_skin.corners[rows], on_skin.weights[rows]
    lashes = [some for some, is_lash in zip(unpaired, lash, strict=True) if is_lash]
    rims = np.concatenate([none[0], *lashes]), *_rim_places(laid.vertices, lashes, target_features)
    return DetachedParts(
        which[np.repeat(lower, counts)],
        which[np.repeat(still, counts)],
        jaw_point,
        (
            np.concatenate([followers[0], rims[0]]),
            np.concatenate([followers[1], rims[1]]),
            np.concatenate([followers[2], rims[2]]),
        ),
    )


def _between_lids(points: Array, starts: Indices, features: Features) -> Mask:
    """Which pieces (P,) of points (N, 3) are seen in an eye's opening; points at its edge, as roots are, say little."""
    eyes, inside = [eye for eye in features.eyes if eye is not None], np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for eye in eyes:
        top, bottom = (np.interp(x, side[:, 0], side[:, 1], -np.inf, -np.inf) for side in (eye.upper, eye.lower))
        inside |= (y < top) & (y > bottom)
    away = np.min([_from_edges(points, eye) for eye in eyes] or [np.zeros(len(points))], axis=0)
    return np.asarray(np.add.reduceat(inside * away, starts) > BETWEEN * np.add.reduceat(away, starts))


def _from_edges(points: Array, eye: Opening) -> Array:
    """Distances (N,) of points (N, 3) from the nearer edge of an eye's lids."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(np.concatenate([eye.upper, eye.lower])).query(points)[0])


def lash_pieces(vertices: Array, pieces: list[Indices], features: Features) -> Mask:
    """Which pieces of a mesh begin at the edge of a lid, and do not lie between both lids as an iris does."""
    points, starts = vertices[np.concatenate(pieces)], np.cumsum([0, *(len(some) for some in pieces[:-1])])
    extent = (np.maximum.reduceat(points, starts) - np.minimum.reduceat(points, starts)).max(axis=1)
    is_lash = np.zeros(len(pieces), bool)
    for eye in _open_eyes(vertices, features):
        away, width = _from_edges(points, eye.opening), eye.opening.width
        near = np.minimum.reduceat(away, starts) < LASH * width
        is_lash |= near & (np.maximum.reduceat(away, starts) < 0.5 * width) & (extent < LASHES * width)
    return is_lash & ~_between_lids(points, starts, features)


def _open_eyes(vertices: Array, features: Features) -> list[LidEdges]:
    return [edges for eye in (0, 1) if (edges := lid_edges(vertices, features, eye)) is not None]


def _rim_places(vertices: Array, lashes: list[Indices], features: Features) -> tuple[Indices, Array]:
    """Two vertices of a lid's edge, the second one twice, between which each vertex of lashes moves; weights; (A, 3).

    All vertices of a single lash have one place, at its root, so that it keeps its shape.
    """
    corners, weights = [np.zeros((0, 3), np.int64)], [np.zeros((0, 3))]
    rims = [(rim, SINGLE * eye.opening.width) for eye in _open_eyes(vertices, features) for rim in eye.rims]
    for some in lashes:
        positions, away = np.array([along(vertices[some], vertices[rim]) for rim, _ in rims]).transpose(1, 2, 0)
        nearest_rim, nearest_own = away.argmin(axis=1), np.arange(len(some))
        # Where both lids meet, a lash that rises is an upper one.
        first, tip = away.min(axis=1).argsort()[[0, -1]]
        rise = vertices[some[tip], 1] - vertices[some[first], 1]
        lid = int((away.mean(axis=0) - np.tile([RISES * rise, -RISES * rise], len(rims) // 2)).argmin())
        root = vertices[some[away[:, lid] <= away[:, lid].min() + ROOT * np.ptp(away[:, lid])]]
        if np.ptp(root, axis=0).max() < rims[lid][1]:
            nearest_rim[:], nearest_own[:] = lid, away[:, lid].argmin()
        for rim, position in zip(nearest_rim, positions[nearest_own, nearest_rim], strict=True):
            low = min(int(position), len(rims[rim][0]) - 2)
            corners.append(rims[rim][0][[[low, low + 1, low + 1]]])
            weights.append(np.array([[low + 1.0 - position, position - low, 0.0]]))
    return np.concatenate(corners), np.concatenate(weights)


def _gap(heights: Array, line: float, width: float) -> float:
    """The height between upper and lower teeth: a gap near the line between the lips, else that line."""
    ordered = np.sort(heights)
    gaps, between = np.diff(ordered), 0.5 * (ordered[1:] + ordered[:-1])
    # Upper teeth reach below the line; a wide gap above it is that to the palate.
    worth = np.minimum(gaps, CAP * width) - np.abs(between - line + OVERBITE * width)
    worth = np.where(gaps > ROW * width, worth, 0.0)
    return float(between[worth.argmax()]) if len(worth) and worth.max() > 0 else line
