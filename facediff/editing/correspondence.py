"""Where each vertex of one face mesh lies on another one, whatever its topology, unit and axes.

The steps stand in the order in which :func:`correspond` takes them: a similarity, partners of separate pieces, bending
the target onto the source, and nearest points of a surface, which all of them need.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, align, face_size, robust_align
from facediff.mesh.alignment import TUKEY
from facediff.mesh.flame import rotations
from facediff.mesh.mesh import check_coordinates, closest_on_triangles, triangle_areas

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LANDMARK_TRUST = 100.0
CLOSE, FAR = 0.1, 0.3
"""Distances, as shares of the face's size, from which on motion fades, and from which on a vertex stands still."""
EXACT = 0.005
"""Nearer than this share of the face's size, the place on the surface is trusted fully if the sheet is right."""
BADLY = 0.05  # A median distance above this share of the face's size is reported as a bad fit


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where each vertex of a target mesh lies on a source mesh."""

    corners: Indices  # (Vt, 3) vertices of the source's triangle
    weights: Array  # (Vt, 3) their barycentric weights, none negative, which sum to one
    similarity: Similarity  # from the source to the target, in the target's unit
    distances: Array  # (Vt,) between a target vertex and its place on the source after the similarity, target's unit
    trust: Array  # (Vt,) how well the place is known, 0 to 1; where little, neighbours are averaged
    share: Array  # (Vt,) how much of the motion is carried, 0 (too far away from anything) to 1
    source_vertices: Array  # (Vs, 3) the source mesh that this was made for
    source_faces: Indices  # (Fs, 3)
    target_vertices: Array  # (Vt, 3) the target mesh
    target_faces: Indices  # (Ft, 3)

    @property
    def fits_badly(self) -> bool:
        """Whether the meshes lie so far apart that the carried motion should be looked at."""
        size = Surface(self.source_vertices, self.source_faces).size
        return float(np.median(self.distances)) > BADLY * self.similarity.scale * size


def correspond(
    source_vertices: npt.NDArray[np.floating],
    source_faces: npt.NDArray[np.integer],
    target_vertices: npt.NDArray[np.floating],
    target_faces: npt.NDArray[np.integer],
    *,
    landmarks: npt.NDArray[np.integer] | None = None,
) -> Correspondence:
    """Find the place on a source mesh of every vertex of a target mesh.

    Meshes with equal triangles correspond vertex by vertex. Others are aligned by a similarity (:func:`place`); the
    target is bent onto the source in rounds, ever less stiffly, after Amberg, Romdhani and Vetter, "Optimal step
    nonrigid ICP algorithms for surface registration", CVPR 2007, with displacements for unknowns; then each vertex
    takes the nearest point of the source's surface. A sheet that faces another way (the other lip) is avoided.

    Args:
        source_vertices: (Vs, 3) neutral face of the animation.
        source_faces: (Fs, 3).
        target_vertices: (Vt, 3) neutral face that shall move.
        target_faces: (Ft, 3).
        landmarks: (L, 2) pairs of a source and a target vertex that are the same place; three or more also begin the
            alignment, for meshes that show other parts of the head.

    Raises:
        FaceDiffError: if a mesh is broken, or a landmark names a vertex that does not exist.

    Example:
        >>> vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> round(correspond(vertices, faces, 10 * vertices, faces).similarity.scale, 6)
        10.0
    """
    source = _checked("source mesh", source_vertices, source_faces)
    target = _checked("target mesh", target_vertices, target_faces)
    pairs: Indices = np.zeros((0, 2), np.int64) if landmarks is None else np.asarray(landmarks, np.int64).reshape(-1, 2)
    for column, (name, count) in enumerate((("source", len(source.vertices)), ("target", len(target.vertices)))):
        if len(pairs) and not 0 <= pairs[:, column].min() <= pairs[:, column].max() < count:
            raise FaceDiffError(
                f"landmarks: name {name} vertex {int(pairs[:, column].max())} of {count}; count vertices from 0"
            )
    if source.vertices.shape == target.vertices.shape and np.array_equal(source.faces, target.faces):
        return _vertex_by_vertex(source, target)
    if _volume(target) * _volume(source) < 0:  # triangles that run the other way round turn a mesh inside out
        target = Surface(target.vertices, np.ascontiguousarray(target.faces[:, ::-1]))
    start = None
    if len(pairs) >= 3:
        start = align(target.vertices[pairs[:, 1]], source.vertices[pairs[:, 0]], scale=True)
    back = place(target, source, start)
    laid = Surface(back.apply(target.vertices), target.faces)
    places = partners(source, laid)
    bent = _bent(source, laid, places, pairs)
    found = places.nearest(bent.vertices, bent.normals)
    # Bending decides which place belongs to a vertex. The distance of the meshes is measured before bending, and the
    # trust in a place by the distance that is left after it.
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
    check_coordinates(points, f"{name}:")
    if np.count_nonzero(triangle_areas(points, corners)) < 4:
        raise FaceDiffError(f"{name}: its {len(corners)} triangles have no area; give the mesh of a face")
    return Surface(points, corners)


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
    return Correspondence(
        corners=np.repeat(np.arange(count)[:, None], 3, axis=1),
        weights=np.tile([1.0, 0.0, 0.0], (count, 1)),
        similarity=similarity,
        distances=np.linalg.norm(similarity.apply(source.vertices) - target.vertices, axis=1),
        trust=np.ones(count),
        share=np.ones(count),
        source_vertices=source.vertices,
        source_faces=source.faces,
        target_vertices=target.vertices,
        target_faces=target.faces,
    )


ROUNDED = 1e-4  # Files round coordinates; two places nearer than this share of the mesh's extent are one


def refuse_other_mesh(
    name: str,
    vertices: npt.NDArray[np.floating],
    faces: npt.NDArray[np.integer],
    expected_vertices: npt.NDArray[np.floating],
    expected_faces: npt.NDArray[np.integer],
) -> None:
    """Require the triangles of the mesh that a correspondence was made for; vertices may have moved.

    Raises:
        FaceDiffError: calling the mesh ``name``, if it is another one, or has its vertices or triangles in another
            order.
    """
    if len(vertices) != len(expected_vertices):
        raise FaceDiffError(
            f"{name}: has {len(vertices)} vertices, and the correspondence was made for a mesh of "
            f"{len(expected_vertices)}; give that mesh, or make a new correspondence"
        )
    if np.array_equal(faces, expected_faces):
        return
    extent = float(np.ptp(expected_vertices, axis=0).max())
    # Rows in an order that does not depend on that of the vertices, rounding aside.
    both = (np.asarray(points, np.float64) for points in (vertices, expected_vertices))
    first, second = (rows[np.lexsort(np.rint(rows / (ROUNDED * extent)).T)] for rows in both)
    if np.abs(first - second).max() > 2 * ROUNDED * extent:
        raise FaceDiffError(
            f"{name}: has as many vertices as the correspondence's mesh and other triangles; give the mesh that it was "
            f"made for, or make a new correspondence"
        )
    moved = int(np.count_nonzero(np.abs(vertices - expected_vertices).max(axis=1) > 2 * ROUNDED * extent))
    if moved:
        raise FaceDiffError(
            f"{name}: {moved} of its {len(vertices)} vertices are where others were: they were reordered, as exporters "
            f"do; write the mesh with the order of its vertices kept, or make a new correspondence"
        )
    raise FaceDiffError(
        f"{name}: has its vertices where they were and other triangles; give the mesh that the correspondence was made "
        f"for, or make a new one"
    )


# Step 1: the similarity that aligns two meshes of unknown unit, axes and vertices.

SAMPLES = 400  # Vertices of each mesh by which starts are compared
FINE_SAMPLES = 1500  # Vertices of the moved mesh by which the alignment is refined
COARSE_ROUNDS, FINE_ROUNDS = 30, 60
TRIMMED = 0.8  # Share of the nearest pairs that counts, so that a neck or hair that one mesh lacks does not
CLEARLY = 0.9  # Another start than the meshes' own axes must fit better by this factor
SETTLED = 1e-10


def place(moved: Surface, goal: Surface, start: Similarity | None = None) -> Similarity:
    """The similarity that aligns one surface with another.

    Starts are the 24 rotations of one frame of axes into another and those of principal axes, with sizes made equal;
    the best by nearest vertices, both ways and trimmed, is refined by nearest points of the surface: Besl and McKay, "A
    method for registration of 3-D shapes", PAMI 1992, and Chen and Medioni, "Object modelling by registration of
    multiple range images", IVC 1992 (distances to planes).
    """
    random = np.random.default_rng(0)
    used = np.unique(moved.faces)
    used = used if len(used) <= FINE_SAMPLES else np.sort(random.choice(used, FINE_SAMPLES, replace=False))
    points, normals, found = moved.vertices[used], moved.normals[used], start or _start(moved, goal)
    for _ in range(FINE_ROUNDS):  # Gauss-Newton on the distances to the planes, with Tukey's biweight
        laid = found.apply(points)
        there = nearest(goal, laid, normals @ found.rotation.T, size=0.0)
        # The weights follow the spread of the distances, so that parts that one mesh lacks lose their influence as the
        # rest comes closer.
        spread = max(1.4826 * float(np.median(there.distances)), 1e-9 * goal.size)
        weights = np.square(np.clip(1.0 - np.square(there.distances / (TUKEY * spread)), 0.0, None))
        weights *= there.cosines > 0.5
        if np.count_nonzero(weights) < 20:
            break
        step = _towards_planes(laid, there.points, there.normals, weights, goal.size)
        found = found.then(step)
        if np.abs(step.apply(laid) - laid).max() < SETTLED * goal.size:
            break
    return found


def _start(moved: Surface, goal: Surface) -> Similarity:
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng(0)
    used = [(surface.vertices, np.unique(surface.faces)) for surface in (moved, goal)]
    source, target = (points[random.choice(some, min(SAMPLES, len(some)), replace=False)] for points, some in used)
    axes = [np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2] for points in (source, target)]
    principal = [axes[1].T @ np.diag(signs) @ axes[0] for signs in itertools.product((1.0, -1.0), repeat=3)]
    proper = [turn for turn in principal if np.linalg.det(turn) > 0]
    scale = face_size(target) / face_size(source)
    trials = []
    for rotation in (np.eye(3), *Rotation.create_group("O").as_matrix(), *proper):
        trial = Similarity(rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale)
        for _ in range(5):
            trial, apart = _by_vertices(source, target, trial)
        trials.append((apart, trial))
    # Five rounds are enough to tell good starts from bad ones; only the best one is continued.
    own, (least, best) = trials[0], min(trials, key=lambda pair: pair[0])
    # Faces are nearly symmetric, so that a mirrored start fits almost as well: the meshes' own axes win unless another
    # start is clearly better.
    found = best if least < CLEARLY * own[0] else own[1]
    for _ in range(COARSE_ROUNDS):
        found, _ = _by_vertices(source, target, found)
    return found


def _by_vertices(source: Array, target: Array, current: Similarity) -> tuple[Similarity, float]:
    """One round of nearest vertices, both ways; and how far apart the pairs were, as a share of the size."""
    from scipy.spatial.distance import cdist

    away = cdist(current.apply(source), target)
    to, back = away.argmin(axis=1), away.argmin(axis=0)
    pairs = np.concatenate([np.stack([np.arange(len(source)), to]), np.stack([back, np.arange(len(target))])], axis=1)
    apart = away[pairs[0], pairs[1]]
    counted = apart <= np.quantile(apart, TRIMMED)
    found = align(source[pairs[0]], target[pairs[1]], weights=counted.astype(np.float64), scale=True)
    return found, float(apart[counted].mean() / face_size(target))


def _towards_planes(points: Array, goals: Array, normals: Array, weights: Array, size: float) -> Similarity:
    """The small similarity with the least weighted squared distances to planes, to first order."""
    centre = points.mean(axis=0)
    arms = (points - centre) / size
    # The seven unknowns are rotation and growth about the centre, and translation.
    rows = np.concatenate([np.cross(arms, normals), normals, (arms * normals).sum(axis=1, keepdims=True)], axis=1)
    left = ((goals - points) * normals).sum(axis=1) / size
    weighted = rows * weights[:, None]
    # Planes leave some directions undetermined (the rotation of a sphere): least squares does not move along them.
    turn, shift, growth = np.split(np.linalg.lstsq(weighted.T @ rows, weighted.T @ left, rcond=1e-9)[0], [3, 6])
    rotation = rotations(turn[None])[0]
    scale = float(np.exp(np.clip(growth[0], -0.5, 0.5)))
    return Similarity(rotation, centre + size * shift - scale * rotation @ centre, scale)


# Step 2: separate pieces of a mesh (teeth, eyes, skin), and which piece of the other mesh each one is.

MOST = 32  # So many of the largest pieces are paired; hair may consist of thousands
ALIKE = 1.5  # Two pieces differ in size by no more than this factor
NEAR = 1.0  # Partners' centres lie no further apart than this share of the smaller one's size
WELD = 1e-6  # Vertices nearer than this share of the mesh's size are one: seams of textures do not part a mesh


@dataclass(frozen=True, eq=False)
class Partners:
    """Where to search for the nearest points of each target vertex."""

    parts: list[tuple[Indices, Surface]]  # vertices of the target, together all, and the part of the source they lie on
    size: float  # of the whole source

    def nearest(self, points: Array, normals: Array) -> Nearest:
        """The nearest point of each target vertex (Vt, 3) on its part of the source."""
        found = [nearest(surface, points[some], normals[some], self.size) for some, surface in self.parts]
        order = np.argsort(np.concatenate([some for some, _ in self.parts]))
        names = (field.name for field in fields(Nearest))
        return Nearest(**{name: np.concatenate([getattr(part, name) for part in found])[order] for name in names})


def partners(source: Surface, laid: Surface) -> Partners:
    """Pair the pieces of a target that is aligned with a source with the source's.

    Partners are about as large and lie about in one place; of all pairings, the one with the least sum of distances
    counts, so that lower teeth are not taken for upper ones. What has no partner is searched for on all of the source.
    """
    from scipy.optimize import linear_sum_assignment

    labels = [pieces(surface) for surface in (source, laid)]
    (centres, sizes, kept), (goals, extents, others) = (
        _measured(surface, label) for surface, label in zip((source, laid), labels, strict=True)
    )
    away = np.linalg.norm(goals[:, None] - centres[None], axis=2)
    alike = np.abs(np.log(extents[:, None] / sizes[None])) < np.log(ALIKE)
    limit = NEAR * np.minimum(extents[:, None], sizes[None])
    # Every piece may also stay without a partner, which costs as much as a partner at the limit.
    cost = np.concatenate([np.where(alike & (away < limit), away / limit, 1e6), np.ones((len(goals),) * 2)], axis=1)
    parts, left = [], np.ones(len(laid.vertices), bool)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        if column < len(kept):
            some = np.flatnonzero(labels[1] == others[row])
            parts.append((some, Surface(source.vertices, source.faces[labels[0][source.faces[:, 0]] == kept[column]])))
            left[some] = False
    if left.any():
        parts.append((np.flatnonzero(left), source))
    return Partners(parts, source.size)


def pieces(surface: Surface) -> Indices:
    """A label (V,) for each vertex, equal for those that triangles join or that lie in one place."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    extent = max(float(np.ptp(surface.vertices, axis=0).max()), np.finfo(float).tiny)
    _, welded = np.unique(np.rint(surface.vertices / (WELD * extent)), axis=0, return_inverse=True)
    welded = welded.reshape(-1)  # NumPy 2.0 returns it with a second axis
    edges, count = welded[edges_of(surface.faces)], int(welded.max()) + 1
    joined = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], np.int64)[welded]


def _measured(surface: Surface, labels: Indices) -> tuple[Array, Array, Indices]:
    """Centres (P, 3), sizes (P,) and labels (P,) of the largest pieces that triangles make."""
    names, counts = np.unique(labels[surface.faces[:, 0]], return_counts=True)
    names = names[np.argsort(-counts, kind="stable")[:MOST]]
    points = [surface.vertices[np.unique(surface.faces[labels[surface.faces[:, 0]] == name])] for name in names]
    centres = np.stack([part.mean(axis=0) for part in points])
    sizes = np.array([max(face_size(part), np.finfo(float).tiny) for part in points])
    return centres, sizes, names


# Step 3: bending the target onto the source. trimesh's `nricp_amberg` does the same with an affine map for every
# vertex; on the meshes of the tests it is as exact where both topologies are even, but fails on a decimated one.

STIFFNESSES = (100.0, 30.0, 10.0, 10.0, 3.0, 3.0, 1.0, 1.0, 0.3, 0.3)
"""How stiff the target is held while it is bent onto the source, from round to round."""


def _bent(source: Surface, laid: Surface, places: Partners, pairs: Indices) -> Surface:
    """The target, bent onto the source."""
    edges = edges_of(laid.faces)
    bent = laid
    for stiffness in STIFFNESSES:
        # Nearest points of a mesh that is still far away are often wrong: they count less the less the surfaces face
        # the same way, and a stiff target follows them only on average.
        there = places.nearest(bent.vertices, bent.normals)
        trust = np.clip(2.0 * there.cosines - 0.5, 0.0, 1.0)
        trust *= np.clip((FAR - there.distances / source.size) / (FAR - CLOSE), 0.0, 1.0)
        pull = there.points - laid.vertices
        if len(pairs):
            pull[pairs[:, 1]] = source.vertices[pairs[:, 0]] - laid.vertices[pairs[:, 1]]
            trust[pairs[:, 1]] = LANDMARK_TRUST
        bent = Surface(laid.vertices + smooth_field(pull, trust, edges, stiffness), laid.faces)
    return bent


def edges_of(faces: Indices) -> Indices:
    """Edges (E, 2), each once."""
    both = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.unique(np.sort(both, axis=1), axis=0)
    return both[both[:, 0] != both[:, 1]]


def smooth_field(values: Array, trust: Array, edges: Indices, stiffness: float) -> Array:
    """The field (V, 3) with the least Σ trust (x − value)² + stiffness · Σ_edges (x_a − x_b)².

    Values (V, 3) are known as well as their trust (V,) says; the field is zero on pieces where nothing is known.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.csgraph import laplacian
    from scipy.sparse.linalg import splu

    # The small number keeps the matrix positive definite on pieces of the mesh where nothing is known.
    matrix = diags_array(trust + 1e-9) + stiffness * laplacian(_adjacency(edges, len(trust)))
    factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factors.solve(trust[:, None] * values))


def averaging(trust: Array, faces: Indices) -> csr_array | None:
    """The sparse (V, V) matrix of (1 − trust) times the mean of neighbours; None if all vertices are trusted."""
    from scipy.sparse import diags_array

    if (trust >= 1).all():
        return None
    near = _adjacency(edges_of(faces), len(trust))
    matrix = (diags_array((1.0 - trust) / np.maximum(near.sum(axis=1), 1.0)) @ near).tocsr()
    matrix.eliminate_zeros()
    return matrix


def _adjacency(edges: Indices, count: int) -> csr_array:
    """The symmetric (V, V) matrix that is 1 for every edge."""
    from scipy.sparse import csr_array

    both = np.concatenate([edges, edges[:, ::-1]])
    return csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))


# Step 4: the nearest points of a surface, among the sheets that face the same way.

SLACK = 0.04
"""A sheet that faces the same way is preferred to one that faces away and is nearer by up to this share of the face's
size: lips that touch are two sheets in one place."""
FACING, AWAY = 0.3, -0.3
"""Cosines between normals from which on two sheets face the same way, and up to which they face away."""
TIE = 1e-6
"""Of two places whose distances differ by less than this share of a triangle, the one that faces the same way wins."""
CHUNK_NUMBERS = 4_000_000  # Candidate pairs of a point and a triangle that are held in memory at a time, at most


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh (V, 3), (F, 3) whose nearest points can be searched for."""

    vertices: Array
    faces: Indices

    @cached_property
    def normals(self) -> Array:
        """(V, 3) unit normals of the vertices; zero where no triangle touches."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def size(self) -> float:
        """Size of the part that triangles touch."""
        return face_size(self.vertices[np.unique(self.faces)])

    @cached_property
    def triangles(self) -> Array:
        """(F, 3, 3) corners."""
        return self.vertices[self.faces]

    @cached_property
    def balls(self) -> tuple[Array, Array, list[tuple[Indices, cKDTree]]]:
        """Centres (F, 3) and radii (F,) of balls around the triangles; and trees of those about equally large.

        A tree finds the balls that may hold a nearest point by the largest radius in it, so that a few large triangles
        among many small ones (the back of a head) need a tree of their own.
        """
        from scipy.spatial import cKDTree

        centres = self.triangles.mean(axis=1)
        radii = np.linalg.norm(self.triangles - centres[:, None], axis=2).max(axis=1)
        most = max(float(radii.max()), np.finfo(float).tiny)
        octave = np.floor(np.log2(np.maximum(radii / most, 2.0**-10)))
        groups = [np.flatnonzero(octave == one) for one in np.unique(octave)]
        return centres, radii, [(faces, cKDTree(centres[faces])) for faces in groups]


@dataclass(frozen=True, eq=False)
class Nearest:
    """N points of a surface, each the nearest one to a given point."""

    corners: Indices  # (N, 3) vertices of its triangle
    weights: Array  # (N, 3) barycentric weights of the corners, none negative, which sum to one
    points: Array  # (N, 3) where it lies
    normals: Array  # (N, 3) unit normals of the surface there
    distances: Array  # (N,) from the given point
    cosines: Array  # (N,) between the surface's normal and that of the given point


def vertex_normals(vertices: Array, faces: Indices) -> Array:
    """Unit normals (V, 3), each the mean of its triangles' weighted by the angles at the vertex.

    Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", Journal of Graphics Tools 1998: unlike
    weights by area, these do not depend on how a flat piece is cut into triangles.
    """
    from trimesh import Trimesh

    return np.asarray(Trimesh(vertices, faces, process=False).vertex_normals, np.float64)


def nearest(surface: Surface, points: Array, normals: Array, size: float | None = None) -> Nearest:
    """The nearest point of a surface to each point (N, 3), where normals decide between sheets.

    Every triangle that could hold it is looked at, so that the point found is the nearest of all of its sheet. Normals
    (N, 3) are zero where a point has none. The slack between sheets is relative to ``size``, that of the surface if
    None; at 0, the nearest point counts, whatever its normal.
    """
    slack = SLACK * (surface.size if size is None else size)
    faces, weights, cosines = _best(surface, points, normals, 0.0)
    # A nearest place that faces the same way stays the best one with slack, which only costs places that do not.
    doubtful = np.flatnonzero(cosines < FACING)
    if slack and len(doubtful):
        faces[doubtful], weights[doubtful], cosines[doubtful] = _best(
            surface, points[doubtful], normals[doubtful], slack
        )
    corners = surface.faces[faces]
    where = np.einsum("nc,ncd->nd", weights, surface.vertices[corners])
    there = _unit(np.einsum("nc,ncd->nd", weights, surface.normals[corners]))
    return Nearest(corners, weights, where, there, np.linalg.norm(points - where, axis=1), cosines)


def _best(surface: Surface, points: Array, normals: Array, slack: float) -> tuple[Indices, Array, Array]:
    """Face (N,), weights (N, 3) and cosine (N,) of the best place; a sheet that faces away must be nearer by slack."""
    faces, weights, cosines = np.empty(len(points), np.int64), np.empty((len(points), 3)), np.empty(len(points))
    step = max(1, CHUNK_NUMBERS // len(surface.faces))
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        point, face = _candidates(surface, points[some], slack)
        shares, square = closest_on_triangles(points[some][point], surface.triangles[face])
        there = _unit(np.einsum("nc,ncd->nd", shares, surface.normals[surface.faces[face]]))
        cosine = np.einsum("nd,nd->n", there, normals[some][point])
        wrong = np.clip((FACING - cosine) / (FACING - AWAY), 0.0, 1.0)
        # The distance decides; a sheet that faces away costs the slack, and between equal distances the normal decides.
        cost = np.sqrt(square) + slack * wrong + TIE * surface.balls[1][face] * (1.0 - cosine)
        order = np.lexsort((face, cost, point))
        best = order[np.unique(point[order], return_index=True)[1]]
        faces[some], weights[some], cosines[some] = face[best], shares[best], cosine[best]
    return faces, weights, cosines


def _candidates(surface: Surface, points: Array, slack: float) -> tuple[Indices, Indices]:
    """Pairs (point, face): all triangles that may hold a place not further away than the nearest one and the slack."""
    centres, radii, trees = surface.balls
    rounding = 1e-6 * float(radii.max() + np.abs(centres).max())
    # A centre is on the surface, so the surface is no further away; a triangle is no nearer than its ball.
    limit = np.min([tree.query(points)[0] for _, tree in trees], axis=0) + slack + rounding
    found = []
    for faces, tree in trees:
        near = tree.query_ball_point(points, limit + radii[faces].max())
        point = np.repeat(np.arange(len(points)), [len(some) for some in near])
        face = faces[np.fromiter(itertools.chain.from_iterable(near), np.int64)]
        kept = np.linalg.norm(points[point] - centres[face], axis=1) - radii[face] <= limit[point]
        found.append((point[kept], face[kept]))
    point, face = (np.concatenate(part) for part in zip(*found, strict=True))
    return point, face


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))
