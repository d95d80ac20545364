"""Correspondence of two face meshes of different topology, unit and axes.

The steps stand in the order of :func:`correspond`: a similarity, pairs of separate pieces, bending the target onto the
source, and nearest points of a surface, which all of them need.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from facediff.editing.detached_parts import detached_parts, lash_pieces
from facediff.editing.face_features import OPPOSITE, Features, find_features
from facediff.editing.landmarks import Landmarks
from facediff.editing.lid_transfer import EyeLids, eye_lids, eyeball_triangles
from facediff.editing.placing import place, place_face
from facediff.editing.surface import Nearest, Surface, components, edges_of, nearest
from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, align, face_size, robust_align
from facediff.mesh.mesh import check_coordinates, triangle_areas
from facediff.utils.numerics import Array, Floats, Indices, Integers

if TYPE_CHECKING:
    from scipy.sparse import csr_array


# As much as the stiffest round: with less, the first rounds would pull the target away from its landmarks.
LANDMARK_TRUST = 100.0
CLOSE, FAR = 0.1, 0.3
"""Distances, as shares of the face's size, from which on motion fades, and from which on a vertex stands still."""
EXACT = 0.005
"""Nearer than this share of the face's size, the place on the surface is trusted fully if the sheet is right."""
BADLY = 0.05  # A median distance above this share of the face's size is reported as a bad fit
ABOUT_EYE = 0.8, 0.45
"""Lashes and tear lines reach so many widths of the eye from its middle, aside and upwards: brows begin higher."""
LIDS_AS_ALL, LIDS_FITTED, LIDS_AT_REST = 0, 1, 2
"""What lids do: move as everything else, as on two cuts of one surface; move by their own opening; or stay at rest."""

NO_INDICES: Indices = np.zeros(0, np.int64)
NO_CORNERS: Indices = np.zeros((0, 3), np.int64)
NO_WEIGHTS: Array = np.zeros((0, 3))


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
    # Numbers of the target's triangles that the face is not searched for in
    hidden: Indices = field(default_factory=NO_INDICES.copy)
    # (A,) vertices of the target that move with its skin, as brows, lashes and a beard do; the skin's vertices there
    followers: Indices = field(default_factory=NO_INDICES.copy)
    follower_corners: Indices = field(default_factory=NO_CORNERS.copy)  # (A, 3)
    follower_weights: Array = field(default_factory=NO_WEIGHTS.copy)  # (A, 3) their barycentric weights
    lids: int = 0  # LIDS_AS_ALL, LIDS_FITTED or LIDS_AT_REST

    @cached_property
    def laid(self) -> Surface:
        """The target mesh in the source's place, with the triangles that the face is searched for in."""
        faces = np.delete(self.target_faces, self.hidden, axis=0)
        return Surface(self.similarity.inverse().apply(self.target_vertices), faces)

    @cached_property
    def features(self) -> tuple[Features | None, Features | None]:
        """Features of the source, and of the target in the source's place."""
        source = find_features(self.source_vertices, self.source_faces)
        return source, None if source is None else find_features(self.laid.vertices, self.laid.faces, source)

    @cached_property
    def eye_lids(self) -> list[EyeLids] | None:
        """How the lids of both eyes are carried; None if they move as everything else."""
        source, target = self.features
        if self.lids == LIDS_AS_ALL or source is None or target is None:
            return None
        laid = Surface(self.laid.vertices, self.target_faces)
        source_surface = Surface(self.source_vertices, self.source_faces)
        return eye_lids(source_surface, laid, (source, target), at_rest=self.lids == LIDS_AT_REST)

    @cached_property
    def beside_lids(self) -> Indices:
        """Vertices of lashes and tear lines: of pieces about an eye that are neither skin nor an eyeball."""
        source, target = self.features
        if source is None or target is None:
            return NO_INDICES
        face = Surface(self.source_vertices, self.source_faces)
        balls = [eyeball_triangles(face, source, eye) for eye in (0, 1)]
        is_ball = np.isin(self.corners[:, 0], self.source_faces[np.concatenate(balls)])
        vertices, label = self.laid.vertices, pieces(self.laid)
        beside = np.zeros(len(vertices), bool)
        for eye in source.eyes:
            if eye is not None:
                away = np.abs(vertices - eye.centre)[:, :2] / eye.width
                beside |= (away < ABOUT_EYE).all(axis=1)
        outside = np.unique(label[~beside | target.skin | is_ball])
        return np.flatnonzero(~np.isin(label, outside))

    @property
    def fits_badly(self) -> bool:
        """Whether the meshes lie so far apart that the carried motion should be looked at."""
        size = Surface(self.source_vertices, self.source_faces).size
        return float(np.median(self.distances)) > BADLY * self.similarity.scale * size


def correspond(
    source_vertices: Floats,
    source_faces: Integers,
    target_vertices: Floats,
    target_faces: Integers,
    *,
    landmarks: Landmarks | Integers | None = None,
    face_triangles: Integers | None = None,
) -> Correspondence:
    """Find the place on a source mesh of every vertex of a target mesh.

    Meshes with equal triangles correspond vertex by vertex. Others are aligned by a similarity (:func:`place`); the
    target is bent onto the source in rounds, ever less stiffly, after Amberg, Romdhani and Vetter, "Optimal step
    nonrigid ICP algorithms for surface registration", CVPR 2007, with displacements for unknowns; then each vertex
    takes the nearest point of the source's surface. A sheet that faces another way (the other lip) is avoided.

    Args:
        source_vertices: (Vs, 3) neutral face of the animation.
        source_faces: (Fs, 3) its triangles.
        target_vertices: (Vt, 3) neutral face that shall move.
        target_faces: (Ft, 3) its triangles.
        landmarks: pairs of equal points, or (L, 2) pairs of a source and a target vertex; three or more also begin the
            alignment, for meshes that show other parts of the head.
        face_triangles: numbers of the target's triangles in which to search for the face; all if None. Teeth and a
            tongue among the others follow the jaw, and the rest of them stands still.

    Example:
        >>> vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3.0]])
        >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        >>> round(correspond(vertices, faces, 10 * vertices, faces).similarity.scale, 6)
        10.0
    """
    source = _checked("source mesh", source_vertices, source_faces)
    target = _checked("target mesh", target_vertices, target_faces)
    marks = landmarks if isinstance(landmarks, Landmarks) or landmarks is None else Landmarks.of_vertices(landmarks)
    if marks is not None:
        marks.check(len(source.vertices), len(target.vertices))
    if source.vertices.shape == target.vertices.shape and np.array_equal(source.faces, target.faces):
        return _vertex_by_vertex(source, target)
    target = run_alike(source, target)
    searched = np.arange(len(target.faces)) if face_triangles is None else np.asarray(face_triangles, np.int64)
    face = Surface(target.vertices, target.faces[searched])
    back, features, target_features = placed(source, face, marks)
    feature_pair = bending = None if features is None or target_features is None else (features, target_features)
    laid = Surface(back.apply(target.vertices), target.faces)
    if bending is not None and _one_surface(source, Surface(laid.vertices, face.faces)):
        bending = None  # what lies on the other mesh already need not be bent, and is exact to rounding
    pairs = part_pairs(source, laid, bending)
    bent = _bent(source, laid, pairs, marks, bending)
    nearest_points = pairs.nearest(bent.vertices, bent.normals)
    # Bending decides which place belongs to a vertex. The distance of the meshes is measured before bending, and the
    # trust in a place by the distance that is left after it.
    away = np.linalg.norm(laid.vertices - nearest_points.points, axis=1) / source.size
    left = nearest_points.distances / source.size
    # Thin parts such as lips have a sheet on either side. A point with a normal turned by more than 107 degrees (a
    # cosine of -0.3) is not trusted at all, with less than 73 degrees fully.
    trust = np.clip((FAR - left) / (FAR - EXACT), 0.0, 1.0) * np.clip((nearest_points.cosines + 0.3) / 0.6, 0.0, 1.0)
    share = np.clip((FAR - left) / (FAR - CLOSE), 0.0, 1.0)
    corners, weights = nearest_points.corners, nearest_points.weights
    if bending is not None:
        # Which side of an opening a vertex belongs to is known there: no neighbour on the other side is asked.
        sided = (bending[1].codes > 0) & (left < FAR)
        trust[sided] = np.maximum(trust[sided], 1.0 - left[sided] / FAR)
    followers: tuple[Indices, Indices, Array] = NO_INDICES, NO_CORNERS, NO_WEIGHTS
    if feature_pair is not None:
        detached = detached_parts(source, laid, *feature_pair, pairs.unpaired)
        jaw, still, followers = detached.jaw, detached.still, detached.followers
        corners[jaw], weights[jaw], share[jaw] = detached.jaw_point.corners[0], detached.jaw_point.weights[0], 1.0
        share[still], trust[jaw], trust[still] = 0.0, 1.0, 1.0
    elif face_triangles is not None:
        unsearched = np.setdiff1d(np.arange(len(target.vertices)), face.faces)
        share[unsearched], trust[unsearched] = 0.0, 1.0
    return Correspondence(
        corners=corners,
        weights=weights,
        similarity=back.inverse(),
        distances=away * source.size / back.scale,
        trust=np.where(trust > 0.99, 1.0, trust),
        share=share,
        source_vertices=source.vertices,
        source_faces=source.faces,
        target_vertices=target.vertices,
        target_faces=np.ascontiguousarray(target_faces, np.int64),
        hidden=np.setdiff1d(np.arange(len(target.faces)), searched),
        followers=followers[0],
        follower_corners=followers[1],
        follower_weights=followers[2],
        lids=LIDS_FITTED if bending is not None else LIDS_AS_ALL,
    )


def placed(
    source: Surface, target: Surface, marks: Landmarks | None = None
) -> tuple[Similarity, Features | None, Features | None]:
    """The similarity that lays a target onto a source, and the features of the source and of the target there.

    Three landmarks or more begin the alignment.
    """
    start = None
    if marks is not None and len(marks) >= 3:
        start = align(marks.target.points(target.vertices), marks.source.points(source.vertices), scale=True)
    features = find_features(source.vertices, source.faces)
    if features is None:
        return place(target, source, start), None, None
    back, target_features = place_face(target, source, features, start)
    return back, features, target_features


def _checked(name: str, vertices: Floats, faces: Integers) -> Surface:
    points: Array = np.ascontiguousarray(vertices, np.float64)
    corners: Indices = np.ascontiguousarray(faces, np.int64)
    check_coordinates(points, f"{name}:")
    fits = len(points) and len(corners) and 0 <= corners.min() <= corners.max() < len(points)
    if not fits or np.count_nonzero(triangle_areas(points, corners)) < 4:
        raise FaceDiffError(
            f"{name}: {len(points)} vertices and {len(corners)} triangles make no face; give a whole mesh"
        )
    return Surface(points, corners)


SAME = 1e-4  # Half of the vertices nearer than this share of the face's size make two meshes one surface


def _one_surface(source: Surface, laid: Surface) -> bool:
    """Whether two meshes that are aligned are cuts of one surface into other triangles."""
    vertices = np.unique(laid.faces)
    some = vertices if len(vertices) <= 500 else np.random.default_rng(0).choice(vertices, 500, replace=False)
    points_nearby = nearest(source, laid.vertices[some], laid.normals[some], 0.0)
    return bool(np.median(points_nearby.distances) < SAME * source.size)


def run_alike(source: Surface, target: Surface) -> Surface:
    """The target with triangles that run round the same way as the source's; others turn a mesh inside out."""
    if _volume(target) * _volume(source) >= 0:
        return target
    return Surface(target.vertices, np.ascontiguousarray(target.faces[:, ::-1]))


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


def refuse_other_mesh(
    name: str, vertices: Floats, faces: Integers, expected_vertices: Floats, expected_faces: Integers
) -> None:
    """Require the triangles of the mesh that a correspondence was made for; vertices may have moved."""
    if len(vertices) != len(expected_vertices) or not np.array_equal(faces, expected_faces):
        raise FaceDiffError(
            f"{name}: has {len(vertices)} vertices and other triangles than the correspondence's mesh of "
            f"{len(expected_vertices)}, as where an exporter reordered them; give the mesh that it was made for with "
            f"the order of its vertices kept, or make a new correspondence"
        )


OTHER_FACE = 1e-3
"""Half of another face's vertices lie further off than this share of its extent; a sculpted nose moves fewer."""


def refuse_other_face(name: str, vertices: Floats, expected_vertices: Floats) -> None:
    """Require the rest positions of a correspondence, except for sculpted details."""
    away = float(np.median(np.linalg.norm(vertices - expected_vertices, axis=1)))
    if away > OTHER_FACE * float(np.ptp(expected_vertices, axis=0).max()):
        raise FaceDiffError(
            f"{name}: has the triangles of the correspondence's mesh and is another face (its vertices lie {away:.2g} "
            f"off in the median); give the mesh that it was made for, or make a new correspondence"
        )


# Step 2: separate pieces of a mesh (teeth, eyes, skin), and which piece of the other mesh each one is.

MOST = 32  # So many of the largest pieces are paired; hair may consist of thousands
ALIKE = 1.5  # Two pieces differ in size by no more than this factor
NEAR = 1.0  # PartPairs' centres lie no further apart than this share of the smaller one's size
WELD = 1e-6  # Vertices nearer than this share of the mesh's size are one: seams of textures do not part a mesh


@dataclass(frozen=True, eq=False)
class PartPairs:
    """Where to search for the nearest points of each target vertex."""

    parts: list[tuple[Indices, Surface]]  # vertices of the target, together all, and the part of the source they lie on
    size: float  # of the whole source
    unpaired: list[Indices]  # vertices of each of the target's pieces that has no partner

    def nearest(self, points: Array, normals: Array) -> Nearest:
        """The nearest point of each target vertex (Vt, 3) on its part of the source."""
        by_part = [nearest(surface, points[some], normals[some], self.size) for some, surface in self.parts]
        order = np.argsort(np.concatenate([some for some, _ in self.parts]))
        # Parts list the target's vertices in their own order; sorting restores the order of the mesh.
        names = (entry.name for entry in fields(Nearest))
        return Nearest(**{name: np.concatenate([getattr(part, name) for part in by_part])[order] for name in names})


def part_pairs(source: Surface, laid: Surface, features: tuple[Features, Features] | None = None) -> PartPairs:
    """Pair the pieces of a target that is aligned with a source with the source's.

    PartPairs are about as large and lie about in one place; of all pairings, the one with the least sum of distances
    counts, so that lower teeth are not taken for upper ones. Where the features of both are known, their skins are
    partners, and vertices on one side of an opening are not searched for on the other. Pieces without a partner are
    searched for on all of the source, or on its skin.
    """
    from scipy.optimize import linear_sum_assignment

    labels = [pieces(surface) for surface in (source, laid)]
    (centres, sizes, source_labels), (goals, extents, target_labels) = (
        _measured(surface, label) for surface, label in zip((source, laid), labels, strict=True)
    )
    away = np.linalg.norm(goals[:, None] - centres[None], axis=2)
    alike = np.abs(np.log(extents[:, None] / sizes[None])) < np.log(ALIKE)
    limit = NEAR * np.minimum(extents[:, None], sizes[None])
    # A pair that is out of the question costs far more than staying without a partner, which costs 1.
    cost = np.where(alike & (away < limit), away / limit, 1e6)
    rest = source
    if features is not None:
        is_skin = [
            np.isin(names, label[pieces_of_target.skin])
            for names, label, pieces_of_target in zip((source_labels, target_labels), labels, features, strict=True)
        ]
        cost[is_skin[1]] = 1e6
        cost[:, is_skin[0]] = 1e6
        # Lashes go with the lids that they grow from, which are not the partner's.
        pieces_of_target = [np.flatnonzero(labels[1] == name) for name in target_labels]
        cost[lash_pieces(laid.vertices, pieces_of_target, features[1])] = 1e6
        rest = Surface(source.vertices, source.faces[features[0].skin[source.faces[:, 0]]])
    # Every piece may also stay without a partner, which costs as much as a partner at the limit.
    cost = np.concatenate([cost, np.ones((len(goals),) * 2)], axis=1)
    parts, left = [], np.ones(len(laid.vertices), bool)
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        some = np.flatnonzero(labels[1] == target_labels[row])
        if column < len(source_labels):
            parts.append(
                (some, Surface(source.vertices, source.faces[labels[0][source.faces[:, 0]] == source_labels[column]]))
            )
            left[some] = False
    unpaired = np.flatnonzero(left)
    unpaired = unpaired[np.argsort(labels[1][unpaired], kind="stable")]
    cuts = np.flatnonzero(np.diff(labels[1][unpaired])) + 1
    if features is not None:
        codes, sides = features[1].codes, features[0].codes[rest.faces]
        for code in np.unique(codes[left & (codes > 0)]):
            some = np.flatnonzero(left & (codes == code))
            faces = rest.faces[(sides != OPPOSITE[code]).all(axis=1)]
            parts.append((some, Surface(source.vertices, faces)))
            left[some] = False
    if left.any():
        parts.append((np.flatnonzero(left), rest))
    return PartPairs(parts, source.size, np.split(unpaired, cuts))


def pieces(surface: Surface) -> Indices:
    """A label (V,) for each vertex, equal for those that triangles join or that lie in one place."""
    extent = max(float(np.ptp(surface.vertices, axis=0).max()), np.finfo(float).tiny)
    _, welded = np.unique(np.rint(surface.vertices / (WELD * extent)), axis=0, return_inverse=True)
    welded = welded.reshape(-1)  # NumPy 2.0 returns it with a second axis
    return components(welded[edges_of(surface.faces)], int(welded.max()) + 1)[welded]


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


RIM_TRUST = 30.0  # Vertices along an opening are held to the other mesh's opening
KNOWN_TO = 0.04  # How exactly an opening's sides are known, as a share of its width
RIM = 0.06  # So near to an opening, as a share of its width, its side is held
WARP = 0.5, 1.2
"""Widths of an opening over which the first bending is averaged, and over which it fades."""


def _bent(
    source: Surface,
    laid: Surface,
    pairs: PartPairs,
    marks: Landmarks | None,
    features: tuple[Features, Features] | None,
) -> Surface:
    """The target, bent onto the source."""
    edges = edges_of(laid.faces)
    base = laid if features is None else Surface(laid.vertices + _warp(laid.vertices, *features), laid.faces)
    rim, rim_pull = (NO_INDICES, NO_WEIGHTS) if features is None else _rims(base.vertices, laid, *features)
    anchors, anchor_pull, anchor_trust = _held(source, base, marks)
    bent = base
    for stiffness in STIFFNESSES:
        # Nearest points of a mesh that is still far away are often wrong: they count less the less the surfaces face
        # the same way, and a stiff target follows them only on average.
        matches = pairs.nearest(bent.vertices, bent.normals)
        trust = np.clip(2.0 * matches.cosines - 0.5, 0.0, 1.0)
        trust *= np.clip((FAR - matches.distances / source.size) / (FAR - CLOSE), 0.0, 1.0)
        pull = matches.points - base.vertices
        pull[rim], trust[rim] = rim_pull, RIM_TRUST
        pull[anchors], trust[anchors] = anchor_pull, anchor_trust
        bent = Surface(base.vertices + smooth_field(pull, trust, edges, stiffness), laid.faces)
    return bent


def _held(source: Surface, base: Surface, marks: Landmarks | None) -> tuple[Indices, Array, Array]:
    """Vertices of the target that landmarks hold, displacements (N, 3) that lay these on the source's, and trust (N,).

    A landmark within a triangle moves all of its corners as it shall move itself, each as firmly as it weighs.
    """
    if marks is None:
        return NO_INDICES, NO_WEIGHTS, np.zeros(0)
    steps = marks.source.points(source.vertices) - marks.target.points(base.vertices)
    weights = marks.target.weights
    anchors, place_in = np.unique(marks.target.corners, return_inverse=True)
    place_in = place_in.reshape(weights.shape)  # NumPy 2.0 returns it with one axis or two
    total, pull = np.zeros(len(anchors)), np.zeros((len(anchors), 3))
    np.add.at(total, place_in, weights)
    np.add.at(pull, place_in, weights[:, :, None] * steps[:, None])
    some = total > 1e-9
    return anchors[some], pull[some] / total[some, None], LANDMARK_TRUST * np.minimum(total[some], 1.0)


def _sides(features: tuple[Features, Features]) -> list[tuple[int, Array, Array, Indices, float]]:
    """Per side of an opening of both: code, where the target's curve belongs, the curve, vertices along it, width."""
    sides = []
    for index, (one, two) in enumerate(zip(features[0].openings, features[1].openings, strict=True)):
        if one is None or two is None:
            continue
        for side, goal, curve, seeds in (
            (1, one.upper, two.upper, two.upper_seeds),
            (2, one.lower, two.lower, two.lower_seeds),
        ):
            # Curves are known to a pixel or two: what lies nearer is left to the nearest points.
            apart = np.linalg.norm(goal - curve, axis=1, keepdims=True)
            step = (goal - curve) * np.clip(1.0 - KNOWN_TO * two.width / np.maximum(apart, 1e-12), 0.0, None)
            sides.append((2 * index + side, curve + step, curve, seeds, two.width))
    return sides


def _warp(points: Array, features: Features, target_features: Features) -> Array:
    """Displacements (V, 3) that bring the target's openings onto the source's, and fade away from them."""
    sides = _sides((features, target_features))
    total, weight, reach = np.zeros_like(points), np.zeros(len(points)), np.zeros(len(points))
    for code, goal, curve, _, width in sides:
        allowed = target_features.codes != OPPOSITE[code]
        # Every second sample is enough: the Gaussians are eight times as wide as the gaps between these samples.
        square = np.square(points[allowed, None] - curve[None, ::2]).sum(axis=2)
        near = np.exp(-square / (WARP[0] * width) ** 2)
        total[allowed] += near @ (goal - curve)[::2]
        weight[allowed] += near.sum(axis=1)
        reach[allowed] = np.maximum(reach[allowed], np.exp(-square.min(axis=1) / (WARP[1] * width) ** 2))
    # Far away the weights vanish and the fading does first.
    return np.asarray(reach[:, None] * total / np.maximum(weight, 1e-12)[:, None])


def _rims(base: Array, laid: Surface, features: Features, target_features: Features) -> tuple[Indices, Array]:
    """Vertices along the openings, and displacements (N, 3) from the base that lay them on the source's openings."""
    from scipy.spatial import cKDTree

    names, pulls = [], []
    for code, goal, curve, seeds, width in _sides((features, target_features)):
        away, sample = cKDTree(curve).query(laid.vertices[seeds])
        near = (away < RIM * width) & (target_features.codes[seeds] == code)
        names.append(seeds[near])
        pulls.append((laid.vertices[seeds] + (goal - curve)[sample] - base[seeds])[near])
    # Near a corner a vertex may lie along both curves: the upper one, which comes first, keeps it.
    rim, first = np.unique(np.concatenate([NO_INDICES, *names]), return_index=True)
    return rim, np.concatenate([NO_WEIGHTS, *pulls])[first]


def smooth_field(values: Array, trust: Array, edges: Indices, stiffness: float) -> Array:
    """The field (V, 3) with the least Σ trust (x − value)² + stiffness · Σ_edges (x_a − x_b)².

    Values (V, 3) are known as well as their trust (V,) says; the field is zero on pieces where nothing is known.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.csgraph import laplacian
    from scipy.sparse.linalg import splu

    # The small number keeps the matrix positive definite on pieces of the mesh where nothing is known.
    matrix = diags_array(trust + 1e-9) + stiffness * laplacian(_adjacency(edges, len(trust)))
    # Symmetric and positive definite, so that no pivoting is needed and the factors stay sparse; SciPy has no sparse
    # Cholesky factorisation.
    factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factors.solve(trust[:, None] * values))


def averaging(trust: Array, faces: Indices) -> csr_array | None:
    """The sparse (V, V) matrix of (1 − trust) times the mean of neighbours; None if all vertices are trusted."""
    from scipy.sparse import diags_array

    if (trust >= 1).all():
        return None
    near = _adjacency(edges_of(faces), len(trust))
    matrix = (diags_array((1.0 - trust) / np.maximum(near.sum(axis=1), 1.0)) @ near).tocsr()
    # Rows of trusted vertices hold zeros only; without them the products touch the doubtful vertices alone.
    matrix.eliminate_zeros()
    return matrix


def _adjacency(edges: Indices, count: int) -> csr_array:
    """The symmetric (V, V) matrix that is 1 for every edge."""
    from scipy.sparse import csr_array

    pairs = np.concatenate([edges, edges[:, ::-1]])
    return csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
