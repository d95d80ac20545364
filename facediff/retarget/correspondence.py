"""Where on one face each vertex of another one lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.retarget.pieces import Partners, partners
from facediff.retarget.placing import place
from facediff.retarget.smoothing import edges_of, smooth_field
from facediff.retarget.surface import Surface
from facediff.topology import Similarity, align, robust_align

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

STIFFNESSES = (100.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 0.3, 0.3)
"""How stiff the target is held while it is bent onto the source, from round to round."""
LANDMARK_TRUST = 100.0
CLOSE, FAR = 0.1, 0.3
"""Distances, as shares of the face's size, from which on motion fades, and from which on a vertex stands still."""
EXACT = 0.005
"""Nearer than this share of the face's size, the place on the surface is trusted fully if the sheet is right."""
BADLY = 0.05
"""A median distance above this share of the face's size is said to be a bad fit."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where each vertex of a target mesh lies on a source mesh.

    Attributes:
        corners: (Vt, 3) vertices of the source's triangle.
        weights: (Vt, 3) their barycentric weights, none negative, which sum to one.
        similarity: from the source to the target, in the target's unit.
        distances: (Vt,) between a target vertex and its place on the source after the similarity, target's unit.
        trust: (Vt,) how well the place is known, 0 to 1; where little, neighbours are averaged.
        share: (Vt,) how much of the motion is carried, 0 (too far away from anything) to 1.
        source_vertices: (Vs, 3) the source mesh that this was made for.
        source_faces: (Fs, 3).
        target_vertices: (Vt, 3) the target mesh.
        target_faces: (Ft, 3).
    """

    corners: Indices
    weights: Array
    similarity: Similarity
    distances: Array
    trust: Array
    share: Array
    source_vertices: Array
    source_faces: Indices
    target_vertices: Array
    target_faces: Indices

    @property
    def is_identity(self) -> bool:
        """Whether both meshes are one: same topology, same places."""
        return np.array_equal(self.source_vertices, self.target_vertices) and np.array_equal(
            self.source_faces, self.target_faces
        )

    @property
    def fits_badly(self) -> bool:
        """Whether the meshes hardly lie on one another, so that the carried motion should be looked at."""
        return float(np.median(self.distances)) > BADLY * self.similarity.scale * self._source.size

    @property
    def _source(self) -> Surface:
        return Surface(self.source_vertices, self.source_faces)


def correspond(
    source_vertices: npt.NDArray[np.floating],
    source_faces: npt.NDArray[np.integer],
    target_vertices: npt.NDArray[np.floating],
    target_faces: npt.NDArray[np.integer],
    *,
    landmarks: npt.NDArray[np.integer] | None = None,
) -> Correspondence:
    """Find the place on a source mesh of every vertex of a target mesh.

    Meshes with equal triangles correspond vertex by vertex. Others are laid onto one another by a similarity
    (:func:`facediff.retarget.placing.place`); the target is bent onto the source in rounds, ever less stiffly, after
    Amberg, Romdhani and Vetter, "Optimal step nonrigid ICP algorithms for surface registration", CVPR 2007, with
    displacements for unknowns; then each vertex takes the nearest point of the source's surface. A sheet that faces
    another way (the other lip) is avoided.

    Args:
        source_vertices: (Vs, 3) neutral face of what moves.
        source_faces: (Fs, 3).
        target_vertices: (Vt, 3) neutral face that shall move.
        target_faces: (Ft, 3).
        landmarks: (L, 2) pairs of a source and a target vertex that are the same place; three or more also begin the
            alignment, for meshes that show other parts of the head.

    Raises:
        FaceDiffError: if a mesh is broken, or a landmark names a vertex that is not there.
    """
    source = _checked("source mesh", source_vertices, source_faces)
    target = _checked("target mesh", target_vertices, target_faces)
    pairs = _checked_landmarks(landmarks, len(source.vertices), len(target.vertices))
    if source.vertices.shape == target.vertices.shape and np.array_equal(source.faces, target.faces):
        return _vertex_by_vertex(source, target)
    start = None
    if len(pairs) >= 3:
        start = align(target.vertices[pairs[:, 1]], source.vertices[pairs[:, 0]], scale=True)
    target = _same_side(target, source)
    back = place(target, source, start)
    laid = Surface(back.apply(target.vertices), target.faces)
    places = partners(source, laid)
    bent = _bent(source, laid, places, pairs)
    found = places.nearest(bent.vertices, bent.normals)
    away = np.linalg.norm(laid.vertices - found.points, axis=1) / source.size
    left = found.distances / source.size
    trust = np.clip((FAR - left) / (FAR - EXACT), 0.0, 1.0) * np.clip((found.cosines + 0.3) / 0.6, 0.0, 1.0)
    return Correspondence(
        corners=found.corners,
        weights=found.weights,
        similarity=back.inverse(),
        distances=away * source.size / back.scale,
        trust=np.where(trust > 0.99, 1.0, trust),
        share=np.clip((FAR - left) / (FAR - CLOSE), 0.0, 1.0),
        source_vertices=source.vertices,
        source_faces=source.faces,
        target_vertices=target.vertices,
        target_faces=np.ascontiguousarray(target_faces, np.int64),
    )


def _same_side(target: Surface, source: Surface) -> Surface:
    """The target, turned inside out where its triangles run the other way round."""
    if _volume(target) * _volume(source) < 0:
        return Surface(target.vertices, np.ascontiguousarray(target.faces[:, ::-1]))
    return target


def _volume(surface: Surface) -> float:
    """Six times the volume between a surface and its mean; negative where triangles run clockwise seen from outside."""
    a, b, c = (surface.vertices[surface.faces[:, k]] - surface.vertices.mean(axis=0) for k in range(3))
    return float((np.cross(a, b) * c).sum())


def _vertex_by_vertex(source: Surface, target: Surface) -> Correspondence:
    count = len(source.vertices)
    same = np.array_equal(source.vertices, target.vertices)
    similarity = (
        Similarity(np.eye(3), np.zeros(3)) if same else robust_align(source.vertices, target.vertices, scale=True)
    )
    ones = np.ones(count)
    return Correspondence(
        corners=np.repeat(np.arange(count)[:, None], 3, axis=1),
        weights=np.tile([1.0, 0.0, 0.0], (count, 1)),
        similarity=similarity,
        distances=np.linalg.norm(similarity.apply(source.vertices) - target.vertices, axis=1),
        trust=ones,
        share=ones.copy(),
        source_vertices=source.vertices,
        source_faces=source.faces,
        target_vertices=target.vertices,
        target_faces=target.faces,
    )


def _bent(source: Surface, laid: Surface, places: Partners, pairs: Indices) -> Surface:
    """The target, bent onto the source."""
    edges = edges_of(laid.faces)
    bent = laid
    for stiffness in STIFFNESSES:
        there = places.nearest(bent.vertices, bent.normals)
        trust = np.clip(2.0 * there.cosines - 0.5, 0.0, 1.0)
        trust *= np.clip((FAR - there.distances / source.size) / (FAR - CLOSE), 0.0, 1.0)
        pull = there.points - laid.vertices
        if len(pairs):
            pull[pairs[:, 1]] = source.vertices[pairs[:, 0]] - laid.vertices[pairs[:, 1]]
            trust[pairs[:, 1]] = LANDMARK_TRUST
        bent = Surface(laid.vertices + smooth_field(pull, trust, edges, stiffness), laid.faces)
    return bent


def _checked(name: str, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> Surface:
    points: Array = np.ascontiguousarray(vertices, np.float64)
    corners: Indices = np.ascontiguousarray(faces, np.int64)
    if points.ndim != 2 or points.shape[-1] != 3 or corners.ndim != 2 or corners.shape[-1] != 3:
        raise FaceDiffError(
            f"{name}: has vertices {points.shape} and faces {corners.shape}; expected (vertices, 3) and triangles"
        )
    if len(points) < 4 or len(corners) < 4 or not 0 <= corners.min() <= corners.max() < len(points):
        raise FaceDiffError(
            f"{name}: {len(points)} vertices and {len(corners)} triangles make no face; give a whole mesh"
        )
    if not np.isfinite(points).all():
        raise FaceDiffError(f"{name}: holds NaN or infinity; write it anew")
    return Surface(points, corners)


def _checked_landmarks(pairs: npt.NDArray[np.integer] | None, sources: int, targets: int) -> Indices:
    made: Indices = np.zeros((0, 2), np.int64) if pairs is None else np.asarray(pairs, np.int64).reshape(-1, 2)
    for column, (name, count) in enumerate((("source", sources), ("target", targets))):
        if len(made) and not 0 <= made[:, column].min() <= made[:, column].max() < count:
            raise FaceDiffError(
                f"landmarks: name {name} vertex {int(made[:, column].max())} of {count}; count vertices from 0"
            )
    return made
