"""Scenes of binary glTF 2.0 files: the meshes where nodes and skins place them, part by part.

Khronos Group, "glTF 2.0 Specification": sections 3.5 (scenes, nodes, transforms) and 3.7.3 (skins). Images and
extensions are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from facediff.mesh.glb import Glb, attributes, whole_number
from facediff.mesh.mesh import Mesh
from facediff.utils.colours import to_srgb
from facediff.utils.limits import COORDINATE, in_range
from facediff.utils.numerics import Array, Indices

ALIKE = 1e-5
"""Matrices of a skin that differ by less than this share are one: it is in the pose that it was bound in."""
JOINTS, WEIGHTS = ("u1", "u2"), ("f4", "u1", "u2")
PLAIN = np.array([230, 190, 168], np.uint8)
"""Colour (sRGB) of parts that have theirs in a picture or none, as of a face without colours in videos."""
MOST_SETS = 8  # of four joints a vertex


@dataclass(frozen=True, eq=False)
class Placed:
    """A primitive with triangles where a node shows it."""

    mesh: int  # number of its mesh
    node: int  # number of the node; -1 in a file without nodes
    primitive: dict[str, Any]  # its description in the file, which may be changed
    names: tuple[str, ...]  # of the node, the mesh and the material, where they have one
    material: dict[str, Any]  # its description in the file; empty if there is none
    local: Array  # (V, 3) vertices as the file has them
    matrix: Array | None  # (4, 4) or (V, 4, 4) transform that places them; None if they stay
    faces: Indices  # (F, 3) triangles, counter-clockwise seen from outside once they are placed

    @property
    def turn(self) -> Array:
        """(3, 3) or (V, 3, 3) linear part, which acts on displacements."""
        return np.eye(3) if self.matrix is None else self.matrix[..., :3, :3]

    @property
    def points(self) -> Array:
        """(V, 3) vertices where they are shown."""
        if self.matrix is None:
            return self.local
        return self.turned(self.local) + self.matrix[..., :3, 3]

    def turned(self, moves: Array) -> Array:
        """Displacements (…, V, 3) from the file's axes to the scene's."""
        return np.asarray((self.turn @ moves[..., None])[..., 0])

    def returned(self, moves: Array) -> Array:
        """Displacements (…, V, 3) from the scene's axes to the file's."""
        return np.asarray((np.linalg.inv(self.turn) @ moves[..., None])[..., 0])


def placed_parts(glb: Glb) -> Iterator[Placed]:
    """The primitives with triangles of a file's scene, in the order in which :func:`read_glb` joins them."""
    materials, nodes = glb.entries("materials"), placed_nodes(glb)
    read: dict[int, list[tuple[dict[str, Any], Array, Indices]]] = {}  # several nodes may show a mesh
    skins: dict[int, Array] = {}
    skinned: dict[tuple[int, int], Array | None] = {}
    for mesh, node in _shown(glb, nodes):
        entry = {} if node < 0 else glb.entry("nodes", node)
        if mesh not in read:
            read[mesh] = [
                (primitive, local := glb.positions(primitive), glb.triangles(primitive, len(local)))
                for primitive in glb.primitives(mesh)
            ]
        for primitive, local, faces in read[mesh]:
            if not len(faces):
                continue  # points and lines
            matrix = nodes.get(node)
            if "skin" in entry and "JOINTS_0" in attributes(primitive):
                number = whole_number(entry, "skin")
                if number not in skins:
                    skins[number] = _stands(glb, number, nodes)
                if len(skins[number]):
                    key = number, id(primitive)
                    if key not in skinned:
                        skinned[key] = _skinned(glb, skins[number], primitive, len(local))
                    matrix = skinned[key]
            # A scale below zero turns a mesh inside out; its triangles are reversed so that they face outwards again. A
            # skin has a matrix per vertex, of which the mean decides.
            mirrored = matrix is not None and np.linalg.det(matrix[..., :3, :3].reshape(-1, 3, 3).mean(axis=0)) < 0
            index = primitive.get("material")
            material = materials[index] if type(index) is int and 0 <= index < len(materials) else {}
            holders = (entry, glb.entry("meshes", mesh), material)
            names = tuple(dict.fromkeys(n for holder in holders if isinstance(n := holder.get("name"), str) and n))
            yield Placed(mesh, node, primitive, names, material, local, matrix, faces[:, ::-1] if mirrored else faces)


def read_glb(data: bytes, source: object) -> Mesh:
    """All meshes of a file's scene as one, each where its nodes and skins place it."""
    glb = Glb(data, source)
    points, faces, colours, before = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [], 0
    for part in placed_parts(glb):
        points.append(part.points)
        faces.append(part.faces + before)
        colours.append(_colours(glb, part))
        before += len(part.local)
    vertices, triangles = np.concatenate(points), np.concatenate(faces).astype(np.int32)
    if all(colour is None for colour in colours):
        return Mesh(vertices, triangles)
    tints = [
        np.broadcast_to(PLAIN if colour is None else colour, one.shape)
        for colour, one in zip(colours, points[1:], strict=True)
    ]
    return Mesh(vertices, triangles, np.concatenate(tints))


def _colours(glb: Glb, part: Placed) -> Any:  # noqa: ANN401 - sRGB bytes (V, 3) or (3,), or None
    color = attributes(part.primitive).get("COLOR_0")
    tint: list[float] | None = None
    if "material" in part.primitive:  # its colour is multiplied with the vertices', as light
        look = part.material.get("pbrMetallicRoughness", {})
        if not isinstance(look, dict) or "baseColorTexture" in look:
            return None
        tint = look.get("baseColorFactor", None if color is None else [1, 1, 1, 1])
        if not isinstance(tint, list) or len(tint) != 4:
            return None
        if not all(type(value) in (int, float) and 0 <= value <= 1 for value in tint):
            return None
        if color is None:
            return np.rint(255 * to_srgb(tint[:3])).astype(np.uint8)
    if color is None:
        return None
    form = "VEC4" if glb.entry("accessors", color).get("type") == "VEC4" else "VEC3"
    values = glb.numbers(color, form, ("f4", "u1", "u2"), len(part.local))[:, :3]
    scale = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    shares = np.clip(np.nan_to_num(values / scale), 0, 1)
    # Without a material they were written by tools such as trimesh, which leave them as screens show them.
    return np.rint(255 * (shares if tint is None else to_srgb(shares * tint[:3]))).astype(np.uint8)


def _shown(glb: Glb, nodes: dict[int, Array | None]) -> list[tuple[int, int]]:
    """The scene's meshes with the nodes that show them, -1 in a file without nodes."""
    if not glb.entries("nodes"):
        return [(index, -1) for index in range(len(glb.entries("meshes")))]
    return [(whole_number(entry, "mesh"), index) for index in nodes if "mesh" in (entry := glb.entry("nodes", index))]


def placed_nodes(glb: Glb) -> dict[int, Array | None]:
    """The scene's nodes, and the matrices (4, 4) that place them, None for one that stays."""
    scenes, nodes = glb.entries("scenes"), glb.entries("nodes")
    if scenes:
        roots = glb.entry("scenes", glb.content.get("scene", 0)).get("nodes", [])
    else:
        # A file without scenes shows its roots: the nodes that are below no other one.
        below = {child for node in nodes for child in node.get("children", []) if type(child) is int}
        roots = [index for index in range(len(nodes)) if index not in below]
    if not nodes:
        return {}
    placed: dict[int, Array | None] = {}
    queue: list[tuple[Any, Array | None]] = [(root, None) for root in roots]
    while queue:
        index, parent = queue.pop()
        node = glb.entry("nodes", index)
        if index in placed:
            raise ValueError(f"its node {index} is below two others, or below itself")
        local = node_matrix(node)
        placed[index] = local if parent is None else parent if local is None else parent @ local
        queue += [(child, placed[index]) for child in node.get("children", [])]
    return placed


def _stands(glb: Glb, index: int, nodes: dict[int, Array | None]) -> Array:
    """(J, 4, 4) where the joints of a skin put its vertices; (0, 4, 4) if they are not in the scene."""
    skin = glb.entry("skins", index)
    joints = skin.get("joints", [])
    if not joints or not all(type(joint) is int and joint in nodes for joint in joints):
        return np.zeros((0, 4, 4))
    # A joint's matrix times its inverse bind matrix is the identity in the pose that the skin was bound in.
    placed = np.stack([np.eye(4) if (matrix := nodes[joint]) is None else matrix for joint in joints])
    if "inverseBindMatrices" not in skin:
        return placed
    binds = glb.numbers(skin["inverseBindMatrices"], "MAT4", ("f4",))
    # glTF stores matrices column by column.
    return placed @ binds[: len(joints)].reshape(len(joints), 4, 4).transpose(0, 2, 1).astype(np.float64)


def _skinned(glb: Glb, stands: Array, primitive: dict[str, Any], count: int) -> Array | None:
    """The transform of a skinned primitive, in place of its node's: (4, 4), (V, 4, 4), or None."""
    mean = stands.mean(axis=0)
    if np.abs(stands - mean).max() <= ALIKE * np.abs(mean).max():
        return None if np.abs(mean - np.eye(4)).max() <= ALIKE else mean
    accessors = attributes(primitive)
    placed, total = np.zeros((count, 4, 4)), np.zeros(count)
    for k in range(MOST_SETS):
        if f"JOINTS_{k}" not in accessors:
            break
        slots = glb.numbers(accessors[f"JOINTS_{k}"], "VEC4", JOINTS, count).astype(np.int64)
        shares = glb.numbers(accessors.get(f"WEIGHTS_{k}"), "VEC4", WEIGHTS, count).astype(np.float64)
        for slot, share in zip(slots.T, shares.T, strict=True):
            placed += share[:, None, None] * stands[slot]
            total += share
    # Vertices without any weight would collapse into the origin; as in the common viewers, the first joint takes
    # them.
    unweighted = ~(total > 0)
    placed[unweighted], total[unweighted] = stands[0], 1.0
    return np.asarray(placed / total[:, None, None])


def node_matrix(node: dict[str, Any]) -> Array | None:
    """A node's transform (4, 4); None if it has none."""
    if not {"matrix", "translation", "rotation", "scale"} & node.keys():
        return None

    def given(key: str, default: list[float]) -> Array:
        values = np.array(node.get(key, default), np.float64).reshape(len(default))
        if not in_range(values):
            raise ValueError(f"the {key} of a node is not finite, or beyond {COORDINATE:g}")
        return values

    matrix = given("matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T.copy()
    rotation = given("rotation", [0, 0, 0, 1])
    x, y, z, w = rotation / max(float(np.linalg.norm(rotation)), 1e-30)
    turn = np.eye(4)
    turn[:3, :3] = np.eye(3) + 2 * np.array(
        [[-y * y - z * z, x * y - z * w, x * z + y * w], [x * y + z * w, -x * x - z * z, y * z - x * w],
         [x * z - y * w, y * z + x * w, -x * x - y * y]]
    )  # fmt: skip
    move = np.eye(4)
    move[:3, 3] = given("translation", [0, 0, 0])
    return np.asarray(matrix @ move @ turn @ np.diag([*given("scale", [1, 1, 1]), 1.0]))
