"""Motion carried from one mesh to another through a correspondence, and correspondences on disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from facediff.animation import Animation, metres_per_unit
from facediff.animation.animation import allocate_like, stretches_of
from facediff.editing.correspondence import (
    LIDS_AT_REST,
    NO_INDICES,
    Correspondence,
    averaging,
    correspond,
    placed,
    refuse_other_face,
    refuse_other_mesh,
    run_alike,
)
from facediff.editing.face_features import facing, find_features, sides_of_pairs
from facediff.editing.fit_check import FitReport, check_fit
from facediff.editing.landmarks import Landmarks, common_landmarks, known_topology, read_landmarks
from facediff.editing.lid_transfer import swing, with_lids, without_lids
from facediff.editing.placing import place_face
from facediff.editing.shapes import ShapeSet, built_in_files, fitted, is_built_in
from facediff.editing.surface import Surface
from facediff.errors import FaceDiffError, OptionError, damaged, located, refuse_idle
from facediff.mesh import Mesh, Similarity, read_mesh
from facediff.mesh.flame import rotations
from facediff.mesh.parts import mesh_parts, named_triangles
from facediff.spaces.shape_files import read_shape_files
from facediff.spaces.space import METRES
from facediff.utils.arrays import read_arrays
from facediff.utils.files import atomic, check_writable
from facediff.utils.limits import check_format
from facediff.utils.numerics import Array, Floats, Indices, Integers

T = TypeVar("T")

ROUNDS = 20  # How often vertices whose place is not well known are averaged with their neighbours
CHUNK_BYTES = 32 * 2**20
SAME_UNIT = 1.4  # Named units lie further apart than this factor, and heads differ by less
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns an animation as ``export --up z`` does."""
TILT = np.deg2rad(20.0)  # A mesh whose rotation differs by less from that one has z up


def retarget(
    animation: Animation,
    mesh_path: Path,
    correspondence_path: Path | None = None,
    landmarks_path: Path | None = None,
    *,
    parts: Sequence[str] = (),
    check: Callable[[Animation, Correspondence, FitReport], object] | None = None,
    whole_head: bool = False,
) -> tuple[Animation, Correspondence]:
    """An animation on the mesh in a file, and the correspondence between both meshes; :func:`to_y_up` if z is up in it.

    Args:
        animation: with triangles.
        mesh_path: the other face at rest.
        correspondence_path: used if it exists, else written; None for neither.
        landmarks_path: CSV or JSON of landmarks, for a correspondence that does not exist yet.
        parts: names of the parts of the file that show the face, see :func:`facediff.mesh.parts.named_triangles`; it is
            searched for in all of them if there are none.
        check: called with the result in the mesh's own axes and its fit report, before a new correspondence is
            written; raises where it should not be. Where it raises and both meshes are of known topologies, their named
            landmarks are tried. Nothing is measured if None.
        whole_head: as of :func:`transfer`.
    """
    triangles = animation.triangles  # refuses an animation without triangles before the other mesh is read
    mesh = read_mesh(mesh_path)

    def checked_transfer(correspondence: Correspondence) -> tuple[Animation, Correspondence]:
        if check is None:
            return to_y_up(transfer(animation, correspondence, mesh, whole_head), correspondence), correspondence
        carried, correspondence, report = transfer_checked(animation, correspondence, mesh, whole_head)
        check(carried, correspondence, report)
        return to_y_up(carried, correspondence), correspondence

    if correspondence_path is not None and correspondence_path.exists():
        reason = f"{correspondence_path} exists and would be used without it"
        refuse_idle(reason, landmarks=landmarks_path is not None, part=bool(parts))
        correspondence = load_correspondence(correspondence_path)
        refuse_other_mesh(
            str(mesh_path), mesh.vertices, mesh.faces, correspondence.target_vertices, correspondence.target_faces
        )
        refuse_other_face(str(mesh_path), mesh.vertices, correspondence.target_vertices)
        return checked_transfer(correspondence)
    if correspondence_path is not None:
        check_writable(correspondence_path)
    # Everything that can be wrong with the options is found before the meshes are compared, which takes seconds.
    landmarks = None
    if landmarks_path is not None:
        templates = known_topology(animation.template), known_topology(mesh.vertices)
        landmarks = read_landmarks(landmarks_path, *templates, (len(animation.template), len(mesh.vertices)))

    def attempt(marks: Landmarks | None, parts: Sequence[str] = parts) -> tuple[Animation, Correspondence]:
        some = named_triangles(mesh_path, parts) if parts else None
        with located(mesh_path):
            correspondence = correspond(
                animation.template, triangles, mesh.vertices, mesh.faces, landmarks=marks, face_triangles=some
            )
        return checked_transfer(correspondence)

    try:
        given = landmarks is not None or check is None
        carried, correspondence = (
            attempt(landmarks) if given else by_shape_or_names(attempt, animation.template, mesh.vertices)
        )
    except FaceDiffError:
        # A part by itself comes last: what is worn on the skin, such as brows, is found in the whole.
        for name in [] if parts else parts_with_a_face(animation, mesh_path, mesh):
            with suppress(FaceDiffError):
                carried, correspondence = attempt(landmarks, [name])
                break
        else:
            raise
    if correspondence_path is not None:
        save_correspondence(correspondence_path, correspondence)
    return carried, correspondence


def by_shape_or_names(attempt: Callable[[Landmarks | None], T], source: Floats, target: Floats) -> T:
    """The result of an attempt without landmarks or, where that fails, with the named ones of both meshes (V, 3).

    These come second: a good fit needs none, and they are only known to a vertex, so that they would pull at it.
    """
    try:
        return attempt(None)
    except FaceDiffError:
        common = common_landmarks(source, target)
        if common is None:
            raise
        return attempt(common)


def has_z_up(correspondence: Correspondence) -> bool:
    """Whether z points up in the target's file, and its face looks along −y, as Blender and 3ds Max write meshes."""
    cosine = (np.trace(Z_UP.T @ correspondence.similarity.rotation) - 1) / 2
    return bool(cosine > np.cos(TILT))


def to_y_up(carried: Animation, correspondence: Correspondence) -> Animation:
    """An animation on a target mesh with y up, as animations have it, where the mesh has z up; else the same."""
    return turned(carried, Z_UP.T) if has_z_up(correspondence) else carried


def turned(animation: Animation, rotation: Array) -> Animation:
    """An animation in other axes: all points rotated (3, 3) about the origin, and the head's motion with them."""
    by, head = rotation.T.astype(np.float32), animation.head
    vertices = allocate_like(animation.vertices)
    for frames, some in stretches_of(animation.vertices):
        vertices[frames] = some @ by
    return replace(
        animation,
        vertices=vertices,
        template=animation.template @ by,
        head=None if head is None else np.concatenate([head[:, :3] @ rotation.T, head[:, 3:] @ rotation.T], axis=1),
    )


MOST_PARTS, LEAST_PART = 6, 60  # So many of the largest parts are looked at, and triangles that a face has at least


def parts_with_a_face(animation: Animation, path: Path, mesh: Mesh) -> list[str]:
    """Names of the parts of a file, the first name of each, in which a mouth is where the animation's face has it."""
    source = Surface(np.asarray(animation.template, np.float64), animation.triangles.astype(np.int64))
    features = find_features(source.vertices, source.faces)
    triangles: dict[str, Indices] = {}
    parts = [part for part in mesh_parts(path) if part.names]
    for part in parts if features is not None and len(parts) > 1 else []:
        triangles[part.names[0]] = np.append(triangles.get(part.names[0], NO_INDICES), part.triangles)

    def shows_a_face(name: str) -> bool:
        faces = np.asarray(mesh.faces, np.int64)[triangles[name]]
        target = run_alike(source, Surface(np.asarray(mesh.vertices, np.float64), faces))
        return features is not None and place_face(target, source, features)[1] is not None

    largest = sorted(triangles, key=lambda name: -len(triangles[name]))[:MOST_PARTS]
    return [name for name in largest if len(triangles[name]) >= LEAST_PART and shows_a_face(name)]


def transfer_checked(
    animation: Animation, correspondence: Correspondence, target: Mesh, whole_head: bool = False
) -> tuple[Animation, Correspondence, FitReport]:
    """The motion of an animation on a target mesh, the correspondence that carried it, and the fit report.

    Where a result is poor, its eyes are carried another way: lids go the share of their own opening, if they did not
    yet, and else stay at rest. That result counts if nothing else is wrong. The face is measured without the motion of
    the head as a whole, for which no mesh needs a place.
    """
    still = animation.still()

    carried = transfer(still, correspondence, target)
    report = check_fit(still, carried, correspondence)
    if np.array_equal(target.faces, still.triangles) and np.allclose(target.vertices, still.template, atol=1e-6):
        report = replace(report, faults=())  # a copy, which is as good as the animation
    if not report.good and report.eyes is not None:
        for lids in range(correspondence.lids + 1, LIDS_AT_REST + 1):
            variant = replace(correspondence, lids=lids)
            moved = transfer(still, variant, target)
            again = check_fit(still, moved, variant)
            if again.good:
                if lids == LIDS_AT_REST:
                    worse = f"lids in motion were worse: {report.faults[0]}"
                    again = replace(again, remarks=(*again.remarks, worse))
                carried, correspondence, report = moved, variant, again
                break
    return _with_head(carried, animation.head, correspondence, whole_head), correspondence, report


def transfer(animation: Animation, correspondence: Correspondence, target: Mesh, whole_head: bool = False) -> Animation:
    """The motion of an animation of the correspondence's source mesh, of any identity, on its target mesh.

    The target's vertices, triangles and colours are kept as they are; its unit follows from how large it is. With
    ``whole_head``, all of a figure moves as its head does, so that the motion of the head can be taken off again, as
    weights of shapes need it; else its body stands still.
    """
    refuse_other_mesh(
        animation.name,
        animation.template,
        animation.triangles,
        correspondence.source_vertices,
        correspondence.source_faces,
    )
    refuse_other_mesh(
        "target mesh", target.vertices, target.faces, correspondence.target_vertices, correspondence.target_faces
    )
    animation.refuse_not_finite()
    head, animation = animation.head, animation.still()
    rest = np.asarray(target.vertices, np.float64)
    neutral = np.asarray(animation.template, np.float64)
    vertices = allocate_like(animation.vertices, (len(animation.vertices), len(rest), 3))
    step = max(1, CHUNK_BYTES // (24 * max(len(rest), len(neutral))))
    for first in range(0, len(vertices), step):
        some = slice(first, first + step)
        vertices[some] = rest + transfer_displacements(
            correspondence, np.asarray(animation.vertices[some], np.float64) - neutral
        )
    carried = Animation(
        name=animation.name,
        vertices=vertices,
        template=rest.astype(np.float32),
        frame_rate=animation.frame_rate,
        faces=np.asarray(target.faces, np.int32),
        unit=unit_of(animation.unit, correspondence.similarity.scale),
        speech=animation.speech,
        sample_rate=animation.sample_rate,
        colours=target.colours,
        regions={name: carried_region(correspondence, indices) for name, indices in animation.regions.items()},
        inner_lip_pairs=carried_pairs(correspondence, animation.inner_lip_pairs),
        metadata={
            **animation.metadata,
            "carried": f"from a mesh of {len(neutral)} vertices to one of {len(rest)} by nearest points of its surface",
        },
    )
    return _with_head(carried, head, correspondence, whole_head)


NECK = 0.5  # Below a head, its motion as a whole fades over this share of the source's height: a body stands still


def _with_head(carried: Animation, head: Array | None, correspondence: Correspondence, whole_head: bool) -> Animation:
    """Move an animation on the target, eyes and hair included, as the source's head (T, 6) does: in place.

    The result's own ``head`` is set if all of its vertices move so.
    """
    if head is None:
        return carried
    vertices, rest = carried.vertices, np.asarray(carried.template, np.float64)
    similarity = correspondence.similarity
    turns = head[:, :3] @ similarity.rotation.T  # axes turn with the mesh
    matrices = rotations(turns)
    shifts = (
        similarity.scale * head[:, 3:] @ similarity.rotation.T
        + similarity.translation
        - matrices @ similarity.translation
    )
    height = similarity.inverse().apply(rest)[:, 1]
    low, high = correspondence.source_vertices[:, 1].min(), correspondence.source_vertices[:, 1].max()
    # A figure's head turns on its neck: below the source's lowest vertex the turn fades, and its feet stay put.
    share = np.clip(1.0 + (height - low) / (NECK * (high - low)), 0.0, 1.0)
    # Carried back, the lowest vertex may lie a rounding below its own height.
    whole_head = whole_head or bool((share > 0.999).all())
    for index, (matrix, shift, motion) in enumerate(zip(matrices, shifts, head, strict=True)):
        if motion.any():
            frame = vertices[index]
            moved = frame @ matrix.T + shift
            vertices[index] = moved if whole_head else frame + share[:, None] * (moved - frame)
    shifts[~head.any(axis=1)] = 0.0
    return replace(carried, head=np.concatenate([turns, shifts], axis=1)) if whole_head else carried


def transfer_displacements(correspondence: Correspondence, displacements: Floats) -> Array:
    """Displacements of the source's vertices (T, Vs, 3) on the target's (T, Vt, 3), in its unit and axes.

    Each target vertex takes the weighted mean of its triangle's corners, turned and scaled by the similarity. Where
    its place on the source is not well known, neighbours are averaged; where it is far from anything, motion fades.
    Lids go the share of their own eye's opening, and what lies on the skin moves with it.
    """
    # Displacements are differences of positions: the similarity's translation does not act on them.
    matrix = correspondence.similarity.scale * correspondence.similarity.rotation
    moved, lids = np.asarray(displacements, np.float64), correspondence.eye_lids
    edges: list[Array] = []
    if lids is not None:
        moved, edges = without_lids(lids, moved)
    carried = (
        sum(correspondence.weights[:, k, None] * moved[:, correspondence.corners[:, k]] for k in range(3)) @ matrix.T
    )
    smoothing = averaging(correspondence.trust, correspondence.target_faces)
    if smoothing is not None:
        # Frames and coordinates become columns, so that one sparse product averages all of them.
        columns = carried.transpose(1, 0, 2).reshape(carried.shape[1], -1)
        trusted = correspondence.trust[:, None] * columns
        # Jacobi steps of x = trust · x₀ + (1 − trust) · mean of the neighbours: each carries trusted motion one edge
        # further into untrusted vertices.
        for _ in range(ROUNDS):
            columns = trusted + smoothing @ columns
        carried = columns.reshape(carried.shape[1], carried.shape[0], 3).transpose(1, 0, 2)
    carried = np.asarray(correspondence.share[:, None] * carried)
    if lids is not None:
        laid = carried @ np.linalg.inv(matrix).T
        with_lids(lids, correspondence.laid.vertices, laid, edges)
        carried = laid @ matrix.T
    if len(correspondence.followers):
        with_skin = np.einsum(
            "ak,takd->tad", correspondence.follower_weights, carried[:, correspondence.follower_corners]
        )
        carried[:, correspondence.followers] = with_skin
        # Lashes hang between two vertices at the edge of a lid.
        hangs = correspondence.follower_corners[:, 1] == correspondence.follower_corners[:, 2]
        if lids is not None and hangs.any():
            lashes = correspondence.followers[hangs]
            roots = correspondence.follower_corners[hangs], correspondence.follower_weights[hangs]
            laid = carried @ np.linalg.inv(matrix).T
            carried[:, lashes] += swing(lids, correspondence.laid.vertices, lashes, *roots, laid) @ matrix.T
    if lids is not None and all(eye.target is None for eye in lids):
        carried[:, correspondence.beside_lids] = 0.0
    return carried


def unit_of(unit: str, scale: float) -> str:
    """The target's unit: the source's own or a named one, if the sizes differ by no more than heads do; else a number.

    Example:
        >>> unit_of("m", 1000.0), unit_of("m", 1.1), unit_of("m", 20.0)
        ('mm', 'm', '0.05')
    """
    if 1 / SAME_UNIT < scale < SAME_UNIT:
        return unit
    metres = metres_per_unit(unit) / scale
    near = [name for name, value in METRES.items() if 1 / SAME_UNIT < metres / value < SAME_UNIT]
    return near[0] if near else f"{metres:.6g}"


def carried_region(correspondence: Correspondence, indices: Integers) -> Indices:
    """A region of the source on the target: vertices that lie more inside than out, and move."""
    member = np.zeros(len(correspondence.source_vertices))
    member[indices] = 1.0
    # The barycentric mean of a region's membership says how much of a vertex's place is inside.
    inside = (member[correspondence.corners] * correspondence.weights).sum(axis=1)
    return np.flatnonzero((inside > 0.5) & (correspondence.share > 0))


def carried_pairs(correspondence: Correspondence, pairs: Integers | None) -> Indices | None:
    """Pairs (P, 2) of facing vertices of the source as pairs of the target's vertices there, each pair once.

    Of the vertices that lie near to the source's and on the same lip, those two face each other that are
    nearest to one another: on a coarse mesh the very nearest ones may lie far apart.
    """
    if pairs is None or not len(pairs):
        return None
    source = Surface(correspondence.source_vertices, correspondence.source_faces)
    points = np.einsum("vc,vcd->vd", correspondence.weights, source.vertices[correspondence.corners])
    sides = sides_of_pairs(source.vertices, source.faces, np.asarray(pairs, np.int64))
    side = (correspondence.weights * sides[correspondence.corners]).sum(axis=1)
    rest = correspondence.similarity.inverse().apply(correspondence.target_vertices)
    every, target_pairs = np.arange(len(rest)), []
    for ends in pairs:
        # Lips touch at rest: a vertex of the other lip is nearer than none, but never nearer than one of the same.
        above, below = (
            np.linalg.norm(points - source.vertices[vertex], axis=1)
            + source.size * (sign * side <= 0)
            + source.size * (correspondence.share <= 0)
            for vertex, sign in zip(ends, (1.0, -1.0), strict=True)
        )
        target_pairs.append(facing(rest, every, above, every, below))
    different = np.unique([pair for pair in target_pairs if pair[0] != pair[1]], axis=0)
    return different if len(different) else None


def retarget_shapes(path: Path, animation: Animation) -> ShapeSet:
    """Blendshapes of another topology (as :func:`read_shape_files` reads them), transferred to an animation's mesh.

    The shapes are carried as an animation would be, and the result is checked likewise. Where it fails, or the shapes
    are a whole figure's or look another way, their face is laid onto the animation's first.
    """
    files = built_in_files() if is_built_in(path) else read_shape_files(path)
    if files.neutral is None or files.faces is None:
        raise FaceDiffError(
            f"{path}: transferring shapes to another mesh needs their neutral face with triangles; add it as "
            f"neutral{files.first.suffix}"
        )
    template = animation.template.astype(np.float64)
    goal = Mesh(template, animation.triangles)
    neutral, points = np.asarray(files.neutral, np.float64), np.asarray(files.shapes, np.float64)
    faces = np.asarray(files.faces, np.int64)
    reports = []
    for laid_first in (False, True):
        if laid_first:
            target = Surface(template, animation.triangles.astype(np.int64))
            back, features, _ = placed(target, Surface(neutral, faces))
            if features is None:
                break
            neutral, points = back.apply(neutral), back.apply(points)
            faces = _about_what_moves(neutral, points, faces)
        vertices, corners = np.unique(faces, return_inverse=True)
        corners = corners.reshape(-1, 3)
        correspondence = correspond(neutral[vertices], corners, template, animation.triangles)
        # Shapes state no unit; the alignment says how large they are.
        metres = correspondence.similarity.scale * metres_per_unit(animation.unit)
        shape_poses = Animation(
            str(path), points[:, vertices].astype(np.float32), neutral[vertices].astype(np.float32), 1.0,
            faces=corners.astype(np.int32), unit=f"{metres:.9g}",
        )  # fmt: skip
        reports.append(check_fit(shape_poses, transfer(shape_poses, correspondence, goal), correspondence))
        if reports[-1].good:
            break
    if not reports[-1].good:
        raise OptionError.naming(
            f"{path}: its shapes cannot be carried to {animation.name}: {reports[0].faults[0]}. Carry the animation to "
            f"their mesh with `facediff retarget`, and give them without {{carry}}"
        )
    moves = transfer_displacements(correspondence, points[:, vertices] - neutral[vertices])
    moved = replace(
        files,
        shapes=template + moves,
        neutral=template,
        faces=animation.faces,
        metric=False,
        notes=(*files.notes, f"the shapes are transferred from a mesh of {len(vertices)} vertices"),
    )
    return fitted(moved, animation.template, animation.unit)


ABOUT_MOVING = 0.3  # Of a figure, the face alone is a source: what lies within this share of the moving part's size


def _about_what_moves(neutral: Array, points: Array, faces: Indices) -> Indices:
    """The triangles about the vertices that shapes (K, V, 3) move; all if nearly everything moves."""
    furthest = np.linalg.norm(points - neutral, axis=2).max(axis=0, initial=0.0)
    moving = neutral[furthest > 0.02 * furthest.max(initial=0.0)]
    if not len(moving):
        return faces
    margin = ABOUT_MOVING * float(np.ptp(moving, axis=0).max())
    inside = ((neutral >= moving.min(axis=0) - margin) & (neutral <= moving.max(axis=0) + margin)).all(axis=1)
    near = faces[inside[faces].all(axis=1)]
    return near if len(near) >= 4 else faces


# Correspondences on disk.

FORMAT = "facediff correspondence 2"
SIMILARITY = ("rotation", "translation", "scale")
ARRAYS = tuple(field.name for field in fields(Correspondence) if field.name != "similarity")


def save_correspondence(path: Path, correspondence: Correspondence) -> None:
    """Write a correspondence as .npz, which ``numpy.load`` opens without pickle."""
    content = {name: np.asarray(getattr(correspondence, name)) for name in ARRAYS}
    content |= {name: np.asarray(getattr(correspondence.similarity, name)) for name in SIMILARITY}
    with atomic(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, format=np.array(FORMAT), **content)


def load_correspondence(path: Path) -> Correspondence:
    """Read what :func:`save_correspondence` wrote."""
    arrays = read_arrays(path)
    check_format(path, str(arrays.get("format")), FORMAT)
    with damaged(path, "make a new correspondence"):
        content: dict[str, Any] = {name: arrays[name] for name in ARRAYS}
        rotation, translation, scale = (arrays[name] for name in SIMILARITY)
        content |= {"lids": int(arrays["lids"]), "similarity": Similarity(rotation, translation, float(scale))}
        correspondence = Correspondence(**content)
        # Vertices beyond the mesh's would be an error, and those counted from its end another place without a word.
        for name in ("corners", "source_faces", "target_faces", "hidden", "followers", "follower_corners"):
            if arrays[name].min(initial=0) < 0:
                raise ValueError(f"{name} is damaged")
    return correspondence
