"""The openings of a face mesh, found by its shape alone: between the lips, and between the lids of either eye.

Lips that touch at rest are one surface to the eye and two to the mesh. An opening is where two points that are seen
next to each other from the front lie far apart on the surface: across a cut, over a hole, or by way of the inside of
the mouth. The meshes are seen along z, with y up, as animations are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.editing.surface import components, edges_of
from facediff.utils.numerics import Array, Indices

if TYPE_CHECKING:
    from scipy.sparse import csr_array


WELD = 1e-6  # Vertices nearer than this share of the mesh's size are one: seams of textures do not part a mesh
SAMPLES = 33  # points of each side of an opening, from corner to corner

UPPER_LIP, LOWER_LIP, OPPOSITE = 1, 2, (0, 2, 1, 4, 3, 6, 5)
LIDS = (3, 4), (5, 6)
"""Codes of vertices next to an opening: lips 1 and 2, then 3 and 4, 5 and 6 for the lids of either eye; 0 elsewhere.
``OPPOSITE`` is the code on the other side of the same opening."""


@dataclass(frozen=True, eq=False)
class Opening:
    """Both sides of an opening, from the smaller to the larger x."""

    upper: Array  # (SAMPLES, 3)
    lower: Array  # (SAMPLES, 3)
    upper_seeds: Indices  # vertices of the triangles along the upper side
    lower_seeds: Indices

    @property
    def centre(self) -> Array:
        """(3,) between both sides."""
        return np.asarray(0.5 * (self.upper.mean(axis=0) + self.lower.mean(axis=0)))

    @property
    def width(self) -> float:
        """From corner to corner."""
        return float(np.ptp(np.concatenate([self.upper[:, 0], self.lower[:, 0]])))


@dataclass(frozen=True, eq=False)
class Features:
    """Openings and skin of a face mesh."""

    mouth: Opening
    eyes: tuple[Opening | None, Opening | None]  # at smaller and at larger x
    skin: npt.NDArray[np.bool_]  # (V,) the piece that the mouth is in
    codes: Indices  # (V,) which side of which opening a vertex is next to

    @property
    def openings(self) -> list[Opening | None]:
        """The mouth and the eyes, in the order of the codes."""
        return [self.mouth, *self.eyes]

    def lips(self, vertices: Array, count: int) -> Indices:
        """Vertices (count, 2) of the upper and the lower lip along the mouth, without its corners."""
        at = np.linspace(0, SAMPLES - 1, count + 4).round().astype(int)[2:-2]
        sides = []
        for curve, seeds, code in (
            (self.mouth.upper, self.mouth.upper_seeds, UPPER_LIP),
            (self.mouth.lower, self.mouth.lower_seeds, LOWER_LIP),
        ):
            lip = seeds[self.codes[seeds] == code]
            lip = lip if len(lip) else seeds
            sides.append((lip, np.linalg.norm(vertices[lip][None] - curve[at][:, None], axis=2)))
        (upper, above), (lower, below) = sides
        return np.array([facing(vertices, upper, one, lower, two) for one, two in zip(above, below, strict=True)])


CHOICE = 6  # So many of the nearest vertices of each lip may be a pair's


def facing(vertices: Array, upper: Indices, above: Array, lower: Indices, below: Array) -> Indices:
    """Of vertices (N,) and (M,) that lie away (N,) and (M,) from a place, the two that face each other there.

    They are those that are nearest to one another as well: on a coarse mesh the very nearest ones may lie far apart.
    """
    one, two = (np.argsort(away, kind="stable")[:CHOICE] for away in (above, below))
    gaps = np.linalg.norm(vertices[upper[one]][:, None] - vertices[lower[two]][None], axis=2)
    total = gaps + above[one][:, None] + below[two][None]
    row, column = np.unravel_index(total.argmin(), total.shape)
    return np.array([upper[one[row]], lower[two[column]]])


@dataclass(frozen=True)
class SearchWindow:
    """A rectangle in which an opening is searched for, and how wide the opening is expected to be."""

    x: float
    y: float
    half_width: float
    half_height: float
    expected: float


@dataclass(eq=False)
class FrontView:
    """A mesh as it is seen from the front, with y up and z to the viewer."""

    vertices: Array  # (V, 3)
    # (F, 3), those without area too: they join what lies in one place, and without them it would look like a border
    faces: Indices

    @cached_property
    def welded(self) -> Indices:
        """(V,) one number for all vertices in one place that a seam of a texture parts; lips that touch stay apart.

        A seam lies on the border of the mesh, which the inside of lips that touch does not. The border runs in loops: a
        cut, such as that between the closed lips of a mask, is one loop with two halves on one another.
        """
        count = len(self.vertices)
        welded = np.arange(count)
        border = border_edges(self.faces)
        if not len(border):
            return welded
        extent = max(float(np.ptp(self.vertices, axis=0).max()), np.finfo(float).tiny)
        rim = np.unique(border)
        _, first, names = np.unique(
            np.rint(self.vertices[rim] / (WELD * extent)), axis=0, return_index=True, return_inverse=True
        )
        welded[rim] = rim[first[names.reshape(-1)]]
        if (welded == np.arange(count)).all():
            return welded
        loops = components(border, count)[rim]
        for name in np.flatnonzero(np.bincount(loops) >= 6):
            loop = rim[loops == name]
            positions, counts = np.unique(welded[loop], return_counts=True)
            paired = np.count_nonzero(counts == 2)
            span = np.ptp(self.vertices[loop], axis=0)
            # Nearly all of its places occur twice, but for its two ends; and it is short and lies across.
            if paired >= 2 and len(positions) - paired <= 4 and span.max() < 0.4 * extent and span[0] > 2 * span[1]:
                welded[loop] = loop
        return welded

    @cached_property
    def corners(self) -> Indices:
        """(F, 3) triangles of welded vertices."""
        return self.welded[self.faces]

    @cached_property
    def pieces(self) -> Indices:
        """(V,) a label for each vertex, equal for those that triangles join."""
        return components(self.corners[:, [[0, 1], [1, 2]]].reshape(-1, 2), len(self.vertices))[self.welded]

    def graph(self, triangles: Indices) -> tuple[csr_array, Indices]:
        """Lengths of edges between welded vertices of some triangles, and the row (V,) of each vertex; -1 for none."""
        from scipy.sparse import csr_array

        corners = self.corners[triangles]
        vertices, slots = np.unique(corners, return_inverse=True)
        edges = edges_of(slots.reshape(-1, 3))
        lengths = np.linalg.norm(self.vertices[vertices[edges[:, 0]]] - self.vertices[vertices[edges[:, 1]]], axis=1)
        # SciPy's sparse graphs take an explicit zero for a missing edge; welded vertices lie at distance 0.
        lengths = np.maximum(lengths, 1e-12)
        lengths_of_edges = csr_array((lengths, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
        rows = np.full(len(self.vertices), -1)
        rows[vertices] = np.arange(len(vertices))
        return lengths_of_edges, rows[self.welded]

    def raster(
        self, triangles: Indices, low: Array, step: float, columns: int, rows: int
    ) -> tuple[Indices, Array, Array]:
        """The first triangle that each pixel's ray along z meets: its number (R, C), -1 for none, depth and weights."""
        points = self.vertices[self.faces[triangles]]
        flat = (points[:, :, :2] - low) / step
        first = np.clip(np.ceil(flat.min(axis=1) - 0.5).astype(int), 0, [columns, rows])
        last = np.clip(np.floor(flat.max(axis=1) - 0.5).astype(int) + 1, 0, [columns, rows])
        spans = np.maximum(last - first, 0)
        counts = spans[:, 0] * spans[:, 1]
        which = np.repeat(np.arange(len(triangles)), counts)
        inner = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        width = np.maximum(spans[which, 0], 1)
        column, row = first[which, 0] + inner % width, first[which, 1] + inner // width
        a, b, c = (flat[which, k] for k in range(3))
        p = np.stack([column + 0.5, row + 0.5], 1)
        area = _cross(b - a, c - a)
        safe = np.where(np.abs(area) < 1e-12, 1.0, area)
        wb, wc = _cross(p - a, c - a) / safe, _cross(b - a, p - a) / safe
        # The tolerance lets both triangles at an edge claim the pixels on it: no ray slips through between them.
        inside = (np.abs(area) >= 1e-12) & (wb >= -1e-9) & (wc >= -1e-9) & (wb + wc <= 1 + 1e-9)
        which, column, row = which[inside], column[inside], row[inside]
        wb, wc = wb[inside], wc[inside]
        weights = np.stack([1 - wb - wc, wb, wc], 1)
        depth = (weights * points[which, :, 2]).sum(axis=1)
        # Per pixel the nearest triangle comes first, and of equally deep ones the one with the smaller number, so
        # that sheets which lie on one another are seen the same way everywhere.
        order = np.lexsort((which, -depth, row * columns + column))
        pixel = (row * columns + column)[order]
        # np.unique gives the first row of each pixel, which is the best one.
        head = np.unique(pixel, return_index=True)[1]
        best = order[head]
        number: Indices = np.full(rows * columns, -1, np.int64)
        deep: Array = np.full(rows * columns, -np.inf)
        share: Array = np.zeros((rows * columns, 3))
        number[pixel[head]] = triangles[which[best]]
        deep[pixel[head]] = depth[best]
        share[pixel[head]] = weights[best]
        return number.reshape(rows, columns), deep.reshape(rows, columns), share.reshape(rows, columns, 3)

    def within(self, low: Array, high: Array, skin: npt.NDArray[np.bool_] | None = None) -> Indices:
        """Triangles that reach into a rectangle of x and y."""
        flat = self.vertices[self.faces][:, :, :2]
        inside = (flat.max(axis=1) >= low).all(axis=1) & (flat.min(axis=1) <= high).all(axis=1)
        if skin is not None:
            inside &= skin[self.faces[:, 0]]
        return np.flatnonzero(inside)

    def skin_at(self, window: SearchWindow) -> npt.NDArray[np.bool_] | None:
        """(V,) the piece that is the face's skin in a window; None where it shows nothing.

        Of the pieces that a window shows, it is the one that shows most about it: a beard may cover the mouth, but not
        the nose and the eyes.
        """
        counts = [self._shown(window, grown) for grown in (1.0, FACE)]
        if not len(counts[0][0]):
            return None
        candidates = counts[0][0][counts[0][1] > SHOWS * counts[0][1].sum()]
        names, pixels = counts[1]
        is_candidate = np.isin(names, candidates)
        return np.asarray(self.pieces == names[is_candidate][pixels[is_candidate].argmax()])

    def _shown(self, window: SearchWindow, grown: float) -> tuple[Indices, Indices]:
        """Labels of the pieces in a window, which grows mostly upwards, and how many pixels each has."""
        low = np.array([window.x - grown * window.half_width, window.y - window.half_height])
        high = np.array([window.x + grown * window.half_width, window.y + (2 * grown - 1) * window.half_height])
        step = grown * window.half_width / 32
        number, _, _ = self.raster(self.within(low, high), low, step, 64, max(2, int((high - low)[1] / step)))
        visible = number[number >= 0]
        names, counts = np.unique(self.pieces[self.faces[visible, 0]], return_counts=True)
        return names, counts

    def opening(
        self, window: SearchWindow, skin: npt.NDArray[np.bool_], highest: float, behind: float
    ) -> Opening | None:
        """The opening in a window; None if the skin (V,) is whole there.

        Its sides stand no further apart than a share of the expected width, ``highest``, and what lies the share
        ``behind`` behind the surface in front of it is inside.
        """
        from scipy.ndimage import grey_closing

        low = np.array([window.x - window.half_width, window.y - window.half_height])
        high = np.array([window.x + window.half_width, window.y + window.half_height])
        expected = window.expected
        step = expected / PIXELS
        columns, rows = int(2 * window.half_width / step), int(2 * window.half_height / step)
        triangles = self.within(low, high, skin)
        if not len(triangles):
            return None
        number, depth, weights = self.raster(triangles, low, step, columns, rows)
        number, depth, weights = number[::-1], depth[::-1], weights[::-1]  # from the top down
        # An odd height keeps the closing centred on its pixel.
        tall = max(3, int(highest * expected / step) | 1)
        # The inside of an open mouth lies behind the surface that spans the lips.
        finite = np.where(number >= 0, depth, depth[number >= 0].min() if (number >= 0).any() else 0.0)
        front = grey_closing(finite, size=(tall + 2, 1))
        valid = (number >= 0) & (finite > front - behind * expected)
        pairs = _following(valid, tall)
        if not len(pairs):
            return None
        above, below = number[pairs[:, 0], pairs[:, 2]], number[pairs[:, 1], pairs[:, 2]]
        a, b = self.corners[above], self.corners[below]
        # Triangles with a common corner are joined, however far apart their pixels are. This cheap test spares most
        # of the searches along the surface below.
        apart = ~(a[:, :, None] == b[:, None, :]).any(axis=(1, 2))
        pairs, above, below, a, b = (part[apart] for part in (pairs, above, below, a, b))
        if not len(pairs):
            return None
        first, second = (self._points(number, weights, pairs[:, [k, 2]]) for k in (0, 1))
        straight = np.linalg.norm(first - second, axis=1)
        margin = 0.6 * expected
        graph, rows_of = self.graph(self.within(low - margin, high + margin, skin))
        # On whole skin the way along the surface is hardly longer than the straight line; across an opening it leads
        # round one of the corners. The share of the width keeps bumps from counting as openings.
        limit = FARTHER * straight + PARTED * expected
        parted = self._ways_between(graph, rows_of, (first, second), (a, b), limit) > limit
        # Points seen through a hole lie behind its rims, and the way round the hole may be short.
        parted |= pairs[:, 1] - pairs[:, 0] > max(2, HOLE * PIXELS)
        pairs, above, below, first, second = (part[parted] for part in (pairs, above, below, first, second))
        selection = _widest(pairs, window, step, low)
        if selection is None:
            return None
        return self._opening(pairs[selection], first[selection], second[selection], above[selection], below[selection])

    def _points(self, number: Indices, weights: Array, at: Indices) -> Array:
        corners = self.vertices[self.faces[number[at[:, 0], at[:, 1]]]]
        return np.asarray(np.einsum("nk,nkd->nd", weights[at[:, 0], at[:, 1]], corners))

    def _ways_between(
        self,
        graph: csr_array,
        rows_of: Indices,
        points: tuple[Array, Array],
        corners: tuple[Indices, Indices],
        limit: Array,
    ) -> Array:
        """Lengths (N,) of the ways from points by the corners of their triangles to other points, up to a limit."""
        from scipy.sparse.csgraph import dijkstra

        offsets = [
            np.linalg.norm(self.vertices[some] - point[:, None], axis=2)
            for point, some in zip(points, corners, strict=True)
        ]
        starts, row = np.unique(rows_of[corners[0]], return_inverse=True)
        row = row.reshape(-1, 3)
        shortest = np.full(len(limit), np.inf)
        # In batches: all starts at a time would need a distance for every pair of a start and a vertex.
        for begin in range(0, len(starts), 256):
            inside = (row >= begin) & (row < begin + 256)
            some = np.flatnonzero(inside.any(axis=1))
            ways = dijkstra(graph, directed=False, indices=starts[begin : begin + 256], limit=float(limit[some].max()))
            for i in range(3):
                members = some[inside[some, i]]
                between = ways[(row[members, i] - begin)[:, None], rows_of[corners[1][members]]]
                shortest[members] = np.minimum(
                    shortest[members], offsets[0][members, i] + (between + offsets[1][members]).min(axis=1)
                )
        return shortest

    def _opening(self, pairs: Indices, first: Array, second: Array, above: Indices, below: Indices) -> Opening | None:
        """Both sides as curves: per column the highest upper and the lowest lower point, smoothed and resampled."""
        names = np.unique(pairs[:, 2])
        upper = np.stack([first[pairs[:, 2] == name][pairs[pairs[:, 2] == name, 0].argmin()] for name in names])
        lower = np.stack([second[pairs[:, 2] == name][pairs[pairs[:, 2] == name, 1].argmax()] for name in names])
        # The median filter that smooths a side spans five samples.
        if len(names) < 5:
            return None
        sides = [_resampled(_smoothed(side)) for side in (upper, lower)]
        return Opening(sides[0], sides[1], np.unique(self.faces[above]), np.unique(self.faces[below]))

    def _ways(self, opening: Opening, limit: float) -> tuple[Array, Array]:
        """Lengths (V,) of the ways along the surface to the upper and to the lower side; infinite beyond a limit."""
        from scipy.spatial import cKDTree

        margin = limit + opening.width
        middle = opening.centre[:2]
        graph, rows_of = self.graph(self.within(middle - margin, middle + margin))
        ways = []
        for side, seeds in ((opening.upper, opening.upper_seeds), (opening.lower, opening.lower_seeds)):
            way = _ways_from(graph, rows_of[seeds], cKDTree(side).query(self.vertices[seeds])[0], limit)
            ways.append(np.where(rows_of >= 0, way[np.maximum(rows_of, 0)], np.inf))
        return ways[0], ways[1]

    def completed(self, opening: Opening, expected: float) -> Opening:
        """The same with its corners: where the ways to both sides, which grow beyond the ends, become equal."""
        limit = 0.6 * max(opening.width, expected)
        worst = np.maximum(*self._ways(opening, limit))
        ends = [np.array([], float).reshape(0, 3)] * 2
        for k, (sign, end) in enumerate(((-1, 0), (1, -1))):
            tips = np.stack([opening.upper[end], opening.lower[end]])
            outside = sign * (self.vertices[:, 0] - (sign * tips[:, 0]).max() * sign) > 0
            outside &= np.isfinite(worst)
            if outside.any():
                # The inside of a corner is as far from both sides; the corner itself is what lies in front.
                distances = np.where(outside, worst + 0.5 * np.abs(self.vertices[:, 2] - tips[:, 2].mean()), np.inf)
                ends[k] = self.vertices[[distances.argmin()]]
        upper, lower = (_resampled(np.concatenate([ends[0], side, ends[1]])) for side in (opening.upper, opening.lower))
        return Opening(upper, lower, opening.upper_seeds, opening.lower_seeds)

    def codes(self, openings: list[Opening | None], reach: tuple[float, ...]) -> Indices:
        """(V,) on which side of which opening each vertex lies that is near to one along the surface."""
        codes = np.zeros(len(self.vertices), np.int64)
        least = np.full(len(self.vertices), np.inf)
        for index, (opening, share) in enumerate(zip(openings, reach, strict=True)):
            if opening is None:
                continue
            limit = share * opening.width
            up, down = self._ways(opening, 1.5 * limit)
            nearest = np.minimum(up, down)
            with np.errstate(invalid="ignore"):
                # Beyond the corners, and at the back of the mouth, both are about equally far.
                sure = ~(np.abs(up - down) <= UNSURE[0] * opening.width + UNSURE[1] * nearest)
            members = (nearest < limit) & (nearest < least) & sure
            codes[members] = np.where(up[members] < down[members], 1, 2) + 2 * index
            least[members] = nearest[members]
        return codes


FACE = 2.0  # The skin about a mouth is looked at in a window that is so many times as wide, and reaches up to the eyes
SHOWS = 0.05  # Share of a window that the skin shows at least; a beard may cover the rest
PIXELS = 48  # to the expected width of an opening
FARTHER, PARTED = 2.5, 0.12
"""Points are parted if the way between them is longer than so many times the distance and this share of the width."""
UNSURE = 0.03, 0.35
"""Ways to both sides that differ by less than this share of the width and of the shorter way tell no side."""
HOLE = 0.1  # Inside that is seen over this share of the width makes an opening


def border_edges(faces: Indices) -> Indices:
    """Edges (E, 2) of one triangle only."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    names, counts = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(names[counts == 1])


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _following(valid: npt.NDArray[np.bool_], tall: int) -> Indices:
    """Pairs (row, next row, column) of valid pixels that follow one another in a column, at most ``tall`` apart."""
    rows, columns = np.nonzero(valid.T)[::-1]
    same = (columns[1:] == columns[:-1]) & (rows[1:] - rows[:-1] <= tall)
    return np.stack([rows[:-1][same], rows[1:][same], columns[1:][same]], axis=1)


def _widest(pairs: Indices, window: SearchWindow, step: float, low: Array) -> Indices | None:
    """Which pairs are the opening: the chain of neighbouring ones that is widest and nearest to the middle."""
    from scipy.spatial import cKDTree

    if not len(pairs):
        return None
    middle = 0.5 * (pairs[:, 0] + pairs[:, 1])
    tree = cKDTree(np.stack([pairs[:, 2] * 1.0, 0.75 * middle], 1))
    # Pixels that lie a few columns or rows apart are one chain: teeth interrupt an opening, and it is steep at its
    # corners.
    labels = components(tree.query_pairs(4.5, output_type="ndarray"), len(pairs))
    best, best_worth = None, 0.0
    for name in np.unique(labels):
        some = np.flatnonzero(labels == name)
        wide = len(np.unique(pairs[some, 2])) * step / window.expected
        if wide < LEAST:
            continue
        centre = low[0] + step * pairs[some, 2].mean()
        # Width counts up to 1.3 of the expected one, so that a wide gap elsewhere does not beat the mouth in the
        # middle.
        worth = min(wide, 1.3) - 1.0 * abs(centre - window.x) / window.expected
        if worth > best_worth:
            best, best_worth = some, worth
    return best


LEAST = 0.3  # An opening is at least this share of its expected width


def _smoothed(points: Array) -> Array:
    from scipy.ndimage import gaussian_filter1d, median_filter

    # The median drops single columns that saw a tooth or the far cheek; the Gaussian evens out the pixels' steps.
    steady = median_filter(points, size=(5, 1), mode="nearest")
    return np.asarray(gaussian_filter1d(steady, 1.0, axis=0, mode="nearest"))


def _resampled(points: Array) -> Array:
    along = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-12))])
    at = np.linspace(0, along[-1], SAMPLES)
    return np.stack([np.interp(at, along, points[:, k]) for k in range(3)], 1)


def _ways_from(graph: csr_array, starts: Indices, offsets: Array, limit: float) -> Array:
    """Lengths (N,) of the shortest ways from any start, each of which begins with an offset."""
    from scipy.sparse import csr_array, hstack, vstack
    from scipy.sparse.csgraph import dijkstra

    # One more vertex, joined to every start by an edge as long as its offset, makes one search of many.
    count = graph.shape[0]
    least = np.full(count, np.inf)
    np.minimum.at(least, starts, np.maximum(offsets, 1e-12))
    names = np.flatnonzero(np.isfinite(least))
    row = csr_array((least[names], (np.zeros(len(names), np.int64), names)), shape=(1, count))
    extended = vstack([hstack([graph, csr_array((count, 1))]), hstack([row, csr_array((1, 1))])]).tocsr()
    return np.asarray(dijkstra(extended, directed=False, indices=count, limit=limit)[:count])


MOUTH_REACH, EYE_REACH = 0.8, 0.5
"""How far from an opening its sides are told apart, as a share of its width."""
ASIDE = 0.3, 0.7
"""An opening further away from where the mouth is expected, across and up in its widths, is an eye or a nostril."""
OPEN_MOUTH, OPEN_EYE = (0.35, 0.12), (0.7, 0.35)
"""How far apart the sides of an opening may stand at rest, and how far behind them its inside begins, as shares of its
width. A socket is a hollow: the inside of an eye lies deeper than that."""


def find_features(vertices: Array, faces: Indices, expected: Features | Opening | None = None) -> Features | None:
    """The openings of a face (V, 3), (F, 3), y up and z to the viewer; None if it has no mouth that can open.

    They are searched for where another face has its features, or its mouth, and everywhere without one.
    """
    view = FrontView(vertices, faces)
    expected_mouth = expected.mouth if isinstance(expected, Features) else expected
    if expected_mouth is None:
        expected_mouth = _anywhere(view)
        if expected_mouth is None:
            return None
    width = expected_mouth.width
    x, y, _ = expected_mouth.centre
    skin, mouth = None, None
    # The larger window finds a mouth that a rough alignment has put aside; it comes second, since it also shows
    # nostrils.
    for grown in (1.0, 1.6):
        window = SearchWindow(x, y, 1.1 * width * grown, 0.55 * width * grown, width)
        skin = view.skin_at(window)
        mouth = None if skin is None else view.opening(window, skin, *OPEN_MOUTH)
        if mouth is not None:
            break
    if mouth is None or skin is None:
        return None
    mouth = view.completed(mouth, width)
    if isinstance(expected, Features) and (np.abs(mouth.centre - expected_mouth.centre)[:2] / width > ASIDE).any():
        return None
    width = mouth.width
    x, y, _ = mouth.centre
    eyes: list[Opening | None] = []
    for side in (0, 1):
        windows = []
        if not isinstance(expected, Features):
            # Proportions of an average face in widths of its mouth; the window leaves room for others.
            sign = 2 * side - 1
            windows = [SearchWindow(x + 0.62 * sign * width, y + 1.4 * width, 0.5 * width, 0.6 * width, 0.55 * width)]
        elif (known := expected.eyes[side]) is not None:
            # A longer or shorter face has its eyes elsewhere: the larger window comes second, as for the mouth.
            middle, wide = known.centre[:2], known.width
            windows = [
                SearchWindow(middle[0], middle[1], 0.85 * grown * wide, 0.75 * grown * wide, wide)
                for grown in (1.0, 1.6)
            ]
        eye = next((eye for window in windows if (eye := view.opening(window, skin, *OPEN_EYE)) is not None), None)
        eyes.append(None if eye is None else view.completed(eye, windows[0].expected))
    codes = view.codes([mouth, *eyes], (MOUTH_REACH, EYE_REACH, EYE_REACH))
    return Features(mouth, (eyes[0], eyes[1]), skin, codes)


def _anywhere(view: FrontView) -> Opening | None:
    """The widest opening about the middle of the lower part of the view."""
    points = view.vertices[np.unique(view.faces)]
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    window = SearchWindow(middle[0], middle[1], half[0], half[1], 0.3 * float(min(2 * half[0], 2 * half[1])))
    skin = view.skin_at(window)
    mouth = None if skin is None else view.opening(window, skin, *OPEN_MOUTH)
    return None if mouth is None else view.completed(mouth, window.expected)


def sides_of_pairs(vertices: Array, faces: Indices, pairs: Indices) -> Array:
    """(V,) on which side of a mouth vertices lie, given pairs (P, 2) of its lips: 1 first, -1 second, 0 neither.

    The lips may touch; what counts is the way along the surface.
    """
    view = FrontView(vertices, faces)
    points = vertices[pairs.ravel(), :2]
    margin = float(np.ptp(points, axis=0).max())
    graph, rows = view.graph(view.within(points.min(axis=0) - margin, points.max(axis=0) + margin))
    ways = []
    for column in (0, 1):
        starts = rows[pairs[:, column]]
        starts = starts[starts >= 0]
        if not len(starts):
            return np.zeros(len(vertices))
        way = _ways_from(graph, starts, np.zeros(len(starts)), 3 * margin)
        ways.append(np.where(rows >= 0, way[np.maximum(rows, 0)], np.inf))
    return np.where(ways[0] < ways[1], 1.0, np.where(ways[1] < ways[0], -1.0, 0.0))
