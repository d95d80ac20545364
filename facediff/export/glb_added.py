"""An animation added to a .glb from elsewhere: further morph targets and their weights; all else in it stays."""

from __future__ import annotations

import copy
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.editing.retargeting import Z_UP, turned
from facediff.errors import FaceDiffError, damaged
from facediff.export.glb import normal_shapes
from facediff.export.glb_writer import ARRAY_BUFFER, GlbWriter
from facediff.export.motion_shapes import Morphs, compress
from facediff.mesh.glb import Glb, attributes, open_glb
from facediff.mesh.glb_scene import Placed, placed_parts
from facediff.mesh.glb_shapes import target_names

WELD = 1e-6  # Vertices nearer than this share of the mesh's size share a normal's turn: seams of textures stay closed

Array = npt.NDArray[np.float64]


def add_to_glb(path: Path, target: Path, animation: Animation, tolerance_mm: float) -> None:
    """Write a copy of a .glb in which the meshes of an animation move.

    The parts of the file that move get further morph targets after their own (default weights stay), and one
    animation drives them. Texture coordinates, materials, images, skins, nodes, extensions and other animations
    are written as they are; an animation of a moving mesh's own weights gets zeros for the new targets, and a mesh that
    several nodes show becomes one of its own for each node that moves. Where a part has normals, they turn with it.

    Args:
        path: the file to write.
        target: the .glb that the animation's mesh was read from.
        animation: on that mesh, vertex by vertex.
        tolerance_mm: largest distance of a vertex from the animation's, in millimetres. A part that moves by less
            stands still.
    """
    with damaged(target, "not a readable GLB mesh, export it again"):
        glb, writer = open_to_add(target)
        parts, animation = parts_of(glb, animation)
        _animate(glb, writer, parts, animation, tolerance_mm / 1000 / metres_per_unit(animation.unit))
    writer.write(path)


def open_to_add(target: Path) -> tuple[Glb, GlbWriter]:
    """A .glb from elsewhere, and a writer that appends to its content; errors as in reading it."""
    glb = open_glb(target)
    for kind in ("buffers", "bufferViews", "accessors"):
        glb.entries(kind)  # refuses what is no list, to which the writer could not append
    if not glb.entries("nodes"):
        # Its meshes are shown all the same, and an animation moves nodes; the last root is placed first.
        count = len(glb.entries("meshes"))
        scene = {"nodes": [*reversed(range(count))]}
        glb.content |= {"nodes": [{"mesh": mesh} for mesh in range(count)], "scenes": [scene], "scene": 0}
    return glb, GlbWriter(glb.content, glb.binary)


def parts_of(glb: Glb, animation: Animation) -> tuple[list[Placed], Animation]:
    """The placed parts of a .glb that an animation was carried to, and the animation in the axes of the file."""
    parts = list(placed_parts(glb))
    total = sum(len(part.local) for part in parts)
    if total != len(animation.template):
        raise FaceDiffError(
            f"{glb.source}: has {total} vertices and the animation {len(animation.template)}; give the file that the "
            f"animation was carried to"
        )
    rest = np.asarray(animation.template, np.float64)
    points = np.concatenate([part.points for part in parts])
    is_upright = np.linalg.norm(points - rest @ Z_UP.T) < np.linalg.norm(points - rest)  # of a file that has z up
    return parts, turned(animation, Z_UP) if is_upright else animation


def _animate(glb: Glb, writer: GlbWriter, parts: list[Placed], animation: Animation, tolerance: float) -> None:
    begins = np.cumsum([0, *(len(part.local) for part in parts)])
    rest = np.asarray(animation.template, np.float64)
    furthest = np.zeros(len(rest))
    for frame in animation.frames():
        np.maximum(furthest, np.linalg.norm(frame - rest, axis=1), out=furthest)
    moving = [
        (part, np.arange(first, first + len(part.local)))
        for part, first in zip(parts, begins, strict=False)
        if furthest[first : first + len(part.local)].max(initial=0) > tolerance
    ]
    if not moving:
        return
    moving_rows = np.concatenate([some for _, some in moving])
    offsets = np.stack([np.asarray(frame, np.float64)[moving_rows] - rest[moving_rows] for frame in animation.frames()])
    morphs = compress(offsets.astype(np.float32), tolerance)
    turns = _Turns(
        rest, np.concatenate([part.faces + k for part, k in zip(parts, begins, strict=False)]), moving_rows, offsets
    )
    times = writer.add((np.arange(len(offsets)) / animation.frame_rate).astype(np.float32), bounds=True)
    motion: dict[str, Any] = {"name": animation.name, "samplers": [], "channels": []}
    by_node: dict[int, list[tuple[Placed, npt.NDArray[np.int64]]]] = defaultdict(list)
    for part, some in moving:
        by_node[part.node].append((part, some))
    drawn_rows = [entry.get("mesh") for entry in glb.entries("nodes")]
    for node, own_parts in sorted(by_node.items()):
        entry, mesh = glb.entry("nodes", node), own_parts[0][0].mesh
        if drawn_rows.count(mesh) > 1:  # the other nodes keep theirs
            original = glb.primitives(mesh)
            glb.content["meshes"].append(copy.deepcopy(glb.entry("meshes", mesh)))
            entry["mesh"] = drawn_rows[node] = len(glb.content["meshes"]) - 1
            primitives = [
                next(
                    new for old, new in zip(original, glb.primitives(entry["mesh"]), strict=True) if old is p.primitive
                )
                for p, _ in own_parts
            ]
        else:
            primitives = [part.primitive for part, _ in own_parts]
        targets = {
            id(primitive): _targets(
                glb, writer, part, primitive, morphs, np.searchsorted(moving_rows, some), turns, offsets
            )
            for primitive, (part, some) in zip(primitives, own_parts, strict=True)
        }
        default, before = _append(glb, writer, node, targets, len(morphs.shapes))
        _pad_others(glb, writer, node, before, len(morphs.shapes))
        rows = np.concatenate(
            [np.tile(np.array(default, np.float32), (len(offsets), 1)), morphs.weights], axis=1, dtype=np.float32
        )
        motion["samplers"].append({"input": times, "output": writer.add(rows.ravel()), "interpolation": "LINEAR"})
        motion["channels"].append({"sampler": len(motion["samplers"]) - 1, "target": {"node": node, "path": "weights"}})
    glb.put_first(motion)


def _append(
    glb: Glb, writer: GlbWriter, node: int, targets: dict[int, list[dict[str, int]]], count: int
) -> tuple[list[float], int]:
    """Add targets to the mesh of a node: the default weights of its own ones, and how many those are."""
    entry = glb.entry("nodes", node)
    mesh = glb.entry("meshes", entry["mesh"])
    primitives = glb.primitives(entry["mesh"])
    before = max(len(glb.entries("targets", primitive)) for primitive in primitives)
    names = [f"target_{k}" for k in range(before)]
    with suppress(ValueError):  # targets without names
        names = target_names(glb, entry["mesh"])
    for primitive in primitives:
        new = targets.get(id(primitive))
        if new is None:  # all primitives of a mesh have as many targets
            still = np.zeros((len(glb.positions(primitive)), 3), np.float32)
            new = [{"POSITION": writer.add(still, target=ARRAY_BUFFER, bounds=True)}] * count
        primitive["targets"] = [*glb.entries("targets", primitive), *new]
    default = [float(weight) for weight in mesh.get("weights", [0.0] * before)]
    mesh["weights"] = [*default, *[0.0] * count]
    if "weights" in entry:
        default = [float(weight) for weight in entry["weights"]]
        entry["weights"] = [*default, *[0.0] * count]
    new_names = [f"facediff_{k:04d}" for k in range(before, before + count)]
    for primitive in primitives:  # where some exporters write them
        primitive.get("extras", {}).pop("targetNames", None)
    mesh["extras"] = {**mesh.get("extras", {}), "targetNames": [*names, *new_names]}
    return default, before


def _targets(
    glb: Glb,
    writer: GlbWriter,
    part: Placed,
    primitive: dict[str, Any],
    morphs: Morphs,
    rows: npt.NDArray[np.int64],
    turns: _Turns,
    offsets: Array,
) -> list[dict[str, int]]:
    """Accessors of the new targets of a primitive; its vertices are these rows of the moving ones."""
    shape_offsets = part.returned(np.asarray(morphs.shapes[:, rows], np.float64)).astype(np.float32)
    targets = [
        {"POSITION": writer.add(offsets_of_target, target=ARRAY_BUFFER, bounds=True)}
        for offsets_of_target in shape_offsets
    ]
    accessor = attributes(primitive).get("NORMAL")
    if accessor is not None:
        local = glb.numbers(accessor, "VEC3", ("f4", "i1", "i2"), len(part.local)).astype(np.float64)
        world_normals = _unit(
            (local[:, None] @ np.linalg.inv(part.turn))[:, 0]
        )  # normals turn by the inverse transpose
        local_turns = (_unit((turns.at(offset, rows, world_normals)[:, None] @ part.turn)[:, 0]) for offset in offsets)
        normals = (normal.astype(np.float32) for normal in local_turns)
        shapes = normal_shapes(morphs.weights, local.astype(np.float32), normals)
        for target, shape in zip(targets, shapes, strict=True):
            target["NORMAL"] = writer.add(shape, target=ARRAY_BUFFER, bounds=True)
    return targets


class _Turns:
    """How normals turn from rest: as the normals that are computed from the triangles do.

    The file's own normals, which may be sharp at some edges and smooth at others, are turned and not replaced.
    """

    def __init__(
        self, rest: Array, faces: npt.NDArray[np.int64], moving: npt.NDArray[np.int64], offsets: Array
    ) -> None:
        size = max(float(np.ptp(rest, axis=0).max()), np.finfo(float).tiny)
        self.rest = rest
        # Lips that touch at rest are in one place too, and part: a sum of all frames tells them from a seam.
        moved = np.zeros_like(rest)
        moved[moving] = np.tensordot(np.random.default_rng(0).normal(size=len(offsets)), offsets, axes=1)
        positions = np.rint(np.concatenate([rest, moved], axis=1) / (WELD * size))
        first, group = np.unique(positions, axis=0, return_index=True, return_inverse=True)[1:]
        welded = group.reshape(-1)  # NumPy 2.0 returns it with a second axis
        near = np.zeros(len(rest), bool)
        near[moving] = True
        corners = welded[faces[near[faces].any(axis=1)]]
        self.names = np.unique(np.concatenate([corners.ravel(), welded[moving]]))
        self.points = first[self.names]
        self.corners = np.searchsorted(self.names, corners)
        self.place = np.searchsorted(self.names, welded[moving])
        self.moved = np.full(len(rest), -1)
        self.moved[moving] = np.arange(len(moving))
        self.before = self._normals(rest[self.points])

    def _normals(self, points: Array) -> Array:
        a, b, c = (points[self.corners[:, k]] for k in range(3))
        # The cross product is as long as twice the area, by which triangles count.
        across = np.cross(b - a, c - a)
        sums = [
            np.bincount(self.corners.ravel(), np.repeat(across[:, k], 3), len(self.names)).astype(np.float64)
            for k in range(3)
        ]
        return _unit(np.stack(sums, axis=1))[self.place]

    def at(self, offset: Array, rows: npt.NDArray[np.int64], normals: Array) -> Array:
        """Normals (N, 3) of some of the moving vertices, turned as the frame with these offsets (M, 3) has it."""
        rows_of = self.moved[self.points]
        points = self.rest[self.points] + np.where(rows_of[:, None] >= 0, offset[rows_of], 0.0)
        one, two = self.before[rows], self._normals(points)[rows]
        # The least rotation of one vector onto another, after Rodrigues; 1 + cosine is 0 where they are opposite.
        axis, cosine = np.cross(one, two), np.einsum("nd,nd->n", one, two)
        across = np.cross(axis, normals)
        return normals + across + np.cross(axis, across) / np.maximum(1.0 + cosine, 1e-3)[:, None]


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))


def _pad_others(glb: Glb, writer: GlbWriter, node: int, before: int, more: int) -> None:
    """Give the file's own animations of a node's weights zeros for the new targets."""
    for animation in glb.entries("animations"):
        samplers, channels = glb.entries("samplers", animation), glb.entries("channels", animation)
        for channel in channels:
            goal = channel.get("target", {})
            if goal.get("node") == node and goal.get("path") == "weights" and before:
                number = channel["sampler"]
                sampler = dict(samplers[number])
                values = glb.numbers(sampler["output"], "SCALAR", ("f4", "i1", "u1", "i2", "u2")).reshape(-1, before)
                padded = np.pad(values.astype(np.float32), ((0, 0), (0, more)))
                sampler["output"] = writer.add(padded.ravel())
                if sum(entry.get("sampler") == number for entry in channels) == 1:
                    samplers[number] = sampler
                else:
                    samplers.append(sampler)
                    channel["sampler"] = len(samplers) - 1
