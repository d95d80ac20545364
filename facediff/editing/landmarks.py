"""Landmarks of a face: of known topologies by their vertices, of other meshes by their shape, and pairs on disk.

One set of names serves every mesh: "left" is the face's own left. A landmark is a vertex or a point within a triangle;
a pair is the same landmark on the source and on the target.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from facediff.editing.face_features import Features, Opening, find_features
from facediff.errors import FaceDiffError, choices
from facediff.synthetic.head.parts import N_HEAD_VERTICES, build_head
from facediff.utils.hints import Range
from facediff.utils.limits import check_format, quoted
from facediff.utils.numerics import Array, Floats, Indices, Integers
from facediff.utils.plain_files import load_json, read_table, write_json
from facediff.utils.records import Text, read_record

FLAME_VERTICES, CANONICAL_VERTICES = 5023, 468
_TABLE: dict[str, tuple[str, int, int]] = {
    "nose_tip": ("where the nose reaches furthest forward", 3564, 1),
    "chin": ("where the chin reaches furthest forward, in the middle", 3487, 152),
    "mouth_corner_left": ("where the borders of both lips meet", 1703, 291),
    "mouth_corner_right": ("where the borders of both lips meet", 2820, 61),
    "eye_outer_left": ("the outer corner of the eye", 1154, 263),
    "eye_outer_right": ("the outer corner of the eye", 2428, 33),
    "eye_inner_left": ("the inner corner of the eye, next to the nose", 3832, 362),
    "eye_inner_right": ("the inner corner of the eye, next to the nose", 3631, 133),
    "nose_bridge": ("between the inner corners of the eyes, on the nose", 3516, 168),
    "nose_base": ("where the nose meets the upper lip, in the middle", 3556, 2),
    "upper_lip_top": ("the upper border of the upper lip, in the middle", 3543, 0),
    "lower_lip_bottom": ("the lower border of the lower lip, in the middle", 3503, 17),
    "upper_lip_middle": ("the edge of the upper lip, in the middle, just above the line between the lips", 3531, 13),
    "lower_lip_middle": ("the edge of the lower lip, in the middle, just below the line between the lips", 3504, 14),
}
NAMES = {name: place for name, (place, _, _) in _TABLE.items()}
"""Every name and the place that it stands for, in the order in which the places are best picked."""
LEFT, RIGHT = "_left", "_right"

FLAME = {name: vertex for name, (_, vertex, _) in _TABLE.items()}
"""Vertices of FLAME's topology (VOCASET, 3DMEAD and others of 5023 vertices).

All but two are the vertices that SAiD publishes for the 68 landmarks of iBUG 300-W (github.com/yunik1004/SAiD,
``data/FLAME_landmarks.txt``; numbers 30, 54, 48, 45, 36, 42, 39, 33, 51, 57, 62 and 66 from 0). The chin and the bridge
of the nose are vertices of the middle of the published template (github.com/yfeng95/DECA, ``data/head_template.obj``):
the one that reaches furthest forward below the mouth, and the one at the height of the inner corners of the eyes. No
list was found for BIWI (23370 vertices), and Multiface's authors say that there is none for theirs
(github.com/facebookresearch/multiface, issue 21): :func:`landmarks_by_shape` finds some of theirs.
"""
CANONICAL = {name: vertex for name, (_, _, vertex) in _TABLE.items()}
"""Vertices of MediaPipe's canonical face, which the corpora of ``facediff data track`` have."""


def puppet_landmarks() -> dict[str, int]:
    """Vertices of the built-in head.

    Example:
        >>> puppet_landmarks()["nose_tip"]
        704
    """
    face = build_head()
    points, border, eye = face.vertices, face.groups["lip_border"], face.groups["eye_edge"]
    front, middle = face.groups["lip_front"], np.flatnonzero(face.mirror == np.arange(len(points)))
    # Of the skin in front: without the crown, the teeth and the inside of the mouth.
    middle = middle[np.isin(middle, face.groups["skin"]) & (points[middle, 2] > 30.0)]
    height, depth = points[middle, 1], points[middle, 2]
    tip, level = middle[depth.argmax()], points[eye[0], 1]
    # The nose begins where the profile lies furthest back between its tip and the lips.
    base = middle[np.where((height < points[tip, 1]) & (height > points[border[0], 1]), depth, np.inf).argmin()]
    left = {"mouth_corner": border[len(border) // 2], "eye_outer": eye[len(eye) // 2], "eye_inner": eye[0]}
    vertices = {
        "nose_tip": tip,
        "chin": middle[np.where(height < points[border[-1], 1] - 10.0, depth, -1.0).argmax()],
        "nose_bridge": middle[np.abs(height - level).argmin()],
        "nose_base": base,
        "upper_lip_top": border[0],
        "lower_lip_bottom": border[-1],
        "upper_lip_middle": front[0],
        "lower_lip_middle": front[-1],
        **{name + LEFT: vertex for name, vertex in left.items()},
        **{name + RIGHT: face.mirror[vertex] for name, vertex in left.items()},
    }
    return {name: int(vertices[name]) for name in NAMES}


@dataclass(frozen=True)
class LandmarkTemplate:
    """The named places of a mesh."""

    topology: str | None  # puppet, FLAME or people; None where the places were found by the mesh's shape
    vertices: dict[str, int]  # of each name that is known, in the order of :data:`NAMES`

    @property
    def missing(self) -> list[str]:
        """The names that are not known on this mesh."""
        return [name for name in NAMES if name not in self.vertices]


def known_landmarks(vertices: Floats, faces: Integers) -> LandmarkTemplate:
    """The named landmarks of a mesh (V, 3), (F, 3), by its topology or, with y up and z to the viewer, by its shape.

    A topology is recognised by the number of its vertices, and by its landmarks: left and right must be mirror images,
    with the others between them, so that a mesh with reordered vertices is not mistaken for the original.

    Example:
        >>> head = build_head()
        >>> known_landmarks(head.vertices, head.faces).topology
        'puppet'
    """
    return known_topology(vertices) or LandmarkTemplate(
        None, landmarks_by_shape(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))
    )


def known_topology(vertices: Floats) -> LandmarkTemplate | None:
    """The named places of a mesh of a known topology; None of another one."""
    points = np.asarray(vertices, np.float64)
    for topology, count, table in (
        ("puppet", N_HEAD_VERTICES, puppet_landmarks),
        ("FLAME", FLAME_VERTICES, FLAME.copy),
        ("people", CANONICAL_VERTICES, CANONICAL.copy),
    ):
        if len(points) == count and _lie_as_on_a_face(points, landmarks := table()):
            return LandmarkTemplate(topology, landmarks)
    return None


PARALLEL = 0.95  # Cosine of the angle between the ways from right to left, of mirror images 1
MIDDLE = 0.12  # So far from the middle, as a share of the distance of the eyes, the others may lie


def _lie_as_on_a_face(points: Array, landmarks: Mapping[str, int]) -> bool:
    """Whether the landmarks lie as they do on a face, in any unit and orientation."""
    at = {name: points[vertex] for name, vertex in landmarks.items()}
    bases = [name.removesuffix(LEFT) for name in landmarks if name.endswith(LEFT)]
    across = np.stack([at[base + LEFT] - at[base + RIGHT] for base in bases])
    lengths = np.linalg.norm(across, axis=1)
    if not (lengths > 0).all():
        return False
    # All ways from right to left are parallel on a face; their sum is steadier than any of them.
    axis = across.sum(axis=0) / np.linalg.norm(across.sum(axis=0))
    if (across @ axis < PARALLEL * lengths).any():
        return False
    centres = np.stack([0.5 * (at[base + LEFT] + at[base + RIGHT]) for base in bases])
    middle = np.concatenate([centres, [at[name] for name in landmarks if not name.endswith((LEFT, RIGHT))]])
    size = float(np.linalg.norm(at["eye_outer_left"] - at["eye_outer_right"]))
    if np.ptp(middle @ axis) > 2 * MIDDLE * size:
        return False
    eyes, mouth = (0.5 * (at[f"{base}_left"] + at[f"{base}_right"]) for base in ("eye_outer", "mouth_corner"))
    down = mouth - eyes
    # From the eyes downwards: bridge, tip and base of the nose, then the chin, which lies beyond the mouth. A mesh of
    # another order of vertices that passes the tests above fails this one.
    order = [float(down @ (at[name] - eyes)) for name in ("nose_bridge", "nose_tip", "nose_base", "chin")]
    return order == sorted(order) and order[-1] > float(down @ down) > 0.05 * size**2


EYES_ABOVE = 1.4  # Height of the eyes above the mouth, in widths of an average mouth


def landmarks_by_shape(vertices: Array, faces: Indices, features: Features | None = None) -> dict[str, int]:
    """Vertices of the names that a mesh's openings show: corners and middle of the mouth, corners of the eyes, nose."""
    features = features or find_features(vertices, faces)
    if features is None:
        return {}
    landmarks: dict[str, int] = {}

    def nearest(points: Array, to: Array, allowed: Indices) -> int:
        return int(allowed[np.linalg.norm(points[allowed] - to, axis=1).argmin()])

    skin = np.unique(faces[features.skin[faces].all(axis=1)])
    mouth = features.mouth
    middle = len(mouth.upper) // 2
    # The larger x is the face's left.
    landmarks["mouth_corner_right"], landmarks["mouth_corner_left"] = (
        nearest(vertices, 0.5 * (mouth.upper[end] + mouth.lower[end]), skin) for end in (0, -1)
    )
    landmarks["upper_lip_middle"] = nearest(vertices, mouth.upper[middle], mouth.upper_seeds)
    landmarks["lower_lip_middle"] = nearest(vertices, mouth.lower[middle], mouth.lower_seeds)
    for side, eye, inner in ((RIGHT, features.eyes[0], -1), (LEFT, features.eyes[1], 0)):
        if eye is not None:
            landmarks["eye_inner" + side] = nearest(vertices, _end(eye, inner), skin)
            landmarks["eye_outer" + side] = nearest(vertices, _end(eye, -1 - inner), skin)
    eyes = [eye for eye in features.eyes if eye is not None]
    x, y = mouth.centre[:2]
    # Eyes that are painted are not found: then they are where an average face has them.
    level = float(np.mean([eye.centre[1] for eye in eyes])) if eyes else y + EYES_ABOVE * mouth.width
    points = vertices[skin]
    # Of what lies between the mouth and the eyes, in the middle, the tip of the nose is furthest forward.
    between = (np.abs(points[:, 0] - x) < 0.25 * mouth.width) & (
        np.abs(points[:, 1] - 0.5 * (y + level)) < 0.35 * (level - y)
    )
    if between.any():
        landmarks["nose_tip"] = int(skin[np.where(between, points[:, 2], -np.inf).argmax()])
    return {name: landmarks[name] for name in NAMES if name in landmarks}


def _end(opening: Opening, end: int) -> Array:
    return np.asarray(0.5 * (opening.upper[end] + opening.lower[end]))


# Pairs of places, in memory and on disk.


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """L places of a surface: corners (L, 3) of triangles and their weights (L, 3), of a vertex 1, 0 and 0."""

    corners: Indices
    weights: Array

    @classmethod
    def of_vertices(cls, indices: Integers) -> SurfacePoints:
        """The places of vertices (L,)."""
        corners = np.repeat(np.asarray(indices, np.int64).reshape(-1, 1), 3, axis=1)
        return cls(corners, np.tile([1.0, 0.0, 0.0], (len(corners), 1)))

    def points(self, vertices: Array) -> Array:
        """Where they are (L, 3) on a mesh (V, 3)."""
        return np.asarray(np.einsum("lk,lkd->ld", self.weights, vertices[self.corners]))


@dataclass(frozen=True, eq=False)
class Landmarks:
    """L pairs of places that are the same on a source and on a target."""

    names: tuple[str, ...]  # of each pair; empty where it has none
    source: SurfacePoints
    target: SurfacePoints

    @classmethod
    def of_vertices(cls, pairs: Integers, names: Sequence[str] = ()) -> Landmarks:
        """Pairs (L, 2) of a source and a target vertex."""
        vertices = np.asarray(pairs, np.int64).reshape(-1, 2)
        return cls(
            tuple(names) or ("",) * len(vertices),
            SurfacePoints.of_vertices(vertices[:, 0]),
            SurfacePoints.of_vertices(vertices[:, 1]),
        )

    def __len__(self) -> int:
        """How many there are."""
        return len(self.names)

    def check(self, source_vertices: int, target_vertices: int, where: object = "landmarks") -> None:
        """Refuse vertices that do not exist."""
        for name, points, count in (
            ("source", self.source, source_vertices),
            ("target", self.target, target_vertices),
        ):
            if len(self) and not 0 <= points.corners.min() <= points.corners.max() < count:
                raise FaceDiffError(
                    f"{where}: name {name} vertex {int(points.corners.max())} of {count}; count vertices from 0"
                )

    def refuse_contradictions(self, where: object) -> None:
        """Refuse pairs of one place with several places of the other mesh; the same pair may be repeated."""
        places = [np.hstack([side.corners, side.weights]) for side in (self.source, self.target)]
        pairs = len(np.unique(np.hstack(places), axis=0))
        if any(len(np.unique(side, axis=0)) < pairs for side in places):
            raise FaceDiffError(f"{where}: gives one place of a mesh two places of the other mesh; keep one of them")


def common_landmarks(source: Floats, target: Floats) -> Landmarks | None:
    """The named pairs of two meshes (V, 3) of known topologies; None if one of them is another one."""
    templates = [known_topology(points) for points in (source, target)]
    if templates[0] is None or templates[1] is None:
        return None
    names = [name for name in templates[0].vertices if name in templates[1].vertices]
    pairs = np.array([[template.vertices[name] for template in templates if template is not None] for name in names])
    return Landmarks.of_vertices(pairs, names)


FORMAT = "facediff landmarks 1"
MOST, LONGEST_NAME = 1000, 60
Vertex = Annotated[int, Range(0, 2**31 - 1)]
VERTEX = re.compile("[0-9]{1,18}")  # fits into 64 bits
EXAMPLE = "`source vertex,target vertex`, counted from 0, or a name of both such as `nose_tip,4034`"


def read_landmarks(
    path: Path,
    source: LandmarkTemplate | None = None,
    target: LandmarkTemplate | None = None,
    counts: tuple[int, int] | None = None,
) -> Landmarks:
    """Pairs of places from a file: a CSV of two columns, or JSON as :func:`write_landmarks` writes it.

    Args:
        path: CSV with or without a header, or .json. In a CSV, a name stands for the place of that name, as far as it
            is known on the mesh; the other side may be a vertex or the same name.
        source: named places of the source; None for none.
        target: of the target.
        counts: vertices of both meshes, which a .json must have been picked on; None if they are not known.
    """
    if path.suffix.lower() == ".json":
        content = load_json(
            path, remedy=f"expected landmarks, as `facediff retarget --pick` saves them, or CSV lines {EXAMPLE}"
        )
        return parse_landmarks(content, path, counts)
    names, pairs = [], []
    for number, line in enumerate(read_table(path, remedy="expected a CSV of vertex pairs"), 1):
        cells = [cell.strip() for cell in line if cell.strip()]
        if not cells or (number == 1 and all(cell[0].isalpha() and cell not in NAMES for cell in cells)):
            continue  # nothing, or the header
        if len(cells) == 1 and cells[0] in NAMES:
            cells = cells * 2
        if len(cells) != 2 or not all(cell in NAMES or VERTEX.fullmatch(cell) for cell in cells):
            wrong = next((cell for cell in cells if cell.isidentifier() and cell not in NAMES), None)
            remedy = f'there is no name "{wrong}": {choices(wrong, NAMES)}' if wrong else f"expected {EXAMPLE}"
            raise FaceDiffError(f"{path}: line {number} is {','.join(line)}; {remedy}")
        row = [
            int(cell) if cell.isdecimal() else _vertex_of(cell, template, side, path)
            for cell, template, side in zip(cells, (source, target), ("source", "target"), strict=True)
        ]
        pairs.append(row)
        names.append(next((cell for cell in cells if cell in NAMES), ""))
    if not pairs:
        raise FaceDiffError(f"{path}: holds no pairs; expected lines {EXAMPLE}")
    landmarks = Landmarks.of_vertices(np.array(pairs, np.int64), names)
    landmarks.refuse_contradictions(path)
    return landmarks


def _vertex_of(name: str, template: LandmarkTemplate | None, side: str, where: object) -> int:
    if template is None or name not in template.vertices:
        have = list(template.vertices) if template is not None else []
        remedy = f"{choices(name, have)}, or a vertex" if have else "give its vertex"
        raise FaceDiffError(f"{where}: {name} is not known on the {side} mesh; {remedy}")
    return template.vertices[name]


def parse_landmarks(content: object, where: object, counts: tuple[int, int] | None = None) -> Landmarks:
    """Pairs of points from the content of a JSON file or a page, of meshes with so many vertices."""
    record = read_record(_File, content, where, strict=False)
    check_format(where, record.format, FORMAT)
    for key, stated, count in zip(
        ("source", "target"), (record.source_vertices, record.target_vertices), counts or (None, None), strict=True
    ):
        # Vertex numbers of another mesh would be valid and wrong.
        if not 0 < len(record.landmarks) <= MOST or (stated and count and stated != count):
            raise FaceDiffError(
                f"{where}: holds {len(record.landmarks)} pairs, picked on a {key} mesh of {stated} vertices; expected "
                f"1 to {MOST} pairs on a mesh of {count}"
            )
    sides = []
    for key in ("source", "target"):
        rows = enumerate(record.landmarks, 1)
        points = [_point(getattr(row, key), f"{where}: landmark {number}, {key}") for number, row in rows]
        corners, weights = zip(*points, strict=True)
        sides.append(SurfacePoints(np.array(corners, np.int64), np.array(weights)))
    landmarks = Landmarks(tuple(row.name for row in record.landmarks), *sides)
    if counts is not None:
        landmarks.check(*counts, where)
    landmarks.refuse_contradictions(where)
    return landmarks


@dataclass(frozen=True)
class _LandmarkRow:
    name: Annotated[str, Text(longest=LONGEST_NAME)]
    source: Any = None
    target: Any = None


@dataclass(frozen=True)
class _Inside:
    """A point within a triangle."""

    corners: tuple[Vertex, Vertex, Vertex]
    weights: tuple[float, float, float]


@dataclass(frozen=True)
class _File:
    """The content of a .json file of landmarks."""

    format: str
    landmarks: tuple[_LandmarkRow, ...]
    source_vertices: int | None = None
    target_vertices: int | None = None


def _point(value: object, where: str) -> tuple[Sequence[int], Sequence[float]]:
    """Corners and weights of one point of a surface."""
    if type(value) is int and 0 <= value < 2**31:
        return [value] * 3, [1.0, 0.0, 0.0]
    if isinstance(value, dict):
        inside = read_record(_Inside, value, where)
        weights = [max(weight, 0.0) for weight in inside.weights]
        if min(inside.weights) > -1e-6 and abs(sum(weights) - 1) < 1e-3:
            return inside.corners, [weight / sum(weights) for weight in weights]
    raise FaceDiffError(f"{where}: is {quoted(value)}; expected a vertex, or three corners with weights of sum 1")


def as_rows(landmarks: Landmarks) -> list[dict[str, Any]]:
    """Pairs of places as plain data, a row for each, as :func:`parse_landmarks` takes them."""
    rows = []
    for number, name in enumerate(landmarks.names):
        row: dict[str, Any] = {"name": name}
        for key, points in (("source", landmarks.source), ("target", landmarks.target)):
            corners, weights = points.corners[number].tolist(), points.weights[number].tolist()
            row[key] = corners[0] if weights[0] == 1.0 else {"corners": corners, "weights": weights}
        rows.append(row)
    return rows


def write_landmarks(path: Path, landmarks: Landmarks, source_vertices: int, target_vertices: int) -> None:
    """Write pairs of places as JSON, whole or not at all."""
    write_json(
        path,
        {
            "format": FORMAT,
            "source_vertices": source_vertices,
            "target_vertices": target_vertices,
            "landmarks": as_rows(landmarks),
        },
    )
