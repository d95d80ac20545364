"""The similarity that aligns two face meshes of unknown unit, axes and vertices, also if they show other parts."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from facediff.editing.face_features import Features, FrontView, find_features
from facediff.editing.surface import Surface, nearest
from facediff.editing.symmetry import Plane, symmetry_plane
from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, align, face_size
from facediff.mesh.alignment import TUKEY
from facediff.mesh.flame import rotations
from facediff.utils.numerics import Array

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


SAMPLES = 400  # Vertices of each mesh by which starts are compared
FINE_SAMPLES = 1500  # Vertices of the moved mesh by which the alignment is refined
COARSE_ROUNDS, FINE_ROUNDS = 30, 60
TRIMMED = 0.8  # Share of the nearest pairs that counts, so that a neck or hair that one mesh lacks does not
CLEARLY = 0.9  # Another start than the meshes' own axes must fit better by this factor
SETTLED = 1e-10


def place(
    moved: Surface,
    goal: Surface,
    start: Similarity | None = None,
    *,
    samples: int = FINE_SAMPLES,
    rounds: int = FINE_ROUNDS,
    turns: bool = True,
) -> Similarity:
    """The similarity that aligns one surface with another; without ``turns``, its start's rotation stays.

    Starts are the 24 rotations of one frame of axes into another and the principal axes, with sizes made equal;
    the best by nearest vertices, both ways and trimmed, is refined by nearest points of the surface: Besl and McKay, "A
    method for registration of 3-D shapes", PAMI 1992, and Chen and Medioni, "Object modelling by registration of
    multiple range images", IVC 1992 (distances to planes).
    """
    random = np.random.default_rng(0)
    vertices = np.unique(moved.faces)
    vertices = vertices if len(vertices) <= samples else np.sort(random.choice(vertices, samples, replace=False))
    # Seeded above: the same two meshes give the same similarity every time.
    points, normals, similarity = moved.vertices[vertices], moved.normals[vertices], start or _start(moved, goal)
    for _ in range(rounds):  # Gauss-Newton on the distances to the planes, with Tukey's biweight
        laid = similarity.apply(points)
        matches = nearest(goal, laid, normals @ similarity.rotation.T, size=0.0)
        # The weights follow the spread of the distances, so that parts that one mesh lacks lose their influence as the
        # rest comes closer.
        # 1.4826 turns the median of distances into a standard deviation, as for normally distributed errors. The
        # floor keeps the weights defined for meshes that lie on one another exactly.
        spread = max(1.4826 * float(np.median(matches.distances)), 1e-9 * goal.size)
        weights = np.square(np.clip(1.0 - np.square(matches.distances / (TUKEY * spread)), 0.0, None))
        # Sheets that face another way, such as the inside of a lip or the back of the head, attract nothing.
        weights *= matches.cosines > 0.5
        # Seven unknowns want a few times as many places; with fewer, the similarity of the last round stands.
        if np.count_nonzero(weights) < 20:
            break
        step = _towards_planes(laid, matches.points, matches.normals, weights, goal.size, turns=turns)
        similarity = similarity.then(step)
        if np.abs(step.apply(laid) - laid).max() < SETTLED * goal.size:
            break
    return similarity


def _start(moved: Surface, goal: Surface) -> Similarity:
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng(0)
    meshes = [(surface.vertices, np.unique(surface.faces)) for surface in (moved, goal)]
    source, target = (points[random.choice(some, min(SAMPLES, len(some)), replace=False)] for points, some in meshes)
    axes = [np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2] for points in (source, target)]
    principal = [axes[1].T @ np.diag(signs) @ axes[0] for signs in itertools.product((1.0, -1.0), repeat=3)]
    proper = [turn for turn in principal if np.linalg.det(turn) > 0]
    scale = face_size(target) / face_size(source)
    trials = []
    # Axes as they are, the 24 rotations of a cube (programs swap axes), and principal axes, for meshes at an angle.
    for rotation in (np.eye(3), *Rotation.create_group("O").as_matrix(), *proper):
        trial = Similarity(rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0), scale)
        for _ in range(5):
            trial, apart = _by_vertices(source, target, trial)
        trials.append((apart, trial))
    # Five rounds are enough to tell good starts from bad ones; only the best one is continued.
    unrotated, (least, best) = trials[0], min(trials, key=lambda pair: pair[0])
    # Faces are nearly symmetric, so that a mirrored start fits almost as well: the meshes' own axes win unless another
    # start is clearly better.
    best_start = best if least < CLEARLY * unrotated[0] else unrotated[1]
    for _ in range(COARSE_ROUNDS):
        best_start, _ = _by_vertices(source, target, best_start)
    return best_start


def _by_vertices(source: Array, target: Array, current: Similarity) -> tuple[Similarity, float]:
    """One round of nearest vertices, both ways; and how far apart the pairs were, as a share of the size."""
    from scipy.spatial.distance import cdist

    away = cdist(current.apply(source), target)
    # Pairs in both directions: one direction alone is best fitted by shrinking the mesh into a point.
    to, back = away.argmin(axis=1), away.argmin(axis=0)
    pairs = np.concatenate([np.stack([np.arange(len(source)), to]), np.stack([back, np.arange(len(target))])], axis=1)
    apart = away[pairs[0], pairs[1]]
    # Trimmed: the furthest pairs are of parts that one mesh lacks (Chetverikov et al., "The trimmed iterative closest
    # point algorithm", ICPR 2002).
    inliers = apart <= np.quantile(apart, TRIMMED)
    similarity = align(source[pairs[0]], target[pairs[1]], weights=inliers.astype(np.float64), scale=True)
    return similarity, float(apart[inliers].mean() / face_size(target))


def _towards_planes(
    points: Array, goals: Array, normals: Array, weights: Array, size: float, *, turns: bool
) -> Similarity:
    """The small similarity with the least weighted squared distances to planes, to first order."""
    centre = points.mean(axis=0)
    arms = (points - centre) / size
    # The seven unknowns are rotation and growth about the centre, and translation.
    rows = np.concatenate([np.cross(arms, normals), normals, (arms * normals).sum(axis=1, keepdims=True)], axis=1)
    rows[:, :3] *= turns
    left = ((goals - points) * normals).sum(axis=1) / size
    weighted = rows * weights[:, None]
    # Planes leave some directions undetermined (the rotation of a sphere): least squares does not move along them.
    turn, shift, growth = np.split(np.linalg.lstsq(weighted.T @ rows, weighted.T @ left, rcond=1e-9)[0], [3, 6])
    rotation = rotations(turn[None])[0]
    # The solution holds to first order, for small steps: no round may grow or shrink a mesh by more than 1.65.
    scale = float(np.exp(np.clip(growth[0], -0.5, 0.5)))
    return Similarity(rotation, centre + size * shift - scale * rotation @ centre, scale)


# Where the source's face is known, it alone is searched for: the other mesh may be a mask or a whole figure.

FACE_WINDOW = (-1.3, -0.8), (1.3, 2.3)
"""Corners of the face about a mouth's middle, in widths of the mouth."""
PATCH_STEP = 1 / 14  # Distance of the face's points, as a share of the mouth's width
FEW, MANY = 120, 400  # Points of the face by which starts are compared, and refined
MOST_GROUPS, LEAST_GROUP = 8, 40
END = 0.135  # Share of a standing figure's height that its head takes
CONTINUED = 12  # Starts that are continued
COLLAPSED = 0.05  # A start that shrinks to less than this share has run into a point
LOOKED_AT = 5  # Alignments in which the mouth is searched for
TURNED_LITTLE = 5.0, 40.0  # Degrees by which an alignment may be turned against a mesh's own axes for no good reason
STRAIGHT = 1.5  # Degrees by which a mesh's mirror plane may differ from its own axes
ABOUT_AS_WELL = 1.8
WITH_MOUTH, WITH_EYE = 0.5, 0.85
"""Factors on the distance of an alignment where these are found."""


def place_face(
    moved: Surface, goal: Surface, features: Features, start: Similarity | None = None
) -> tuple[Similarity, Features | None]:
    """The similarity that lays a mesh onto another one's face, and the features of the mesh there.

    The goal's visible face is searched for on the moved mesh: from the 24 rotations of one frame of axes into another,
    in all of the mesh, in each of its larger pieces and at the ends of a long one, by nearest vertices that face the
    same way. Of the best alignments, one in which a mouth and eyes lie where the goal's are is preferred. Where no
    mouth is found, 60 further rotations are tried.
    """
    from scipy.spatial.transform import Rotation

    points, normals = _face_of(goal, features)
    if start is not None:
        refined = place(_near(moved, start, points, features), goal, start, samples=700, rounds=30)
        return refined, find_features(refined.apply(moved.vertices), moved.faces, features)
    tried: list[tuple[float, Similarity, Features | None]] = []
    identity = np.eye(3)[None]
    for turns in (Rotation.create_group("O").as_matrix(), Rotation.create_group("I").as_matrix()):
        candidates = _candidates_for(
            moved, goal, points, normals, np.concatenate([identity, turns]), features.mouth.width
        )
        for apart, start in candidates[:LOOKED_AT]:
            if apart > 2.0 * candidates[0][0]:
                break
            back = start.inverse()
            target_features = find_features(back.apply(moved.vertices), moved.faces, features)
            worth = apart
            if target_features is not None:
                worth *= WITH_MOUTH * WITH_EYE ** sum(eye is not None for eye in target_features.eyes)
            tried.append((worth, back, target_features))
            # A mouth and both eyes in their places settle it, and every further look costs a rendering of the mesh.
            if target_features is not None and worth < CLEARLY * WITH_MOUTH * WITH_EYE**2 * apart:
                break
        if any(target_features is not None for _, _, target_features in tried):
            break
    if not tried:
        raise FaceDiffError("nothing on it is like the animation's face; give a mesh that shows one")
    _, back, target_features = min(tried, key=lambda trial: trial[0])
    refined = place(_near(moved, back, points, features), goal, back, samples=700, rounds=30)
    upright = _upright(moved, goal, points, features, refined)
    if target_features is not None and upright is not None:
        there = find_features(upright.apply(moved.vertices), moved.faces, features)
        if there is not None and sum(eye is None for eye in there.eyes) <= sum(e is None for e in target_features.eyes):
            return upright, there
    if target_features is not None:
        target_features = find_features(refined.apply(moved.vertices), moved.faces, features) or target_features
    return refined, target_features


def _upright(
    moved: Surface, goal: Surface, points: Array, features: Features, refined: Similarity
) -> Similarity | None:
    """The alignment in the mesh's own axes, where it fits about as well as one that nods against them.

    A stylised head is no person's in another size, and nods so that its forehead comes to lie on one. That a mesh is
    its own mirror image along x tells that its axes are upright.
    """
    angle = np.rad2deg(np.arccos(np.clip((np.trace(refined.rotation) - 1) / 2, -1, 1)))
    if not TURNED_LITTLE[0] < angle < TURNED_LITTLE[1]:
        return None
    face = _near(moved, refined, points, features)
    vertices = moved.vertices[np.unique(face.faces)]
    mirror = symmetry_plane(vertices, Plane(np.array([1.0, 0.0, 0.0]), float(np.median(vertices[:, 0]))))
    if mirror.normal[0] < np.cos(np.deg2rad(STRAIGHT)):
        return None
    mouth = features.mouth.centre
    start = Similarity(np.eye(3), mouth - refined.scale * refined.inverse().apply(mouth), refined.scale)
    upright = place(_near(moved, start, points, features), goal, start, samples=700, rounds=30, turns=False)
    apart = [_apart(_near(moved, back, points, features), goal, back) for back in (upright, refined)]
    return upright if apart[0] < ABOUT_AS_WELL * apart[1] else None


def _apart(moved: Surface, goal: Surface, back: Similarity) -> float:
    """The median distance of a mesh's vertices from the goal."""
    vertices = np.unique(moved.faces)
    some = vertices if len(vertices) <= MANY else np.random.default_rng(0).choice(vertices, MANY, replace=False)
    return float(np.median(nearest(goal, back.apply(moved.vertices[some]), np.zeros((len(some), 3)), 0.0).distances))


def _near(moved: Surface, back: Similarity, points: Array, features: Features) -> Surface:
    """The triangles of a mesh that lie about the face."""
    laid = back.apply(moved.vertices)
    margin = 0.3 * features.mouth.width
    low, high = points.min(axis=0) - [margin, margin, 2 * margin], points.max(axis=0) + margin
    inside = ((laid >= low) & (laid <= high)).all(axis=1)
    triangles = inside[moved.faces].all(axis=1)
    return Surface(moved.vertices, moved.faces[triangles]) if np.count_nonzero(triangles) >= 50 else moved


def _face_of(surface: Surface, features: Features) -> tuple[Array, Array]:
    """Points (N, 3), evenly spread in the view from the front, and normals of the skin about the mouth and the eyes."""
    view = FrontView(surface.vertices, surface.faces)
    width = features.mouth.width
    low, high = (features.mouth.centre[:2] + np.array(way) * width for way in FACE_WINDOW)
    step = PATCH_STEP * width
    columns, rows = np.ceil((high - low) / step).astype(int)
    number, _, weights = view.raster(view.within(low, high, features.skin), low, step, int(columns), int(rows))
    hit = number >= 0
    corners, shares = view.faces[number[hit]], weights[hit]
    points = np.einsum("nk,nkd->nd", shares, surface.vertices[corners])
    normals = np.einsum("nk,nkd->nd", shares, surface.normals[corners])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # Through the holes of eyes with separate balls, the back of the head is seen from within.
    front = normals[:, 2] > 0
    return points[front], normals[front]


def _candidates_for(
    moved: Surface, goal: Surface, points: Array, normals: Array, turns: Array, width: float
) -> list[tuple[float, Similarity]]:
    """Similarities from the face's points to a mesh, with the distances that they leave; the best ones first."""
    from scipy.spatial import cKDTree

    random = np.random.default_rng(0)
    vertices = np.unique(moved.faces)
    vertices = vertices if len(vertices) <= 40_000 else np.sort(random.choice(vertices, 40_000, replace=False))
    tree, facing = cKDTree(moved.vertices[vertices]), moved.normals[vertices]
    some = random.permutation(len(points))
    few, many = some[:FEW], some[:MANY]
    rotation, shift, scale = _starts(moved, goal, points, turns)
    unrotated = np.abs(rotation - np.eye(3)).max(axis=(1, 2)) < 1e-9
    state = (rotation, shift, scale.copy())
    # Seven rounds with few points sort the starts; only the best ones are refined, with more points and a tighter
    # cap.
    for _ in range(7):
        state, apart = _round(points[few], normals[few], tree, facing, state, 0.25 * width)
    apart = np.where(unrotated, CLEARLY * apart, apart)
    order = np.argsort(apart)[:CONTINUED]
    state, unrotated, begun = (state[0][order], state[1][order], state[2][order]), unrotated[order], scale[order]
    for _ in range(25):
        state, apart = _round(points[many], normals[many], tree, facing, state, 0.15 * width)
    apart = np.where(unrotated, CLEARLY * apart, apart)
    candidates: list[tuple[float, Similarity]] = []
    for k in np.argsort(apart):
        if not state[2][k] > COLLAPSED * begun[k]:
            continue
        similar = Similarity(state[0][k], state[1][k], float(state[2][k]))
        laid = similar.apply(points[many])
        # Several starts end in one place.
        others = (np.abs(laid - other.apply(points[many])).max() / other.scale for _, other in candidates)
        if all(away > 0.1 * width for away in others):
            candidates.append((float(apart[k]), similar))
    return candidates


def _starts(moved: Surface, goal: Surface, points: Array, turns: Array) -> tuple[Array, Array, Array]:
    """Rotations (B, 3, 3), translations (B, 3) and scales (B,) from the goal to the moved mesh, to begin with."""
    goal_points = goal.vertices[np.unique(goal.faces)]
    pieces = FrontView(moved.vertices, moved.faces).pieces
    vertices = np.unique(moved.faces)
    names, counts = np.unique(pieces[vertices], return_counts=True)
    names = names[np.argsort(-counts, kind="stable")][:MOST_GROUPS]
    groups: list[tuple[Array, Array | None, tuple[float, ...]]] = [(moved.vertices[vertices], None, (0.75, 1.0, 1.33))]
    parts = [moved.vertices[vertices[pieces[vertices] == name]] for name in names]
    groups += [(part, None, (1.0,)) for part in parts if LEAST_GROUP <= len(part) < len(vertices)]
    for part in [group for group, _, _ in groups]:
        extent = np.ptp(part, axis=0)
        for axis, sign in itertools.product(range(3), (1, -1)):
            # Much longer than wide: a figure or a bust, with the face at one end.
            if extent[axis] < 1.6 * np.sort(extent)[0]:
                continue
            along = sign * part[:, axis]
            for share in (END, 0.4):
                end = part[along > along.max() - share * extent[axis]]
                if len(end) >= LEAST_GROUP:
                    groups.append((end, sign * np.eye(3)[axis], (1.0,)))
    starts = []
    for end, up, factors in groups:
        low, high = end.min(axis=0), end.max(axis=0)
        size = face_size(end)
        for turn in turns:
            if up is not None and (turn @ [0, 1, 0]) @ up < 0.5:
                continue
            for factor in factors:
                scale = factor * size / face_size(goal_points)
                starts.append((turn, end.mean(axis=0) - scale * turn @ goal_points.mean(axis=0), scale))
            scale = size / face_size(points)  # a mask shows no more than the face
            starts.append((turn, 0.5 * (low + high) - scale * turn @ (0.5 * (points.min(0) + points.max(0))), scale))
    rotation, shift, scales = zip(*starts, strict=True)
    return np.stack(rotation), np.stack(shift), np.array(scales)


def _round(
    points: Array, normals: Array, tree: cKDTree, facing: Array, state: tuple[Array, Array, Array], cap: float
) -> tuple[tuple[Array, Array, Array], Array]:
    """One round of nearest vertices that face the same way, for many similarities at once; and the mean distances."""
    rotation, shift, scale = state
    laid = scale[:, None, None] * (points @ rotation.swapaxes(1, 2)) + shift[:, None]
    distance, index = tree.query(laid.reshape(-1, 3))
    distance, index = distance.reshape(laid.shape[:2]) / scale[:, None], index.reshape(laid.shape[:2])
    cosine = np.einsum("bnd,bnd->bn", normals @ rotation.swapaxes(1, 2), facing[index])
    agree = cosine > 0.3
    # The cap keeps parts that the other mesh lacks, such as hair, from deciding between alignments.
    apart = np.where(agree, np.minimum(distance / cap, 1.0), 1.0).mean(axis=1)
    limit = np.quantile(np.where(agree, distance, np.inf), 0.75, axis=1, method="lower")
    limit = np.where(np.isfinite(limit), limit, cap)
    weights = (agree & (distance <= np.maximum(limit, 1e-12)[:, None])).astype(np.float64)
    # Too few points that face the same way would be fitted to noise: such an alignment stays as it is.
    enough = weights.sum(axis=1) >= 0.2 * len(points)
    weights[~enough] = 1.0
    new = _similarities(points, tree.data[index], weights)
    for one, old in zip(new, state, strict=True):
        one[~enough] = old[~enough]
    return new, apart


def _similarities(points: Array, goals: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Least squares of points (N, 3) to goals (B, N, 3) with weights (B, N), after Umeyama (1991)."""
    share = weights / weights.sum(axis=1, keepdims=True)
    centre, goal = share @ points, np.einsum("bn,bnd->bd", share, goals)
    away, towards = points[None] - centre[:, None], goals - goal[:, None]
    u, spread, vt = np.linalg.svd(np.einsum("bn,bnd,bne->bde", share, towards, away))
    proper = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    # A reflection becomes the best rotation by its weakest axis.
    u[:, :, 2] *= proper[:, None]
    rotation = u @ vt
    variance = np.maximum(np.einsum("bn,bnd->b", share, away**2), 1e-30)
    scale = np.maximum((spread[:, 0] + spread[:, 1] + proper * spread[:, 2]) / variance, 1e-12)
    return rotation, goal - scale[:, None] * np.einsum("bde,be->bd", rotation, centre), scale
