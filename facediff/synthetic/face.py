"""The puppet's neutral head: skin, lips with a mouth behind them, teeth, eyes and ears, all made by code.

Lengths are in millimetres while the head is built and in metres in what `build_face` returns; x points to
the face's left, y up, z to the viewer.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Smooth curves through a few values: the only interpolation that the puppet's parts need.

Array = NDArray[np.float64]


def through(knots: ArrayLike, values: ArrayLike, at: ArrayLike) -> Array:
    """Interpolate with cubic Hermite pieces whose slopes never overshoot (Fritsch and Carlson, 1980).

    Args:
        knots: Rising places of the values, shape (n,).
        values: Values there, shape (n,).
        at: Where to look, any shape; outside the knots the end values hold.

    Returns:
        Values with a continuous first derivative, the shape of ``at``.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    places = np.clip(np.asarray(at, dtype=np.float64), x[0], x[-1])
    step = np.diff(x)
    slope = np.diff(y) / step
    tangent = np.zeros_like(y)
    before, after = slope[:-1], slope[1:]
    weight_before, weight_after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    same_way = before * after > 0
    safe_before, safe_after = np.where(same_way, before, 1.0), np.where(same_way, after, 1.0)
    harmonic = (weight_before + weight_after) / (weight_before / safe_before + weight_after / safe_after)
    tangent[1:-1] = np.where(same_way, harmonic, 0.0)
    tangent[0], tangent[-1] = slope[0], slope[-1]
    piece = np.clip(np.searchsorted(x, places, side="right") - 1, 0, x.size - 2)
    t = (places - x[piece]) / step[piece]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * y[piece]
        + t * (1 - t) ** 2 * step[piece] * tangent[piece]
        + t**2 * (3 - 2 * t) * y[piece + 1]
        + t**2 * (t - 1) * step[piece] * tangent[piece + 1]
    )


def rise(values: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Go from 0 at ``low`` to 1 at ``high`` with flat ends (smoothstep); ``low`` may lie above ``high``."""
    start, end = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    t = np.clip((np.asarray(values, dtype=np.float64) - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def bump(x: ArrayLike, y: ArrayLike, centre: tuple[float, float], width: tuple[float, float]) -> Array:
    """Gaussian hill of height 1 over the plane, with standard deviations ``width`` along x and y."""
    across = (np.asarray(x, dtype=np.float64) - centre[0]) / width[0]
    along = (np.asarray(y, dtype=np.float64) - centre[1]) / width[1]
    return np.asarray(np.exp(-0.5 * (across**2 + along**2)))


# Delaunay triangulation of points in the plane, exact and so the same on every machine.

# Coordinates are rounded to this fraction of a millimetre and the tests are done in whole numbers: with a
# domain of less than 2**14 such steps every determinant fits into 64 bits, so no rounding can flip an edge.
_STEPS_PER_MM = 25
_LARGEST = 2**14


def delaunay(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangulate points by inserting them one by one (Bowyer and Watson, 1981).

    Args:
        points: Coordinates in mm, shape (n, 2), all different.

    Returns:
        Triangles as indices of points, counter-clockwise, shape (m, 3); together they fill the points' convex
        hull up to slivers along it.

    Raises:
        ValueError: If the points spread over more than the exact arithmetic can hold.
    """
    whole = np.rint((points - points.min(axis=0)) * _STEPS_PER_MM).astype(np.int64)
    extent = int(whole.max())
    if extent > _LARGEST // 2:
        raise ValueError(f"points spread over {extent} steps, more than {_LARGEST // 2}")
    margin = extent // 4
    low, high = -margin, extent + margin
    corners = np.array([[low, low], [high, low], [high, high], [low, high]], dtype=np.int64)
    count = len(points)
    places = np.concatenate([whole, corners])
    triangles = np.array([[count, count + 1, count + 2], [count, count + 2, count + 3]])
    for index in range(count):
        triangles = _insert(places, triangles, index)
    return triangles[(triangles < count).all(axis=1)]


def _insert(places: NDArray[np.int64], triangles: NDArray[np.int64], index: int) -> NDArray[np.int64]:
    """Remove the triangles whose circumcircle holds the point and fan their outline round it."""
    corner = places[triangles] - places[index]
    square = (corner**2).sum(axis=2)
    (ax, ay), (bx, by), (cx, cy) = (corner[:, k].T for k in range(3))
    determinant = (
        square[:, 0] * (bx * cy - cx * by) - square[:, 1] * (ax * cy - cx * ay) + square[:, 2] * (ax * by - bx * ay)
    )
    inside = determinant > 0
    hole = triangles[inside]
    edges = np.concatenate([hole[:, [0, 1]], hole[:, [1, 2]], hole[:, [2, 0]]])
    there = {(int(a), int(b)) for a, b in edges}
    outline = [(int(a), int(b)) for a, b in edges if (int(b), int(a)) not in there]
    fan = np.array([(a, b, index) for a, b in outline], dtype=np.int64).reshape(-1, 3)
    first, second = places[fan[:, 1]] - places[fan[:, 0]], places[fan[:, 2]] - places[fan[:, 0]]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.concatenate([triangles[~inside], fan[area > 0]])


# Assembling one half of a symmetric mesh and mirroring it.

Faces = NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with named vertices.

    Attributes:
        vertices: Positions, shape (V, 3).
        faces: Vertex indices, counter-clockwise seen from outside, shape (F, 3).
        colours: Red, green, blue of every vertex in 0..255, shape (V, 3), uint8.
        mirror: Index of the vertex on the other side, shape (V,); its own on the midline.
        groups: Named lists of vertices of the left half (x >= 0), in the order in which they were made.
    """

    vertices: Array
    faces: Faces
    colours: NDArray[np.uint8]
    mirror: NDArray[np.int64]
    groups: dict[str, NDArray[np.int64]]

    def both(self, *names: str) -> NDArray[np.int64]:
        """Sorted vertices of the named groups on both sides."""
        left = np.concatenate([self.groups[name] for name in names])
        return np.unique(np.concatenate([left, self.mirror[left]]))


@dataclass
class HalfMesh:
    """Left half of a mesh (x >= 0) under construction; points with x = 0 are shared by both halves."""

    points: list[Array] = field(default_factory=list)
    colours: list[Array] = field(default_factory=list)
    faces: list[Faces] = field(default_factory=list)
    groups: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    count: int = 0

    def add(self, name: str, points: Array, colour: tuple[int, int, int]) -> NDArray[np.int64]:
        """Add points of one colour under a name and return their indices."""
        index = np.arange(self.count, self.count + len(points))
        self.points.append(np.asarray(points, dtype=np.float64))
        self.colours.append(np.tile(np.array(colour, dtype=np.float64), (len(points), 1)))
        self.groups[name] = index
        self.count += len(points)
        return index

    def strip(self, outer: NDArray[np.int64], inner: NDArray[np.int64], closed: bool = False) -> None:
        """Join two rows of equal length; ``outer`` runs clockwise round ``inner`` seen from outside."""
        a, b = outer, inner
        if closed:
            a, b = np.append(a, a[0]), np.append(b, b[0])
        self.faces.append(np.stack([a[:-1], b[:-1], b[1:]], axis=1))
        self.faces.append(np.stack([a[:-1], b[1:], a[1:]], axis=1))

    def fan(self, ring: NDArray[np.int64], centre: int) -> None:
        """Join a closed clockwise ring to a point."""
        self.faces.append(np.stack([ring, np.full_like(ring, centre), np.roll(ring, -1)], axis=1))

    def mirrored(self) -> Mesh:
        """Both halves as one mesh: the left half's points, then the mirror images of all off the midline."""
        points, colours = np.concatenate(self.points), np.concatenate(self.colours)
        faces = np.concatenate(self.faces)
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        off = np.flatnonzero(points[:, 0] != 0.0)
        mirror = np.arange(self.count)
        mirror[off] = self.count + np.arange(len(off))
        other = mirror[faces][:, ::-1]
        double = np.concatenate([points, points[off] * np.array([-1.0, 1.0, 1.0])])
        return Mesh(
            vertices=double,
            faces=np.concatenate([faces, other]),
            colours=np.clip(np.rint(np.concatenate([colours, colours[off]])), 0, 255).astype(np.uint8),
            mirror=np.concatenate([mirror, off]),
            groups=dict(self.groups),
        )


# The skin of the head as a function of two parameters, in millimetres.
#
# The head is a stack of closed horizontal curves: ``theta`` runs round the head from the front midline (0) to
# the back (pi), ``level`` climbs from the neck to the crown and equals the height y in the face. The tables
# below give each curve's extent; the face is modelled on top by smooth hills and hollows of `_relief`.
# Only the left half (x >= 0) is described; the other half is its mirror image.

EYE_CENTRE = (31.0, 25.5, 63.0)
LID_RADIUS = 15.0
MOUTH_Y = -48.0
LOWEST_LEVEL, HIGHEST_LEVEL = -150.0, 150.0

# level, height y, front z, z of the widest place, half width, back z, how much the curve climbs to the sides
_CURVES = np.array(
    [
        [-150, -150, 27, -22, 50, -80, 0],
        [-128, -130, 29, -20, 46, -76, 4],
        [-113, -112, 35, -14, 45.5, -76, 16],
        [-101, -101, 58, -2, 49.5, -77, 30],
        [-91, -92, 78, 3, 57, -79, 40],
        [-79, -79, 87, 4, 61.5, -82, 40],
        [-66, -66, 88, 4, 65, -85, 33],
        [-48, -48, 91, 3, 68, -90, 21],
        [-24, -24, 92, 2, 71, -95, 9],
        [0, 0, 90, 0, 73.5, -99, 2],
        [25, 25, 87.5, -2, 75, -102, 0],
        [45, 45, 92, -4, 75.5, -103, 0],
        [70, 70, 91, -5, 74, -100, 0],
        [98, 97, 79, -6, 66, -89, 0],
        [120, 115.5, 60, -6, 53, -70, 0],
        [142, 128, 37, -6, 36, -47, 0],
        [156, 133.5, 20, -6, 21, -31, 0],
    ],
    dtype=np.float64,
)
CROWN = (0.0, 135.5, -6.0)


def _curve(level: ArrayLike, column: int) -> Array:
    return through(_CURVES[:, 0], _CURVES[:, column], level)


def radius(level: ArrayLike) -> Array:
    """Length in mm that the layout gives to a radian at a level.

    Half way (as a geometric mean) between the true radius and a constant one: the true one would shear the
    back of the crown and the nape, where it changes fast, a constant one would blow up the crown.
    """
    true = 0.5 * _curve(level, 4) + 0.25 * (_curve(level, 2) - _curve(level, 5))
    return np.asarray(np.sqrt(82.0 * true))


def _climb(theta: ArrayLike) -> Array:
    return rise(theta, 0.3, 1.4)


def locate(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Find the parameters of a place on the front of the head.

    Args:
        x: Distance from the midline, in mm, less than the head's half width.
        y: Height, in mm.

    Returns:
        ``theta`` and ``level`` of the skin in front of (x, y), before the relief.
    """
    across, height = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    level = height.copy()
    theta = np.zeros_like(across)
    for _ in range(30):
        theta = np.arcsin(np.clip(across / _curve(level, 4), 0.0, 1.0))
        level = level + 0.7 * (height - _curve(level, 1) - _curve(level, 6) * _climb(theta))
    return theta, level


def skin(theta: ArrayLike, level: ArrayLike) -> Array:
    """Place points on the skin.

    Args:
        theta: Angle round the head, 0 (front) to pi (back), shape (n,).
        level: Level, shape (n,).

    Returns:
        Positions in mm, shape (n, 3).
    """
    angle = np.asarray(theta, dtype=np.float64)
    front, widest, back = _curve(level, 2), _curve(level, 3), _curve(level, 5)
    cosine = np.cos(angle)
    x = _curve(level, 4) * np.sin(angle)
    y = _curve(level, 1) + _curve(level, 6) * _climb(angle)
    z = widest + np.where(cosine > 0, front - widest, widest - back) * cosine
    facing = rise(cosine, 0.0, 0.45)
    z = z + facing * _relief(x, y)
    z = _over_eyeball(x, y, z, facing)
    y = y - 2.5 * facing * bump(x, y, (0.0, -13.0), (9.0, 6.0))
    return np.stack([x, y, z], axis=-1)


def _relief(x: Array, y: Array) -> Array:
    """How far the face stands out of the plain head, in mm."""
    z = -6.0 * bump(x, y, (32, 24), (13, 9))
    z += -8.0 * bump(x, y, (18, 24), (6.5, 10))
    z += 2.5 * bump(x, y, (17, 42), (11, 5)) + 2.5 * bump(x, y, (38, 43), (11, 5))
    z += 4.0 * bump(x, y, (44, -3), (13, 11)) - 3.0 * bump(x, y, (52, -42), (12, 16))
    z += -2.5 * bump(x, y, (66, 55), (10, 16)) + 1.5 * bump(x, y, (24, 76), (18, 14))
    z += 3.5 * bump(x, y, (0, -44), (24, 15)) - 3.4 * bump(x, y, (0, -67), (16, 6.0))
    z += 6.0 * bump(x, y, (0, -82), (13, 9)) - 1.0 * bump(x, y, (0, -32), (2.6, 5))
    return z + _nose(x, y) + _smile_fold(x, y)


def _nose(x: Array, y: Array) -> Array:
    """Ridge, tip and wings of the nose, with a hollow for the nostril."""
    height = through(
        [-29, -25, -22, -18, -13.5, -9, 0, 12, 22, 30, 40],
        [0, 1.5, 5.0, 12.0, 18.5, 20.5, 17.5, 12.0, 7.0, 3.5, 0],
        y,
    )
    width = through([-25, -10, 0, 12, 26, 40], [7.5, 7.5, 6.3, 5.8, 5.5, 8], y)
    ridge = height * np.exp(-0.5 * np.abs(x / width) ** 2.2)
    wing = 8.5 * bump(x, y, (14.5, -15.5), (4.2, 5.2))
    nostril = -2.5 * bump(x, y, (7.0, -20.5), (2.6, 2.2))
    return ridge + wing + nostril


def _smile_fold(x: Array, y: Array) -> Array:
    """Slight fold from the wing of the nose to beside the mouth."""
    along = np.clip((-14.0 - y) / 34.0, 0.0, 1.0)
    beside = x - (20.0 + 13.0 * along)
    fade = rise(y, -58.0, -40.0) * rise(y, -8.0, -20.0)
    return fade * (1.6 * np.exp(-0.5 * ((beside - 6.0) / 5.0) ** 2) - 1.4 * np.exp(-0.5 * (beside / 3.0) ** 2))


def _over_eyeball(x: Array, y: Array, z: Array, facing: Array) -> Array:
    """Lay the lids over the eyeball: a smooth maximum of the skin and a ball."""
    room = LID_RADIUS**2 - (x - EYE_CENTRE[0]) ** 2 - (y - EYE_CENTRE[1]) ** 2
    ball = EYE_CENTRE[2] + np.sqrt(np.maximum(room, 1e-6))
    softness = 1.5
    gap = np.clip((ball - z) / softness, -30.0, 30.0)
    over = z + softness * np.log1p(np.exp(gap))
    blend = facing * rise(room, -40.0, 30.0)
    return np.asarray(z + blend * (over - z))


# Different people: smooth deformations of space that turn the neutral head into a speaker's.
#
# A `Shape` is a function of points, not a table of vertices. A pose of the neutral head can be sent through
# it as well as the neutral head itself, and that is how the rig comes to act in the speaker's own proportions.


@dataclass(frozen=True)
class Shape:
    """How a head differs from the neutral one; every number is about -1 to 1, and 0 changes nothing.

    Attributes:
        width: Whole head wider.
        length: Lower face longer.
        depth: Back of the head fuller.
        jaw: Jaw wider at its angle.
        chin_width: Chin broader and squarer.
        chin: Chin longer and further forward.
        neck: Neck thicker.
        nose_length: Nose longer downwards.
        nose_width: Nose broader at its wings.
        nose_bridge: Bridge higher.
        nose_tip: Tip further forward.
        nose_up: Tip turned up.
        eye_size: Eyes larger.
        eye_gap: Eyes further apart.
        eye_tilt: Outer corners higher.
        brow_height: Brows higher.
        brow_ridge: Ridge above the eyes stronger.
        brow_tilt: Outer ends of the brows higher.
        lips: Lips fuller.
        mouth_width: Mouth wider.
        mouth_forward: Mouth further forward.
        cheekbones: Cheekbones stronger.
        cheeks: Cheeks fuller.
        forehead: Forehead higher and rounder.
        ears: Ears larger and further from the head.
    """

    width: float = 0.0
    length: float = 0.0
    depth: float = 0.0
    jaw: float = 0.0
    chin_width: float = 0.0
    chin: float = 0.0
    neck: float = 0.0
    nose_length: float = 0.0
    nose_width: float = 0.0
    nose_bridge: float = 0.0
    nose_tip: float = 0.0
    nose_up: float = 0.0
    eye_size: float = 0.0
    eye_gap: float = 0.0
    eye_tilt: float = 0.0
    brow_height: float = 0.0
    brow_ridge: float = 0.0
    brow_tilt: float = 0.0
    lips: float = 0.0
    mouth_width: float = 0.0
    mouth_forward: float = 0.0
    cheekbones: float = 0.0
    cheeks: float = 0.0
    forehead: float = 0.0
    ears: float = 0.0

    def __call__(self, points: Array) -> Array:
        """Deform points of the neutral head.

        Args:
            points: Positions in metres, shape (..., 3).

        Returns:
            Where they lie in this speaker's head, in metres, the same shape.
        """
        x, y, z = (1000.0 * points[..., axis] for axis in range(3))
        moves = _moves(np.abs(x), y, z)
        total = sum(getattr(self, f.name) * moves[f.name] for f in fields(self))
        moved = np.asarray(total)
        side = np.stack([np.sign(x), np.ones_like(x), np.ones_like(x)], axis=-1)
        return np.asarray(points + moved * side / 1000.0)


def _moves(x: Array, y: Array, z: Array) -> dict[str, Array]:
    """Displacement in mm of every point of the left half for each number of `Shape` at 1."""
    front = rise(z, 0.0, 50.0)
    zero = np.zeros_like(x)

    def move(dx: Array = zero, dy: Array = zero, dz: Array = zero) -> Array:
        return np.stack(np.broadcast_arrays(dx, dy, dz), axis=-1)

    below_nose = rise(y, -5.0, -90.0) * rise(y, -150.0, -105.0)
    mouth = bump(x, y, (0, MOUTH_Y), (24, 13)) * front
    tip = bump(x, y, (0, -12), (9, 9)) * rise(z, 75.0, 105.0)
    nose = bump(x, y, (0, -12), (16, 15)) * front
    eye_x, eye_y = x - EYE_CENTRE[0], y - EYE_CENTRE[1]
    eye = bump(x, y, EYE_CENTRE[:2], (17, 13)) * front
    brow = bump(x, y, (30, 44), (22, 9)) * front
    chin = bump(x, y, (0, -84), (20, 17)) * front
    ear = rise(x, 68.0, 82.0) * bump(y, z, (14, -16), (30, 24))
    return {
        "width": move(0.068 * x * rise(y, -150.0, -60.0)),
        "length": move(dy=-11.0 * below_nose),
        "depth": move(dz=0.07 * np.minimum(z + 5.0, 0.0)),
        "jaw": move(8.0 * bump(y, z, (-58, 15), (24, 34)) * rise(x, 8.0, 50.0)),
        "chin_width": move(5.0 * bump(y, z, (-84, 75), (14, 25)) * rise(x, 0.0, 20.0) * rise(x, 75.0, 30.0)),
        "chin": move(dy=-6.0 * chin, dz=5.0 * chin),
        "neck": move(0.14 * x * rise(y, -75.0, -115.0), dz=0.10 * (z + 20.0) * rise(y, -88.0, -118.0)),
        "nose_length": move(dy=-5.5 * nose),
        "nose_width": move(0.36 * x * bump(x, y, (0, -16), (15, 10)) * front),
        "nose_bridge": move(dz=5.0 * bump(x, y, (0, 18), (6, 14)) * front),
        "nose_tip": move(dz=4.0 * tip),
        "nose_up": move(dy=3.0 * tip, dz=-0.5 * tip),
        "eye_size": move(0.16 * eye_x * eye, 0.26 * eye_y * eye, 0.10 * (z - EYE_CENTRE[2]) * eye),
        "eye_gap": move(4.0 * bump(x, y, (32, 30), (20, 18)) * front * rise(x, 4.0, 20.0)),
        "eye_tilt": move(dy=0.17 * eye_x * eye),
        "brow_height": move(dy=4.2 * brow),
        "brow_ridge": move(dy=-1.0 * brow, dz=4.0 * bump(x, y, (24, 42), (20, 6)) * front),
        "brow_tilt": move(dy=0.18 * (x - 28.0) * brow),
        "lips": move(dy=0.38 * (y - MOUTH_Y) * mouth, dz=1.6 * bump(x, y, (0, MOUTH_Y), (15, 9)) * front),
        "mouth_width": move(0.2 * x * mouth),
        "mouth_forward": move(dz=3.5 * bump(x, y, (0, MOUTH_Y), (26, 20)) * front),
        "cheekbones": move(
            4.0 * bump(y, z, (-4, 50), (13, 22)) * rise(x, 20.0, 55.0),
            dz=3.5 * bump(x, y, (46, -3), (13, 12)) * front,
        ),
        "cheeks": move(
            6.0 * bump(y, z, (-34, 48), (20, 24)) * rise(x, 20.0, 55.0),
            dz=4.0 * bump(x, y, (42, -34), (15, 18)) * front,
        ),
        "forehead": move(dy=0.07 * np.maximum(y - 50.0, 0.0), dz=5.0 * bump(x, y, (0, 78), (45, 22)) * front),
        "ears": move(4.0 * ear, 0.12 * (y - 14.0) * ear, -2.0 * ear),
    }


# Where the vertices of the skin lie: rings round mouth and eyes, rows on nose and brows, an even fill.
#
# Points live in the plane of (length round the head, level), in mm, where the skin is hardly distorted. Only
# the left half is laid out; points on the midline have length 0.

LIP_COLUMNS = np.array([0.0, 4.2, 8.2, 12.0, 15.8, 19.4, 22.5, 25.0])
MOUTH_HALF_WIDTH = 25.0
EYE_COLUMNS = np.array([0.07, 0.2, 0.35, 0.5, 0.65, 0.8, 0.93])
BROW_COLUMNS = np.array([13.0, 19.5, 27.0, 34.5, 42.0, 48.5])
_INNER_CANTHUS, _OUTER_CANTHUS = np.array([17.0, 23.8]), np.array([45.5, 26.2])
_NOSE_ROWS: dict[float, tuple[float, ...]] = {
    32.0: (0.0, 6.0),
    23.0: (0.0, 5.0),
    14.0: (0.0, 5.0, 10.0),
    5.0: (0.0, 5.0, 10.5),
    -3.0: (0.0, 5.5, 10.5, 16.0),
    -9.0: (0.0, 5.0, 10.0, 14.5, 20.0),
    -14.0: (0.0, 5.5, 10.5, 15.0, 20.0),
    -18.5: (0.0, 4.0, 8.5, 13.5, 18.0, 22.5),
    -23.0: (0.0, 4.5, 9.5, 15.0),
}


@dataclass(frozen=True)
class Layout:
    """The left half of the skin before it is put into space.

    Attributes:
        theta: Angle round the head of every point, shape (n,).
        level: Level of every point, shape (n,).
        triangles: Indices of points, counter-clockwise, shape (m, 3).
        rings: Named index lists: ``mouth_0`` (the lips' outer border) to ``mouth_2``, from the upper midline
            over the corner to the lower midline; ``eye_0`` (the lids' edge) to ``eye_2``, from the inner
            corner over the upper lid; ``brow`` (middle line of the brow).
    """

    theta: Array
    level: Array
    triangles: NDArray[np.int64]
    rings: dict[str, list[int]]


def contact_line(x: Array) -> Array:
    """Height in mm of the line where the lips meet."""
    return MOUTH_Y + through([0, 6, 14, 25], [-0.8, 0.1, 0.1, 0.2], x)


def mouth_ring(distance: float) -> Array:
    """Closed outline of the lips, or a curve at a distance outside, as (x, y) in mm, shape (15, 2)."""
    upper = through([0, 5.5, 12, 19, 25], [6.6, 8.2, 6.4, 3.2, 0.0], LIP_COLUMNS)
    lower = through([0, 8, 16, 25], [9.2, 8.6, 5.6, 0.0], LIP_COLUMNS)
    turn = 0.5 * np.pi * LIP_COLUMNS / MOUTH_HALF_WIDTH
    x = LIP_COLUMNS + distance * np.sin(turn)
    middle = contact_line(LIP_COLUMNS)
    top = np.stack([x, middle + upper + distance * np.cos(turn)], axis=1)
    bottom = np.stack([x, middle - lower - distance * np.cos(turn)], axis=1)
    return np.concatenate([top, bottom[-2::-1]])


def eye_ring(distance: float) -> Array:
    """Closed outline of the eye's opening, or a curve outside it, as (x, y) in mm, shape (16, 2)."""
    t = EYE_COLUMNS[:, None]
    line = _INNER_CANTHUS + t * (_OUTER_CANTHUS - _INNER_CANTHUS)
    up = np.array([0.0, 1.0])
    top = line + up * 6.2 * np.sin(np.pi * t**0.92) ** 0.75
    bottom = line - up * 4.3 * np.sin(np.pi * t**1.1) ** 0.75
    ring = np.concatenate([_INNER_CANTHUS[None], top, _OUTER_CANTHUS[None], bottom[::-1]])
    centre = 0.5 * (_INNER_CANTHUS + _OUTER_CANTHUS)
    away = (ring - centre) / np.array([14.0, 8.0])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    squeeze = np.where(away[:, :1] < 0, 1.0 - 0.45 * np.abs(away[:, :1]), 1.0)
    return np.asarray(ring + distance * away * squeeze)


def brow_line(x: Array) -> Array:
    """Height in mm of the middle of the brow."""
    return through([8, 20, 36, 50], [40.5, 43.5, 45.0, 39.5], x)


def hairline(theta: Array) -> Array:
    """Level at which the hair begins, going round the head."""
    return through([0, 0.35, 0.7, 1.0, 1.2, 1.5, 1.9, 3.2], [88, 88, 76, 56, 34, 12, -12, -52], theta)


def spacing(theta: Array, level: Array) -> Array:
    """Wanted distance between neighbouring points, in mm."""
    round_head = through([0, 0.8, 1.3, 1.9, 3.2], [10, 11.5, 17, 27, 33], theta)
    height = 1.0 + 0.9 * rise(level, 55.0, 110.0) + 1.1 * rise(level, -88.0, -115.0)
    return np.minimum(round_head * height, 34.0)


def lay_out() -> Layout:
    """Place and connect the points of the left half of the skin."""
    features, rings = _features()
    points = [tuple(point) for point in features]
    points += _edges(np.array(points))
    fixed = len(points)
    points += _fill(np.array(points))
    places = _relax(np.array(points), fixed)
    triangles = _cut(places, delaunay(places))
    theta = np.clip(places[:, 0] / radius(places[:, 1]), 0.0, np.pi)
    return Layout(theta, places[:, 1], triangles, rings)


def to_plane(front: Array) -> Array:
    """Turn places (x, y) on the front of the head into the plane of the layout."""
    theta, level = locate(front[:, 0], front[:, 1])
    return np.stack([theta * radius(level), level], axis=1)


def _features() -> tuple[Array, dict[str, list[int]]]:
    groups = {f"mouth_{k}": mouth_ring(distance) for k, distance in enumerate((0.0, 4.5, 10.5))}
    groups |= {f"eye_{k}": eye_ring(distance) for k, distance in enumerate((0.0, 3.5, 9.0))}
    brow = np.stack([BROW_COLUMNS, brow_line(BROW_COLUMNS)], axis=1)
    groups["brow"] = brow
    groups["brow_above"] = brow + np.array([0.0, 5.0])
    groups["brow_below"] = brow[:2] - np.array([0.0, 4.5])
    groups["brow_ends"] = np.array([[0.0, 41.0], [7.5, 41.5], [54.0, 37.0]])
    groups["nose"] = np.array([(x, y) for y, row in _NOSE_ROWS.items() for x in row])
    rings: dict[str, list[int]] = {}
    count = 0
    for name, group in groups.items():
        rings[name] = list(range(count, count + len(group)))
        count += len(group)
    theta = np.array([0.0, 0.16, 0.33, 0.5, 0.66, 0.8, 0.93, 1.07, 1.22, 1.38, 1.56, 1.78])
    level = hairline(theta)
    rings["hairline"] = list(range(count, count + len(theta)))
    row = np.stack([theta * radius(level), level], axis=1)
    return np.concatenate([to_plane(np.concatenate(list(groups.values()))), row]), rings


def _edges(features: Array) -> list[tuple[float, float]]:
    """Points on the midline in front and at the back and on the rows that end neck and crown."""
    ends = (LOWEST_LEVEL, HIGHEST_LEVEL)
    front_levels = [*ends, *features[features[:, 0] == 0.0, 1]]
    lips = mouth_ring(0.0)[[-1, 0], 1]
    front = [level for level in _between(sorted(front_levels), 0.0) if not lips[0] < level < lips[1]]
    edge = [(0.0, level) for level in front]
    edge += [(0.0, level) for level in ends]
    # Where nape and crown bend, the outline of the back needs more points than the even spacing gives.
    bends = [LOWEST_LEVEL, -112.0, -96.0, 112.0, 134.0, HIGHEST_LEVEL]
    back = [*bends, *_between(bends, np.pi)]
    edge += [(float(np.pi * radius(level)), level) for level in back]
    for level, parts in ((LOWEST_LEVEL, 5), (HIGHEST_LEVEL, 4)):
        length = float(np.pi * radius(level))
        edge += [(length * k / parts, level) for k in range(1, parts)]
    return edge


def _between(levels: list[float], theta: float) -> list[float]:
    """Levels that divide the gaps between the given ones at the wanted spacing."""
    added: list[float] = []
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        walk = np.linspace(low, high, 65)
        density = 1.0 / spacing(np.full(65, theta), walk)
        reach = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(walk))])
        parts = int(np.floor(reach[-1] + 0.45))
        added += [float(level) for level in np.interp(np.arange(1, parts) / max(parts, 1) * reach[-1], reach, walk)]
    return added


def _fill(points: Array) -> list[tuple[float, float]]:
    """Fill what is left, row by row, with points as far apart as `spacing` asks."""
    holes = [to_plane(mouth_ring(0.0)), to_plane(eye_ring(0.0))]
    pitch = 2.5
    taken = points
    wanted = spacing(taken[:, 0] / radius(taken[:, 1]), taken[:, 1])
    new: list[tuple[float, float]] = []
    for row, level in enumerate(np.arange(LOWEST_LEVEL + 6, HIGHEST_LEVEL - 3, pitch)):
        limit = float(np.pi * radius(level))
        for length in np.arange(4.0 + 0.5 * pitch * (row % 2), limit, pitch):
            own = float(spacing(np.array(length / radius(level)), np.array(level)))
            far = np.hypot(taken[:, 0] - length, taken[:, 1] - level)
            nearest = (far / np.minimum(0.5 * (wanted + own), own)).min()
            if nearest < 0.88 or limit - length < 0.5 * own or length < 0.6 * own:
                continue
            if any(_inside(hole, np.array([[length, level]]))[0] for hole in holes):
                continue
            new.append((float(length), float(level)))
            taken = np.concatenate([taken, [[length, level]]])
            wanted = np.append(wanted, own)
    return new


def _inside(outline: Array, places: Array) -> NDArray[np.bool_]:
    """Say which places lie inside a closed outline (crossing number)."""
    first, second = outline[:, None], np.roll(outline, -1, axis=0)[:, None]
    straddles = (first[..., 1] > places[:, 1]) != (second[..., 1] > places[:, 1])
    rising = np.where(second[..., 1] == first[..., 1], 1.0, second[..., 1] - first[..., 1])
    cross = first[..., 0] + (places[:, 1] - first[..., 1]) / rising * (second[..., 0] - first[..., 0])
    return np.asarray((straddles & (cross > places[:, 0])).sum(axis=0) % 2 == 1)


def _relax(places: Array, fixed: int, rounds: int = 6) -> Array:
    """Even out the free points: each moves towards the mean of its neighbours."""
    places = places.copy()
    for _ in range(rounds):
        triangles = delaunay(places)
        total, degree = np.zeros_like(places), np.zeros(len(places))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            np.add.at(total, triangles[:, a], places[triangles[:, b]])
            np.add.at(degree, triangles[:, a], 1.0)
        mean = total / np.maximum(degree, 1.0)[:, None]
        places[fixed:] += 0.6 * (mean - places)[fixed:]
    return places


def _cut(places: Array, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Drop the triangles in the mouth, in the eye and beyond the back of the head."""
    centre = places[triangles].mean(axis=1)
    back = places[places[:, 0] > np.pi * radius(places[:, 1]) - 0.1]
    back = back[np.argsort(back[:, 1])]
    drop = centre[:, 0] > np.interp(centre[:, 1], back[:, 1], back[:, 0]) - 1e-6
    for ring in (mouth_ring(0.0), eye_ring(0.0)):
        drop |= _inside(to_plane(ring), centre)
    kept: NDArray[np.int64] = triangles[~drop]
    return kept


N_VERTICES = 1008

EYEBALL_RADIUS = 14.0
_SKIN, _HAIR, _BROW, _LIP = (226, 178, 152), (74, 52, 40), (92, 64, 48), (196, 104, 98)
_LID_EDGE, _MOUTH, _THROAT, _TEETH = (120, 76, 62), (132, 58, 56), (30, 10, 12), (240, 235, 222)
_WHITE, _IRIS, _PUPIL, _NOSTRIL = (244, 242, 238), (86, 116, 122), (22, 18, 18), (120, 72, 60)


@lru_cache(maxsize=1)
def build_face() -> Mesh:
    """Build the neutral head, in metres; speakers' heads have the same faces and other vertices."""
    half = HalfMesh()
    layout = lay_out()
    _add_skin(half, layout)
    _add_mouth(half)
    _add_teeth(half)
    _add_lids(half)
    _add_eyeball(half)
    _add_ear(half)
    mesh = half.mirrored()
    return Mesh(mesh.vertices / 1000.0, mesh.faces, mesh.colours, mesh.mirror, mesh.groups)


def _add_skin(half: HalfMesh, layout: Layout) -> None:
    points = skin(layout.theta, layout.level)
    points[layout.theta == 0.0, 0] = 0.0
    points[layout.theta > np.pi - 1e-6, 0] = 0.0
    index = half.add("skin", points, _SKIN)
    half.faces.append(index[layout.triangles])
    top = np.flatnonzero(layout.level == layout.level.max())
    top = top[np.argsort(layout.theta[top])]
    crown = int(half.add("crown", np.array([CROWN]), _HAIR)[0])
    half.faces.append(np.array([[a, b, crown] for a, b in zip(top[:-1], top[1:], strict=True)]))
    for name, ring in layout.rings.items():
        half.groups[name] = index[ring]
    _paint_skin(half, points, layout)


def _paint_skin(half: HalfMesh, points: Array, layout: Layout) -> None:
    colours = half.colours[0]
    x, y, z = points.T
    line = hairline(layout.theta)
    _mix(colours, rise(layout.level, line + 0.5, line + 8.0), _HAIR)
    blush = 0.30 * bump(x, y, (44, -6), (13, 11)) + 0.25 * bump(x, y, (0, -10), (8, 6))
    _mix(colours, np.where(z > 0, blush, 0.0), (222, 128, 110))
    _mix(colours, np.where(z > 0, bump(x, y, (7.0, -20.5), (2.4, 2.4)), 0.0), _NOSTRIL)
    colours[half.groups["brow"]] = _BROW
    colours[half.groups["mouth_0"]] = 0.75 * np.array(_LIP) + 0.25 * np.array(_SKIN)
    colours[half.groups["eye_0"][1:8]] = _LID_EDGE
    colours[half.groups["eye_0"][9:]] = 0.5 * (np.array(_LID_EDGE) + np.array(_SKIN))


def _mix(colours: Array, share: Array, colour: tuple[int, int, int]) -> None:
    colours += share[:, None] * (np.array(colour, dtype=np.float64) - colours)


def _add_mouth(half: HalfMesh) -> None:
    """Lips from their outer border over the crest to the line of contact, and the mouth behind them."""
    border = half.groups["mouth_0"]
    outline = half.points[0][border]
    # How full the lips are along the chain: zero at the corner, where both become one.
    side = np.sign(np.arange(15) - 7.0)
    x = np.concatenate([LIP_COLUMNS, LIP_COLUMNS[-2::-1]])
    full = np.sqrt(np.clip(1.0 - (x / MOUTH_HALF_WIDTH) ** 2, 0.0, 1.0))
    middle = contact_line(x)
    height = outline[:, 1] - middle
    upper = side < 0
    # The surface on which the lips meet: a little in front of the corners, back where the outline is.
    depth = through(
        [0, 12, 20, 25],
        [
            outline[[0, 14], 2].mean() + 0.6,
            outline[[3, 11], 2].mean() + 0.4,
            outline[[5, 9], 2].mean() - 0.4,
            outline[7, 2] - 0.6,
        ],
        x,
    )

    def loop(
        name: str, dx: float, share: float, lift: Array, forward: Array, colour: tuple[int, int, int]
    ) -> NDArray[np.int64]:
        y = middle + share * height + lift
        z = depth + forward
        return half.add(name, np.stack([x * dx, y, z], axis=1), colour)

    crest = loop("lip_crest", 1.0, 0.55, 0.0 * x, np.where(upper, 2.4, 3.2) * full, _LIP)
    front = loop("lip_front", 0.995, 0.2, 0.0 * x, np.where(upper, 1.4, 1.9) * full, _LIP)
    contact = loop("lip_inner", 0.99, 0.0, 0.0 * x, -1.5 * np.ones(15), tuple(np.array(_LIP) * 9 // 10))
    roll = loop("lip_roll", 0.96, 0.0, -side * 2.0 * full - 0.2 * side, -5.0 - 0.5 * full, _MOUTH)
    bag = loop("mouth_bag", 0.86, 0.0, -side * (8.0 * full), -15.0 - 2.0 * full, tuple(np.array(_MOUTH) * 2 // 3))
    back = loop("mouth_back", 0.7, 0.0, -side * (9.0 * full), -28.0 - 2.0 * full, _THROAT)
    for outer, inner in (
        (border, crest),
        (crest, front),
        (front, contact),
        (contact, roll),
        (roll, bag),
        (bag, back),
    ):
        half.strip(outer, inner)
    for i in range(7):
        a, b, c, d = back[i], back[i + 1], back[13 - i], back[14 - i]
        half.faces.append(np.array([[a, d, c], [a, c, b]]) if i < 6 else np.array([[a, d, b]]))


def _add_teeth(half: HalfMesh) -> None:
    """Two curved rows of teeth, each a strip that bends back at gums and edge."""
    columns = np.array([0.0, 6.5, 13.0, 19.0])
    front = float(half.points[0][half.groups["mouth_0"][0], 2]) - 8.5
    arc = front - 14.0 * (columns / 20.0) ** 2
    for name, root, edge, behind in (("teeth_upper", -40.0, -50.2, 0.0), ("teeth_lower", -60.0, -50.8, 2.2)):
        rows = [
            half.add(f"{name}_{k}", np.stack([columns * s, np.full(4, y), arc - back - behind], axis=1), _TEETH)
            for k, (s, y, back) in enumerate(((0.97, root, 1.5), (1.0, edge, 0.0)))
        ]
        for outer, inner in zip(rows[:-1], rows[1:], strict=True):
            half.strip(*((outer, inner) if root > edge else (inner, outer)))


def _add_lids(half: HalfMesh) -> None:
    """Give the lids a thickness: a ring behind the edge, so that no gap shows round the eyeball."""
    edge = half.groups["eye_0"]
    points = half.points[0][edge]
    centre = points.mean(axis=0)
    shrink = np.full(16, 0.06)
    # The ball is narrower than the opening: at the corners the lids' backs reach in to it.
    shrink[[0, 8]] = 0.2
    inner = points + shrink[:, None] * (centre - points)
    inner[:, 2] = points[:, 2] - 3.0
    half.strip(edge, half.add("lid_inner", inner, (206, 140, 122)), closed=True)


def _add_eyeball(half: HalfMesh) -> None:
    """Front of an eyeball that looks straight ahead."""
    turn = -2.0 * np.pi * (np.arange(10) + 0.5) / 10.0
    rings = []
    for k, (degrees, cornea, colour) in enumerate(
        ((80.0, 0.0, _WHITE), (29.0, 0.2, _WHITE), (26.0, 0.4, _IRIS), (11.5, 0.7, _PUPIL))
    ):
        angle = np.deg2rad(degrees)
        r = EYEBALL_RADIUS + cornea
        ring = np.stack(
            [
                r * np.sin(angle) * np.cos(turn),
                r * np.sin(angle) * np.sin(turn),
                np.full(10, r * np.cos(angle)),
            ],
            axis=1,
        )
        rings.append(half.add(f"eyeball_{k}", ring + np.array(EYE_CENTRE), colour))
    for outer, inner in zip(rings[:-1], rings[1:], strict=True):
        half.strip(outer, inner, closed=True)
    tip = np.array([[EYE_CENTRE[0], EYE_CENTRE[1], EYE_CENTRE[2] + EYEBALL_RADIUS + 0.8]])
    half.fan(rings[-1], int(half.add("pupil", tip, _PUPIL)[0]))


def _add_ear(half: HalfMesh) -> None:
    """A shell beside the head: rim, hollow and lobe."""
    turn = -2.0 * np.pi * np.arange(8) / 8.0
    # Outline in the ear's own plane, (backwards, up) in mm.
    outline = np.stack([-16.0 * np.sin(turn) * (1.0 + 0.18 * np.cos(turn)), 30.0 * np.cos(turn)], axis=1)
    lift = np.array([0.0, 0.0])
    rings = []
    for name, scale, out in (
        ("ear_back", 0.72, -7.0),
        ("ear_rim", 1.0, 1.0),
        ("ear_front", 0.9, 2.6),
        ("ear_valley", 0.68, -1.0),
    ):
        flat = outline * scale + lift
        rings.append(half.add(name, _beside_head(flat, np.full(8, out)), _SKIN))
    for outer, inner in zip(rings[:-1], rings[1:], strict=True):
        half.strip(outer, inner, closed=True)
    centre = half.add("ear_hollow", _beside_head(np.array([[3.0, -4.0]]), np.array([-5.0])), (190, 130, 110))
    half.fan(rings[-1], int(centre[0]))


def _beside_head(flat: Array, out: Array) -> Array:
    """Turn (backwards, up) and a distance outwards, in mm, into a place beside the head."""
    tilt, flare = np.deg2rad(-12.0), np.deg2rad(24.0)
    back = flat[:, 0] * np.cos(tilt) - flat[:, 1] * np.sin(tilt)
    up = flat[:, 0] * np.sin(tilt) + flat[:, 1] * np.cos(tilt)
    x = 79.5 + back * np.sin(flare) + out * np.cos(flare)
    z = -12.0 - back * np.cos(flare) + out * np.sin(flare)
    return np.stack([x, 14.0 + up, z], axis=1)
