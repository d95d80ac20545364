"""Whether the eyes and the forehead of a carried animation can be used: do lids meet, pass, dive, tear or fold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from facediff.animation import Animation
from facediff.animation.animation import measured
from facediff.editing.correspondence import LIDS_AT_REST, Correspondence
from facediff.editing.face_features import Features, FrontView
from facediff.editing.lid_transfer import LidEdges, eyeball_depth, eyeball_triangles, lid_edges
from facediff.editing.surface import Surface, triangle_normals
from facediff.utils.numerics import Array, Floats, Integers

BLINKS = 0.5  # An animation whose lids leave more than this share of the opening does not blink
LEFT_OPEN = 0.2  # Share of an eye's opening that may still be seen at a full blink, beyond what the animation leaves
HOLE = 0.2  # Share of the opening's height that may show in one place between shut lids: torn ones meet elsewhere
PASSED = 0.3  # Share of the opening by which the upper lid may pass the lower one
INSIDE, DEEP = 0.15, 0.04  # Share of a lid's vertices that may lie this share of the eye's width inside the eyeball
UNEVEN = 0.25  # How much more of one eye's opening than of the other's may be left
STRETCHED = 0.6  # Edges of the forehead may grow or shrink by this share more than the animation's
FOLDED = 0.02  # Share of the forehead's moving triangles that may turn over
ASYMMETRY = 0.3  # Faces are symmetric to less than this share of an eye's width
BALL_SEEN = 0.3  # Of an eyeball, at least this share of its opening is in view at rest
PIXELS = 96  # across an eye's window
FOREHEAD, BESIDE = 1.6, 0.5
"""The forehead reaches so many widths of an eye up from the eyes, and begins so many away from the lids."""
MOVES = 0.004  # What moves by less than this share of the eye's width is no part of it


@dataclass(frozen=True)
class EyeFigures:
    """Figures of the fullest blink; None where the animation does not blink, or lids stay at rest."""

    stretch: float  # how much the forehead's edges grow or shrink in the worst frame, but for one of 200
    folded: float  # share of the forehead's moving triangles that turn over
    lid_gap: float | None = None  # share of the opening that is still seen, of the worse eye; 0 is best
    # Tallest place where shut lids are open, as a share of the opening's height, of the worse eye; where few triangles
    # are large, a lid tears though most of it is shut
    hole: float | None = None
    overshoot: float | None = None  # how far the upper lid passes the lower one, as a share of the opening
    inside: float | None = None  # share of the lids' vertices that lie inside the eyeball


def check_eyes(
    animation: Animation, carried: Animation, correspondence: Correspondence, frames: Integers
) -> tuple[EyeFigures | None, list[str], list[str]]:
    """Figures of a carried animation's upper face, None where the source shows no eyes; faults, and remarks.

    The forehead is looked at in some frames. Faults and remarks are a clause each.
    """
    source, target = correspondence.features
    if source is None or target is None:
        return None, [], []
    face = Surface(correspondence.source_vertices, correspondence.source_faces)
    source_edges = [edges for eye in (0, 1) if (edges := lid_edges(face.vertices, source, eye)) is not None]
    if len(source_edges) < 2:
        return None, [], []
    faults, remarks, figures = list[str](), list[str](), dict[str, float]()
    blink, left = fullest_blink(animation, source_edges)
    target_edges = [lid_edges(correspondence.laid.vertices, target, eye) for eye in (0, 1)]
    unfound = [side for side, edges in zip(("right", "left"), target_edges, strict=True) if edges is None]
    if left > BLINKS:
        pass
    elif correspondence.lids == LIDS_AT_REST:
        remarks.append("its lids stay at rest")
    elif unfound:
        remarks.append(f"no open {' and '.join(unfound)} eye was found on it, so that its lids stay at rest")
    else:
        figures, faults = _check_lids(animation, carried, correspondence, face, blink)
        if not _mirror_images(target):
            faults.append("its eyes were found in places that are no mirror images, so that one is wrong")
    stretch, folded = _forehead(carried, correspondence.laid, target, source, frames, correspondence)
    source_stretch, source_folded = _forehead(animation, face, source, source, frames, None)
    if stretch > source_stretch + STRETCHED:
        faults.append(f"its forehead is torn: edges grow or shrink by {stretch:.0%}")
    if folded > source_folded + FOLDED:
        faults.append(f"its forehead folds: {folded:.1%} of the moving triangles turn over")
    return EyeFigures(stretch, folded, **figures), faults, remarks


def _check_lids(
    animation: Animation, carried: Animation, correspondence: Correspondence, face: Surface, blink: int
) -> tuple[dict[str, float], list[str]]:
    """Figures and faults of the lids in the frame of the fullest blink."""
    source, target = correspondence.features
    assert source is not None and target is not None  # noqa: S101, PT018 - for type checkers
    rest, faults = Surface(correspondence.laid.vertices, correspondence.target_faces), list[str]()
    posed, original = _laid(correspondence, carried.vertices[blink]), np.asarray(animation.vertices[blink], np.float64)
    seen = [_still_seen(rest, posed, target, eye) for eye in (0, 1)]
    gaps, holes = ([pair[k] for pair in seen] for k in (0, 1))
    # Painted lids of the source may not shut either, which is no fault of the target.
    expected = [_still_seen(face, original, source, eye)[0] for eye in (0, 1)]
    passed = max(_overshoot(lid_edges(rest.vertices, target, eye), rest.vertices, posed) for eye in (0, 1))
    inside = max(_inside_ball(rest, posed, target, eye) for eye in (0, 1))
    worst, torn = int(np.argmax(np.subtract(gaps, expected))), int(np.argmax(holes))
    if gaps[worst] > expected[worst] + LEFT_OPEN:
        faults.append(f"its {('right', 'left')[worst]} eye does not shut: {gaps[worst]:.0%} is left at a full blink")
    elif holes[torn] > HOLE:
        faults.append(
            f"the lids of its {('right', 'left')[torn]} eye tear: a hole of {holes[torn]:.0%} of the opening's "
            f"height is left between them at a full blink"
        )
    if passed > PASSED:
        faults.append(f"its upper lids pass the lower ones by {passed:.0%} of the opening")
    if inside > INSIDE:
        faults.append(f"its lids sink into the eyeballs: {inside:.0%} of their vertices")
    if abs(gaps[0] - gaps[1]) > abs(expected[0] - expected[1]) + UNEVEN:
        faults.append("one of its eyes shuts and the other does not")
    return {"lid_gap": max(gaps), "hole": max(holes), "overshoot": passed, "inside": inside}, faults


def _mirror_images(features: Features) -> bool:
    """Whether both eyes lie as far from the mouth's middle, as high, and are as wide."""
    right, left = features.eyes
    assert right is not None and left is not None  # noqa: S101, PT018 - for type checkers
    width = 0.5 * (right.width + left.width)
    away = right.centre[:2] + left.centre[:2] * [1, -1] - 2 * features.mouth.centre[:2] * [1, 0]
    return bool((np.abs(away) < ASYMMETRY * width).all() and abs(right.width - left.width) < ASYMMETRY * width)


def fullest_blink(animation: Animation, edges: list[LidEdges]) -> tuple[int, float]:
    """The frame in which both eyes are shut furthest, and the share of the opening that is left there."""
    left = np.zeros(len(animation.vertices))
    for one in edges:
        moved = measured(animation.vertices, partial(one.displacements, rest=animation.template))
        gap = (one.gaps[:, 1] + moved[:, 0, :, 1] - moved[:, 1, :, 1]).mean(axis=1) / one.height
        left = np.maximum(left, gap)
    frame = int(left.argmin())
    return frame, float(left[frame])


def raised_brows(animation: Animation, source: Features) -> int | None:
    """The frame in which the skin above the eyes is raised most; None where the face shows no eyes."""
    eyes = [eye for eye in source.eyes if eye is not None]
    if not eyes:
        return None
    points = np.asarray(animation.template, np.float64)
    above = np.zeros(len(points), bool)
    for eye in eyes:
        away = points - eye.centre
        above |= (np.abs(away[:, 0]) < 0.6 * eye.width) & (away[:, 1] > 0.45 * eye.width) & (away[:, 1] < eye.width)
    above &= source.skin
    if not above.any():
        return None
    heights = measured(animation.vertices, lambda vertices: vertices[:, above, 1])
    return int((heights - animation.template[above, 1]).mean(axis=1).argmax())


def _laid(correspondence: Correspondence, vertices: Floats) -> Array:
    return correspondence.similarity.inverse().apply(np.asarray(vertices, np.float64))


def _still_seen(rest: Surface, posed: Array, features: Features, eye: int) -> tuple[float, float]:
    """Share of an eye's opening, as seen from the front, that shows no lid; and of its height at the tallest hole."""
    opening = features.eyes[eye]
    assert opening is not None  # noqa: S101 - for type checkers
    ball = eyeball_triangles(rest, features, eye)
    triangles = np.union1d(ball, np.flatnonzero(features.skin[rest.faces[:, 0]]))
    half = 0.7 * opening.width
    low, step = opening.centre[:2] - half, 2 * half / PIXELS
    x, y = np.meshgrid(low[0] + step * (np.arange(PIXELS) + 0.5), low[1] + step * (np.arange(PIXELS) + 0.5))
    top, bottom = (np.interp(x, side[:, 0], side[:, 1], np.nan, np.nan) for side in (opening.upper, opening.lower))
    # The edges of the lids themselves, which are seen at the border of the opening, are lids.
    margin = 0.2 * (top - bottom)
    inner = (y < top - margin) & (y > bottom + margin)
    if not inner.any():
        return 0.0, 0.0
    pictures = [
        FrontView(points, rest.faces).raster(triangles, low, step, PIXELS, PIXELS)[0]
        for points in (rest.vertices, posed)
    ]
    inside = np.zeros(len(rest.faces) + 1, bool)
    inside[ball] = True
    inside[pictures[0][inner]] = True  # the socket; and -1, nothing, is the last one
    inside[-1] = True
    # What faces away is the inside of a lid, or of the head, that is seen past a torn one.
    inside[:-1] |= triangle_normals(posed, rest.faces)[:, 2] < 0
    share = float(inside[pictures[1][inner]].mean())
    # An eyeball says how much of it is seen wherever the edges of the lids were found.
    before, after = (int(np.isin(picture, ball).sum()) for picture in pictures)
    share = max(share, after / before) if before > BALL_SEEN * inner.sum() else share
    opening_seen = (y < top) & (y > bottom)
    columns = (inside[pictures[1]] & opening_seen).sum(axis=0)
    # A hole is three columns wide at least: corners and single pixels at the edges of triangles are none.
    tallest = np.minimum(np.minimum(columns[:-2], columns[1:-1]), columns[2:]).max()
    return share, float(tallest / opening_seen.sum(axis=0).max())


def _overshoot(edges: LidEdges | None, rest: Array, posed: Array) -> float:
    assert edges is not None  # noqa: S101 - for type checkers
    moved = edges.displacements(posed[None], rest)[0]
    gap = edges.gaps[:, 1] + moved[0, :, 1] - moved[1, :, 1]
    return float(np.maximum(-gap, 0.0).mean() / edges.height)


def _inside_ball(rest: Surface, posed: Array, features: Features, eye: int) -> float:
    """Share of the vertices about the edges of the lids that go into the eyeball, and were not there at rest."""
    opening = features.eyes[eye]
    ball = eyeball_depth(rest, features, eye)
    if ball is None or opening is None:
        return 0.0
    some = np.unique(np.concatenate([opening.upper_seeds, opening.lower_seeds]))
    before, after = (points[some, 2] - ball.at(points[some]) for points in (rest.vertices, posed))
    # A vertex that is not in front of the ball at rest is judged as if it lay on its surface there.
    before = np.where(np.isfinite(before), before, 0.0)
    dives = np.isfinite(after) & (after < np.minimum(before, 0.0) - DEEP * opening.width)
    return float(dives.mean())


def _forehead(
    animation: Animation,
    rest: Surface,
    features: Features,
    source: Features,
    frames: Integers,
    correspondence: Correspondence | None,
) -> tuple[float, float]:
    """How much edges of the forehead grow or shrink, and the share of its moving triangles that turn over."""
    eyes = [eye_here or fallback for eye_here, fallback in zip(features.eyes, source.eyes, strict=True)]
    openings = [eye for eye in eyes if eye is not None]
    width = float(np.mean([eye.width for eye in openings]))
    level = float(np.mean([eye.centre[1] for eye in openings]))
    points = rest.vertices
    # Above the eyes, between and beside them; the lids are looked at by themselves.
    inside = features.skin & (points[:, 1] > level - 0.2 * width) & (points[:, 1] < level + FOREHEAD * width)
    middle = np.mean([eye.centre for eye in openings], axis=0)
    inside &= (np.abs(points[:, 0] - middle[0]) < 2.5 * width) & (points[:, 2] > middle[2] - 1.2 * width)
    for eye in openings:
        edges = np.concatenate([eye.upper, eye.lower])
        near = np.flatnonzero(inside)
        away = np.linalg.norm(points[near][:, None] - edges[None, ::2], axis=2).min(axis=1)
        inside[near[away < BESIDE * eye.width]] = False
    faces = rest.faces[inside[rest.faces].all(axis=1)]
    if not len(faces):
        return 0.0, 0.0
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # Edges that decimation left almost without length say nothing.
    pairs = pairs[lengths > 0.2 * np.median(lengths)]
    lengths = lengths[lengths > 0.2 * np.median(lengths)]
    areas = np.linalg.norm(triangle_normals(points, faces), axis=1)
    faces = faces[areas > 0.1 * np.median(areas)]
    normals = triangle_normals(points, faces)
    stretch, turned, moving = 0.0, np.zeros(len(faces), bool), np.zeros(len(faces), bool)
    for frame in frames:
        posed = np.asarray(animation.vertices[frame], np.float64)
        posed = posed if correspondence is None else _laid(correspondence, posed)
        moves = np.linalg.norm(posed - points, axis=1) > MOVES * width
        some = moves[pairs].any(axis=1)
        if not some.any():
            continue
        posed_lengths = np.linalg.norm(posed[pairs[some, 0]] - posed[pairs[some, 1]], axis=1)
        change = np.abs(np.log(np.maximum(posed_lengths, 1e-12) / lengths[some]))
        # An edge that halves counts as one that doubles. One of 200 is ignored: scans have slivers with noisy
        # lengths.
        stretch = max(stretch, float(np.expm1(np.quantile(change, 0.995))))
        turned |= (triangle_normals(posed, faces) * normals).sum(axis=1) < 0
        moving |= moves[faces].any(axis=1)
    return stretch, float((turned & moving).sum() / max(int(moving.sum()), 1))
