"""Eyelids of one mesh moved like another mesh's: each lid goes the share of its own eye's opening.

Displacements of lids cannot be copied: on an eye that opens further the lids would not meet, on a narrow one they would
pass. The motion of the source's lid edges is therefore read along their curves, expressed in the height and width of
the source's eye, and written along the curves of the target's. The skin around follows its lid, less and less. What
else moves about the eye, such as a brow, is carried as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facediff.editing.controls.eyelids import MEET
from facediff.editing.face_features import LIDS, SAMPLES, Features, FrontView, Opening
from facediff.editing.surface import Surface
from facediff.utils.numerics import Array, Floats, Indices, smooth_step

REACH, SOURCE_REACH = 0.34, 0.5  # How far from a lid's edge the skin follows it, as a share of the eye's width
EVENED = 0.2  # Towards the corners heights vanish: this share of the mean height keeps their ratios defined
SHUT = 0.03  # Lids that are nearer at rest than this share of the eye's width are shut, and have no way to go
CORNER = 0.6  # An eye's corner reaches to where the opening is this share of its height
MORE = 1.5  # No part of an eye is left open by more than so many times what the whole of it is
SHUTS = 0.08  # Source's lids that leave less than this share of their opening shut the target's eye
LAP, ROUGH = 0.03, 0.12
"""Shut, the upper lid goes beyond the lower one by these shares of the opening and of a triangle's edge."""
GRID = 72  # Points of the eyeball's depth across an eye's window
WINDOW = 0.8  # Half of the window's size, in widths of the eye
STILL = 0.004  # Lids that move by less than this share of the eye's width say nothing of the skin around
OVER = 0.012  # A lid stays so far in front of the eyeball, as a share of the eye's width, or as far as it is at rest
RADIUS = 0.42  # of an eyeball, about which a lid turns, in widths of the eye
SWING = -0.5, 1.2  # Radians by which lashes turn with an upper lid that opens further, or shuts
BALL = 0.45, 2.4  # Least and largest height of an eyeball, in widths of the eye


@dataclass(frozen=True, eq=False)
class LidField:
    """The vertices (N,) of one mesh that follow the lids of one eye."""

    vertices: Indices  # (N,)
    along: Array  # (N, 2) place on the upper and on the lower edge, from 0 to SAMPLES - 1
    upper: Array  # (N,) how far the vertex belongs to the upper lid, 0 to 1
    share: Array  # (N,) how far it follows its lid, 0 to 1
    way: Array  # (N, 2) its way to the other lid as a share of that of the edge; less for what lies inside the edge
    axes: Array  # (3, 3) rows: from the smaller to the larger x, from the lower to the upper edge, forwards

    def moved(self, edges: Array) -> Array:
        """Displacements (T, N, 3) that follow the edges', which are along the axes (T, 2, SAMPLES, 3), fully."""
        lids = []
        for side in (0, 1):
            low = np.clip(self.along[:, side].astype(np.int64), 0, SAMPLES - 2)
            part = (self.along[:, side] - low)[:, None]
            lids.append(edges[:, side, low] * (1.0 - part) + edges[:, side, low + 1] * part)
            lids[-1][..., 1] *= self.way[:, side]
        blended = lids[1] + self.upper[:, None] * (lids[0] - lids[1])
        return np.asarray(blended @ self.axes)


@dataclass(frozen=True, eq=False)
class LidEdges:
    """The edges of the lids of one eye of one mesh."""

    opening: Opening
    rims: tuple[Indices, Indices]  # vertices along the upper and the lower edge
    positions: tuple[Array, Array]  # of these along the edges, increasing, from 0 to SAMPLES - 1
    axes: Array  # (3, 3) rows: from the smaller to the larger x, from the lower to the upper edge, forwards
    gaps: Array  # (SAMPLES, 3) from the lower to the upper edge, along the axes
    step: float  # median length of the triangles' edges along the lids

    def displacements(self, vertices: Floats, rest: Floats | float = 0.0) -> Array:
        """Displacements (T, 2, SAMPLES, 3) of the edges, along the axes, from vertices (T, V, 3) and those at rest."""
        sides = []
        for rim, positions in zip(self.rims, self.positions, strict=True):
            low = np.clip(np.searchsorted(positions, np.arange(SAMPLES), "right") - 1, 0, max(len(rim) - 2, 0))
            high = np.minimum(low + 1, len(rim) - 1)
            part = np.clip(
                (np.arange(SAMPLES) - positions[low]) / np.maximum(positions[high] - positions[low], 1e-12), 0, 1
            )
            at = np.asarray(vertices[:, rim], np.float64) - (rest if isinstance(rest, float) else rest[rim])
            sides.append(at[:, low] + part[:, None] * (at[:, high] - at[:, low]))
        return evened(np.stack(sides, axis=1) @ self.axes.T, 1.5, axis=2)

    @property
    def height(self) -> float:
        """Mean distance of the edges at rest."""
        return float(self.gaps[:, 1].mean())


@dataclass(frozen=True, eq=False)
class EyeballDepth:
    """The front of an eyeball as seen from the front: its depth (GRID, GRID), -inf where it is not."""

    low: Array
    step: float
    depth: Array

    def at(self, points: Array) -> Array:
        """Depth (…,) of the eyeball behind or in front of points (…, 3)."""
        pixel = (points[..., :2] - self.low) / self.step - 0.5
        corner = np.clip(np.floor(pixel).astype(int), 0, GRID - 2)
        part = np.clip(pixel - corner, 0.0, 1.0)
        inside = ((pixel >= 0) & (pixel <= GRID - 1)).all(axis=-1)
        column, row = corner[..., 0], corner[..., 1]
        corners = [self.depth[row + i, column + j] for i in (0, 1) for j in (0, 1)]
        x, y = part[..., 0], part[..., 1]
        with np.errstate(invalid="ignore"):
            depth = (1 - y) * ((1 - x) * corners[0] + x * corners[1]) + y * ((1 - x) * corners[2] + x * corners[3])
        return np.where(inside & np.isfinite(depth), depth, -np.inf)


@dataclass(frozen=True, eq=False)
class EyeLids:
    """The lids of one eye of both meshes, in the source's axes and unit."""

    source: LidEdges
    source_field: LidField
    target: LidEdges | None = None  # None where the target's lids rest
    target_field: LidField | None = None
    ball: EyeballDepth | None = None
    clearance: Array | None = None  # (N,) how far in front of the eyeball the vertices of the target's field stay

    def target_edges(self, moves: Array) -> Array:
        """Displacements (T, 2, SAMPLES, 3) of the target's edges, from the source's along its axes."""
        assert self.target is not None  # noqa: S101 - for type checkers
        source_gaps, target_gaps = self.source.gaps, self.target.gaps
        least = EVENED * np.array([self.source.height, self.target.height])
        tall = (target_gaps[:, 1] + least[1]) / (source_gaps[:, 1] + least[0])
        wide = self.target.opening.width / self.source.opening.width
        edges = wide * moves
        # Towards the other lid: the share of the opening that the source's lid goes.
        edges[..., 1] = tall * moves[..., 1]
        # Closing lids meet in depth as well; how far they bulge in front of the straight way is the source's.
        travel = moves[..., 1] / (source_gaps[:, 1] + least[0])
        edges[..., 2] = wide * (moves[..., 2] - travel * source_gaps[:, 2]) + travel * target_gaps[:, 2]
        # The rest of the opening is exactly the source's share, and never less than none: lids do not pass.
        left = source_gaps[:, 1] + moves[:, 0, :, 1] - moves[:, 1, :, 1]
        left = (left + EVENED * left.mean(axis=1, keepdims=True)) / (source_gaps[:, 1] + least[0])
        # In the corners, where there is hardly an opening, the share of the whole eye says more than their own, and
        # nowhere is much more left than there: a rim that is read a little wrong would leave a hole.
        mean_left = np.maximum(left @ source_gaps[:, 1] / source_gaps[:, 1].sum(), 0.0)[:, None]
        open_here = np.clip(source_gaps[:, 1] / (CORNER * source_gaps[:, 1].max()), 0.0, 1.0)
        left = np.minimum(open_here * left + (1.0 - open_here) * mean_left, MORE * mean_left)
        # Edges are read to a few hundredths of the opening: nearly shut is shut.
        left = np.maximum(left - SHUTS, 0.0) / (1.0 - SHUTS)
        # Shut, the upper edge lies a little over the lower one, so that no gap shows between coarse edges.
        lap = (LAP + ROUGH * self.target.step / self.target.height) * target_gaps[:, 1] * np.maximum(1.0 - left, 0.0)
        over = left * target_gaps[:, 1] - lap - (target_gaps[:, 1] + edges[:, 0, :, 1] - edges[:, 1, :, 1])
        edges[:, 0, :, 1] += (1.0 - MEET) * over
        edges[:, 1, :, 1] -= MEET * over
        return edges


def eye_lids(
    source: Surface, laid: Surface, features: tuple[Features, Features], *, at_rest: bool
) -> list[EyeLids] | None:
    """The lids of both eyes of the animation's face and of a mesh that is laid onto it; None if the face's are unknown.

    The mesh's lids stay at rest if it is asked for, and where one of its eyes has no opening.
    """
    source_edges = [lid_edges(source.vertices, features[0], eye) for eye in (0, 1)]
    if source_edges[0] is None or source_edges[1] is None:
        return None
    target_edges = [lid_edges(laid.vertices, features[1], eye) for eye in (0, 1)]
    rest = at_rest or target_edges[0] is None or target_edges[1] is None
    balls = [None, None] if rest else [eyeball_depth(laid, features[1], eye) for eye in (0, 1)]
    lids = []
    for eye, (one, two, ball) in enumerate(zip(source_edges, target_edges, balls, strict=True)):
        assert one is not None  # noqa: S101 - for type checkers
        source_field = _field(source.vertices, features[0], eye, one, SOURCE_REACH)
        if rest or two is None:
            lids.append(EyeLids(one, source_field))
            continue
        field = _field(laid.vertices, features[1], eye, two)
        clearance = None if ball is None else _clearance(laid, field, ball, two.opening.width)
        lids.append(EyeLids(one, source_field, two, field, ball, clearance))
    return lids


def lid_edges(vertices: Array, features: Features, eye: int) -> LidEdges | None:
    """The edges of an eye's lids; None where the mesh has no opening there, or shut lids."""
    opening = features.eyes[eye]
    if opening is None:
        return None
    across = 0.5 * (opening.upper[-1] + opening.lower[-1] - opening.upper[0] - opening.lower[0])
    across /= max(float(np.linalg.norm(across)), 1e-12)
    gaps = opening.upper - opening.lower
    up = gaps.mean(axis=0)
    up[2] = 0.0  # lids are one above the other as seen from the front, however deep the eye lies
    up -= (up @ across) * across
    if np.linalg.norm(up) < SHUT * opening.width:
        return None
    up /= np.linalg.norm(up)
    axes = np.stack([across, up, np.cross(across, up)])
    rims, positions = [], []
    for curve, seeds, code in (
        (opening.upper, opening.upper_seeds, LIDS[eye][0]),
        (opening.lower, opening.lower_seeds, LIDS[eye][1]),
    ):
        lid = seeds[features.codes[seeds] == code]
        lid = lid if len(lid) >= 2 else seeds
        # Seeds are the corners of the triangles along the edge: those that are nearest to it somewhere are the rim.
        away = np.linalg.norm(vertices[lid][None] - curve[:, None], axis=2)
        rim = lid[np.unique(away.argmin(axis=1))]
        position = along(vertices[rim], curve)[0]
        inner = (position > 1.0) & (position < SAMPLES - 2.0)
        # Both lids end in the corners, which belong to neither.
        ends = [np.flatnonzero(features.skin)[_nearest(vertices[features.skin], curve[end])] for end in (0, -1)]
        rim = np.concatenate([[ends[0]], rim[inner], [ends[1]]])
        position = np.concatenate([[0.0], position[inner], [SAMPLES - 1.0]])
        order = np.unique(np.round(position, 3), return_index=True)[1]
        rims.append(rim[order])
        positions.append(position[order])
    if min(len(rim) for rim in rims) < 3:
        return None
    # Edges are seen to a pixel or two, in depth on the front or the back of a lid: both would ripple the skin.
    heights = evened(gaps @ axes.T, 1.0)
    heights[:, [0, 2]] = evened(heights[:, [0, 2]], 4.0)
    step = float(np.median(np.concatenate([np.linalg.norm(np.diff(vertices[rim], axis=0), axis=1) for rim in rims])))
    return LidEdges(
        opening, (rims[0], rims[1]), (positions[0], positions[1]), axes, heights, min(step, opening.width / 4)
    )


def evened(values: Array, samples: float, axis: int = 0) -> Array:
    """Values along an edge, averaged over some samples of it."""
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, samples, axis=axis, mode="nearest"))


def along(points: Array, curve: Array) -> tuple[Array, Array]:
    """SurfacePoints (N,) of points along a curve (K, 3), from 0 to K - 1, and their distances (N,) from it."""
    first, way = curve[:-1], np.diff(curve, axis=0)
    square = np.maximum(np.square(way).sum(axis=1), 1e-24)
    part = np.clip(((points[:, None] - first) * way).sum(axis=2) / square, 0.0, 1.0)
    away = np.linalg.norm(points[:, None] - first - part[..., None] * way, axis=2)
    best = away.argmin(axis=1)
    every = np.arange(len(points))
    return best + part[every, best], away[every, best]


def _nearest(points: Array, to: Array) -> int:
    return int(np.square(points - to).sum(axis=1).argmin())


def _field(vertices: Array, features: Features, eye: int, edges: LidEdges, share_of_width: float = REACH) -> LidField:
    opening = features.eyes[eye]
    assert opening is not None  # noqa: S101 - for type checkers
    reach = share_of_width * opening.width
    edge_points = np.concatenate([opening.upper, opening.lower])
    near = features.skin & (vertices >= edge_points.min(axis=0) - reach).all(axis=1)
    near &= (vertices <= edge_points.max(axis=0) + reach).all(axis=1)
    some = np.flatnonzero(near)
    (above, up), (below, down) = (along(vertices[some], curve) for curve in (opening.upper, opening.lower))
    codes = features.codes[some]
    upper = np.where(codes == LIDS[eye][0], 1.0, np.where(codes == LIDS[eye][1], 0.0, np.nan))
    # Beyond the corners a vertex belongs to both lids, to the nearer one more.
    either = np.square(down) / np.maximum(np.square(up) + np.square(down), 1e-24)
    upper = np.where(np.isnan(upper), either, upper)
    away = np.where(upper == 1.0, up, np.where(upper == 0.0, down, np.minimum(up, down)))
    share = 1.0 - smooth_step(away / reach)
    # The corners of the triangles along an edge carry it, however large the triangles are.
    close = away < 0.3 * opening.width
    top_seeds, bottom_seeds = (np.isin(some, seeds) & close for seeds in (opening.upper_seeds, opening.lower_seeds))
    share[top_seeds | bottom_seeds] = 1.0
    upper[top_seeds & ~bottom_seeds], upper[bottom_seeds & ~top_seeds] = 1.0, 0.0
    height = vertices[some] @ edges.axes[1]
    top, bottom = (
        np.interp(along, np.arange(SAMPLES), curve @ edges.axes[1])
        for along, curve in ((above, opening.upper), (below, opening.lower))
    )
    across = [np.interp(along, np.arange(SAMPLES), edges.gaps[:, 1]) for along in (above, below)]
    least = EVENED * edges.height
    way = np.stack(
        [
            np.clip((height - top + across[0] + least) / (across[0] + least), 0.0, 1.0),
            np.clip((bottom - height + across[1] + least) / (across[1] + least), 0.0, 1.0),
        ],
        axis=1,
    )
    followers = share > 0
    return LidField(
        some[followers],
        np.stack([above, below], 1)[followers],
        upper[followers],
        share[followers],
        way[followers],
        edges.axes,
    )


def eyeball_triangles(laid: Surface, features: Features, eye: int) -> Indices:
    """Numbers of the triangles of the pieces that lie between and behind an eye's lids as an eyeball does."""
    opening = features.eyes[eye]
    if opening is None:
        return np.zeros(0, np.int64)
    width, middle = opening.width, opening.centre
    pieces = FrontView(laid.vertices, laid.faces).pieces
    triangles = FrontView(laid.vertices, laid.faces).within(middle[:2] - 0.5 * width, middle[:2] + 0.5 * width)
    names = np.unique(pieces[laid.faces[triangles, 0]])
    label = pieces[laid.faces[:, 0]]
    ball_triangles = []
    for name in names:
        some = np.flatnonzero(label == name)
        points = laid.vertices[np.unique(laid.faces[some])]
        if features.skin[laid.faces[some[0], 0]]:
            continue
        centre, extent = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.ptp(points, axis=0)
        # Lashes and tear lines are flatter than the front of a ball, teeth and hair lie elsewhere or are larger.
        if (
            BALL[0] * width < extent[1] < BALL[1] * width
            and extent[0] < BALL[1] * width
            and (np.abs(centre - middle)[:2] < 0.5 * width).all()
            and np.median(points[:, 2]) < middle[2] + 0.2 * width
        ):
            ball_triangles.append(some)
    return np.concatenate([np.zeros(0, np.int64), *ball_triangles])


def eyeball_depth(laid: Surface, features: Features, eye: int) -> EyeballDepth | None:
    """The front of an eye's ball; None where there is none, or no opening."""
    triangles, opening = eyeball_triangles(laid, features, eye), features.eyes[eye]
    if opening is None or not len(triangles):
        return None
    half = WINDOW * opening.width
    low, step = opening.centre[:2] - half, 2.0 * half / GRID
    return EyeballDepth(low, step, FrontView(laid.vertices, laid.faces).raster(triangles, low, step, GRID, GRID)[1])


def _clearance(laid: Surface, field: LidField, ball: EyeballDepth, width: float) -> Array:
    points = laid.vertices[field.vertices]
    rest = points[:, 2] - ball.at(points)
    # A flat triangle cuts into a round ball by its edge's square over eight radii.
    edge = np.concatenate([laid.faces[:, [0, 1]], laid.faces[:, [1, 2]], laid.faces[:, [2, 0]]])
    lengths = np.linalg.norm(laid.vertices[edge[:, 0]] - laid.vertices[edge[:, 1]], axis=1)
    count = len(laid.vertices)
    mean = np.bincount(edge[:, 0], lengths, count) / np.maximum(np.bincount(edge[:, 0], None, count), 1)
    sag = np.minimum(np.square(mean[field.vertices]) / (8 * RADIUS * width), 0.1 * width)
    return np.where(np.isfinite(rest), np.minimum(rest, OVER * width + sag), OVER * width + sag)


def without_lids(lids: list[EyeLids], displacements: Array) -> tuple[Array, list[Array]]:
    """Displacements (T, Vs, 3) of a source less what its lids do, and of their edges, along the axes of the eyes."""
    rest, edges = displacements.copy(), []
    for eye in lids:
        moves = eye.source.displacements(displacements)
        edges.append(moves)
        some, lid = eye.source_field.vertices, eye.source_field.moved(moves)
        # How far the skin follows the lid is the animation's own; what goes another way, such as a brow, is not the
        # lid's.
        square = np.square(lid).sum(axis=2) + (STILL * eye.source.opening.width) ** 2
        share = np.clip((displacements[:, some] * lid).sum(axis=2) / square, 0.0, eye.source_field.share)
        rest[:, some] -= share[..., None] * lid
    return rest, edges


def with_lids(lids: list[EyeLids], vertices: Array, displacements: Array, edges: list[Array]) -> None:
    """Add the lids' motion to displacements (T, Vt, 3) of a target's vertices (Vt, 3), both in the source's axes."""
    for eye, moves in zip(lids, edges, strict=True):
        if eye.target_field is None:
            continue
        some = eye.target_field.vertices
        displacements[:, some] += eye.target_field.share[:, None] * eye.target_field.moved(eye.target_edges(moves))
        if eye.ball is not None and eye.clearance is not None:
            # The way of a lid is straight and the eyeball is round: what would dive into it slides over it.
            points = vertices[some] + displacements[:, some]
            into = eye.ball.at(points) + eye.clearance - points[..., 2]
            displacements[:, some, 2] += np.where(np.isfinite(into), np.maximum(into, 0.0), 0.0)


def swing(
    lids: list[EyeLids], vertices: Array, lashes: Indices, roots: Indices, weights: Array, displacements: Array
) -> Array:
    """Displacements (T, A, 3) by which lashes turn about their roots with an upper lid, in the source's axes.

    A lid turns about the eyeball's centre, and what grows from its edge turns with it: lashes that were only shifted
    would stick out of a shut eye. The plate in a lid is stiff, so that all of it turns as its middle does, also near
    the corners, where the edge hardly moves. Lashes (A,) of a target at rest (Vt, 3) grow at roots, weighted places
    between vertices (A, 3) at the edges of the lids; displacements are of the target's vertices (T, Vt, 3).
    """
    turned = np.zeros((len(displacements), len(lashes), 3))
    arms = vertices[lashes] - np.einsum("ak,akd->ad", weights, vertices[roots])
    for eye in lids:
        if eye.target is None or eye.target_field is None:
            continue
        field = eye.target_field
        # Both edges end in the corners, which belong to neither lid.
        upper = np.setdiff1d(field.vertices[field.upper == 1.0], eye.target.rims[1])
        some = np.flatnonzero(np.isin(roots, upper).any(axis=1))
        down = -eye.target.displacements(displacements)[:, 0, SAMPLES // 2, 1]
        angle = np.clip(down / (RADIUS * eye.target.opening.width), *SWING)[:, None]
        _, up, forwards = (arms[some] @ field.axes.T).T
        sine, less = np.sin(angle), np.cos(angle) - 1.0
        turned[:, some] += (up * less - forwards * sine)[..., None] * field.axes[1]
        turned[:, some] += (up * sine + forwards * less)[..., None] * field.axes[2]
    return turned
