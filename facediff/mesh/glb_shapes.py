"""Morph targets of binary glTF 2.0 files as blendshapes, also of avatars that consist of several parts.

Section 3.7.2.2 of the specification. Names of targets are in ``mesh.extras.targetNames``, as its note has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from facediff.mesh.glb import POSITIONS, TRIANGLES, Glb
from facediff.mesh.glb_scene import Placed, placed_parts
from facediff.mesh.mesh import check_coordinates
from facediff.utils.numerics import Array, Indices


@dataclass(frozen=True, eq=False)
class Targets:
    """Shapes of one mesh, or of several parts as one."""

    names: tuple[str, ...]  # (K,)
    neutral: Array  # (V, 3) in metres
    deltas: Array  # (K, V, 3)
    faces: Indices  # (F, 3)


def read_targets(glb: Glb, vertices: int | None = None) -> Targets:
    """The shapes in a file.

    Args:
        glb: the file.
        vertices: of the mesh that they are for: the mesh with the most targets, the parts that have targets, or all
            parts of the scene as :func:`facediff.mesh.read_mesh` joins them: the first with as many vertices. None for
            the parts that have targets, in the scene: of an avatar these are head, teeth and eyes.
    """
    counts = [
        max((len(glb.entries("targets", primitive)) for primitive in glb.primitives(index)), default=0)
        for index in range(len(glb.entries("meshes")))
    ]
    if not max(counts, default=0):
        raise ValueError("no mesh in it has targets (shape keys); export them with the mesh")
    best = int(np.argmax(counts))
    placed = list(placed_parts(glb))
    moving = [part for part in placed if glb.entries("targets", part.primitive)]
    if vertices is None and moving:
        return _joined(glb, moving)
    if vertices is not None and vertices != sum(len(glb.positions(primitive)) for primitive in glb.primitives(best)):
        for parts in (moving, placed):
            if moving and vertices == sum(len(part.local) for part in parts):
                return _joined(glb, parts)
    return _of_mesh(glb, best)


def _of_mesh(glb: Glb, index: int) -> Targets:
    """The targets of one mesh, its primitives one after the other, as they are stored: no node acts on them."""
    parts = [
        Placed(
            index, -1, primitive, (), {}, local := glb.positions(primitive), None, glb.triangles(primitive, len(local))
        )
        for primitive in glb.primitives(index)
    ]
    count = len(glb.entries("targets", parts[0].primitive))
    if any(
        part.primitive.get("mode", TRIANGLES) != TRIANGLES or len(glb.entries("targets", part.primitive)) != count
        for part in parts
    ):
        raise ValueError("its mesh has parts that are no triangles, or have other targets; export one mesh")
    return _joined(glb, parts)


def _joined(glb: Glb, parts: list[Placed]) -> Targets:
    """Parts one after the other; targets of one name are one shape, and a part that lacks it stands still."""
    # An avatar's head, teeth and lashes each have a target called jawOpen: by name they are one shape again.
    columns: dict[str, int] = {}
    names_by_part = []
    for part in parts:
        names = _names(glb, part.mesh, part.primitive)
        names_by_part.append(names)
        for name in names:
            columns.setdefault(name, len(columns))
    total = sum(len(part.local) for part in parts)
    neutral, deltas, faces, before = np.zeros((total, 3)), np.zeros((len(columns), total, 3)), [], 0
    for part, names in zip(parts, names_by_part, strict=True):
        rows = slice(before, before + len(part.local))
        neutral[rows] = part.points
        for name, target in zip(names, glb.entries("targets", part.primitive), strict=True):
            if "POSITION" in target:
                moves = glb.numbers(target["POSITION"], "VEC3", POSITIONS, len(part.local)).astype(np.float64)
                deltas[columns[name], rows] = part.turned(moves)
        faces.append(part.faces + before)
        before += len(part.local)
    check_coordinates(neutral, f"{glb.source}:")
    check_coordinates(deltas, f"{glb.source}:")
    return Targets(tuple(columns), neutral, deltas, np.concatenate(faces))


def target_names(glb: Glb, mesh: int) -> list[str]:
    """Names of a mesh's targets, by the mesh or by its first primitive that has targets."""
    primitives = glb.primitives(mesh)
    return _names(glb, mesh, next((one for one in primitives if glb.entries("targets", one)), {}))


def _names(glb: Glb, mesh: int, primitive: dict[str, Any]) -> list[str]:
    """Names of a primitive's targets: its mesh's, or its own where an exporter wrote them there."""
    count = len(glb.entries("targets", primitive))
    holders: list[dict[str, Any]] = [glb.entry("meshes", mesh), primitive]
    for holder in holders if count else []:
        extras = holder.get("extras")
        names = extras.get("targetNames") if isinstance(extras, dict) else None
        if isinstance(names, list) and len({str(name) for name in names}) == len(names) == count:
            return list(map(str, names))
    if count:
        raise ValueError(f"has {count} targets without as many different names; export it with targetNames")
    return []
