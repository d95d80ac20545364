"""A whole avatar as a .glb: parts, skeleton, texture, ARKit's 52 targets and an animation of its own.

It is laid out as characters from elsewhere are: the parts hang below an armature that is scaled and turned, and a skin
puts them where they are seen; teeth and head have the same targets, and some targets are sparse.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from tests.fakes.glb_targets import File
from tests.fakes.heads import cleaned, eyeballs, teeth
from tests.fakes.small_face import M2, Shape, build_face, small_shapes


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) of length one."""
    made = np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    made[np.linalg.norm(made, axis=1) < 0.5] = [0, 0, 1]
    return made / np.linalg.norm(made, axis=1, keepdims=True)


@dataclass
class AvatarPart:
    """One mesh of the avatar as it is seen, in metres with y up."""

    vertices: np.ndarray
    faces: np.ndarray
    targets: dict[str, np.ndarray] = field(default_factory=dict)
    joint: int = 1


@lru_cache(maxsize=2)
def avatar_parts(shape: Shape = M2, *, rounds: int = 1) -> dict[str, AvatarPart]:
    """Body, head, eyes, teeth, tongue and hair of a figure 1.7 m tall whose head has ARKit's shapes."""
    mesh = build_face()
    rest, faces, shapes = small_shapes(shape)
    gone = np.zeros(len(rest), bool)
    gone[mesh.both("teeth", "eyeball", "pupil")] = True
    faces = faces[~gone[faces].any(axis=1)]

    def cut(points: np.ndarray) -> np.ndarray:
        points, corners = cleaned(points, faces)
        return trimesh.remesh.subdivide_loop(points, corners, rounds)[0] if rounds else points

    corners = cleaned(rest, faces)[1]
    head_faces = trimesh.remesh.subdivide_loop(cleaned(rest, faces)[0], corners, rounds)[1] if rounds else corners
    at_rest = cut(rest)
    targets = {name: cut(points) - at_rest for name, points in shapes.items()}
    jaw = shapes["jawOpen"] - rest
    lower = jaw[mesh.both("teeth_lower_0")].mean(axis=0)
    rows = teeth(shape)
    upper_row, lower_row, tongue = (rows[name] for name in ("teeth_upper", "teeth_lower", "tongue"))
    row = np.concatenate([upper_row[0], lower_row[0]])
    opened = np.zeros_like(row)
    opened[len(upper_row[0]) :] = lower
    ball = trimesh.creation.icosphere(3)
    shell = np.array(ball.vertices) * [0.083, 0.085, 0.105] + [0, 0.066, -0.018]
    keep = (shell[:, 2] < 0.055) & (shell[:, 1] > -0.02)
    torso = trimesh.creation.capsule(height=0.9, radius=0.16, count=[16, 16])
    body = np.array(torso.vertices)[:, [0, 2, 1]] * [1, 1, -0.7]
    body -= [0, body[:, 1].max() + 0.13, 0.02]
    eyes = eyeballs(shape, 2)
    raised = np.array([0.0, 1.6, 0.0])
    made = {
        "Body": AvatarPart(body, np.array(torso.faces), joint=0),
        "Head": AvatarPart(at_rest, np.asarray(head_faces), targets),
        "Teeth": AvatarPart(row, np.concatenate([upper_row[1], lower_row[1] + len(upper_row[0])]), {"jawOpen": opened}),
        "Tongue": AvatarPart(*tongue, {"jawOpen": np.tile(lower, (len(tongue[0]), 1))}),
        "EyeLeft": AvatarPart(*eyes["eye_l"]),
        "EyeRight": AvatarPart(*eyes["eye_r"]),
        "Hair": AvatarPart(*cleaned(shell, np.array(ball.faces)[keep[ball.faces].all(axis=1)])),
    }
    for part in made.values():
        part.vertices = part.vertices + raised
    # All parts with targets have the same ones, as exporters write them.
    for name in ("Teeth", "Tongue"):
        still = np.zeros_like(made[name].vertices)
        made[name].targets = {each: made[name].targets.get(each, still) for each in targets}
    return made


Y_UP_TO_Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])


def write_avatar(
    path: Path,
    parts: dict[str, AvatarPart] | None = None,
    *,
    unit: float = 100.0,
    z_up: bool = True,
    skinned: bool = True,
    posed: bool = False,
    sparse: bool = True,
    animated: bool = True,
    names: dict[str, str] | None = None,
    joined: bool = False,
    skins: int = 1,
    quantised: bool = False,
) -> dict[str, AvatarPart]:
    """Write an avatar.

    Args:
        path: the file.
        parts: those of :func:`avatar_parts` if None.
        unit: how many of the units of the file's vertices are a metre; the armature's scale undoes it.
        z_up: whether the vertices have z up; the armature's rotation undoes it.
        skinned: whether a skin puts the parts into place; else the armature does.
        posed: whether the head is stored nodding and the skin blends it into the spine, so that each vertex is placed
            by a matrix of its own.
        sparse: whether the targets are sparse accessors.
        animated: whether the file has an animation of joints and of the head's weights.
        names: other names of the targets.
        joined: all parts with targets are primitives of one mesh, as FBX converters write them.
        skins: how many skins the parts take in turn.
        quantised: positions are normalised whole numbers by KHR_mesh_quantization, and each node's scale undoes it.
    """
    parts = parts or avatar_parts()
    file = File()
    content = file.content
    turn = Y_UP_TO_Z_UP if z_up else np.eye(3)
    root: dict[str, Any] = {"name": "Armature", "scale": [1 / unit] * 3, "children": [1]}
    if z_up:
        root["rotation"] = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    nodes: list[dict[str, Any]] = [
        root,
        {"name": "Spine", "children": [2]},
        {"name": "HeadJoint", "translation": (unit * turn @ [0, 1.5, 0]).tolist()},
    ]
    if posed:
        nodes[2]["rotation"] = [np.sin(0.2), 0.0, 0.0, np.cos(0.2)]
    placed = np.eye(4)
    placed[:3, :3] = turn.T / unit
    joint = placed.copy()
    joint[:3, 3] = [0, 1.5, 0]
    # The inverse bind matrices take the vertices, which are in the armature's frame, to each joint's.
    binds = np.stack([np.linalg.inv(each) @ placed for each in (placed, joint)])
    content["nodes"], content["meshes"], content["scene"] = nodes, [], 0
    checks = np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((4, 4)))[..., None] * [60, 40, 40] + [180, 150, 140]
    Image.fromarray(checks.astype(np.uint8)).save(png := io.BytesIO(), "PNG")
    content["images"] = [{"name": "skin", "mimeType": "image/png", "bufferView": file.view(png.getvalue())}]
    content["samplers"] = [{"magFilter": 9729, "minFilter": 9987}]
    content["textures"] = [{"source": 0, "sampler": 0}]
    content["materials"] = [
        {
            "name": f"{name}Material",
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0},
                "metallicFactor": 0.1 * k,
                "roughnessFactor": 0.6,
            },
            "doubleSided": True,
            "extras": {"shader": name},
        }
        for k, name in enumerate(parts)
    ]
    if skinned:
        matrices = binds.transpose(0, 2, 1).reshape(2, 16).astype(np.float32)
        content["skins"] = [
            {"joints": [1, 2], "skeleton": 1, "inverseBindMatrices": file.add(matrices, "MAT4")} for _ in range(skins)
        ]
    whole: dict[str, Any] | None = None
    for k, (name, part) in enumerate(parts.items()):
        points = (unit * part.vertices @ turn.T).astype(np.float32)
        normals = normals_of(part.vertices, part.faces) @ turn.T
        most = float(np.abs(points).max()) if quantised else 1.0
        whole_numbers = np.rint(points / most * 32767).astype(np.int16) if quantised else points
        attributes = {
            "POSITION": file.add(whole_numbers, "VEC3", bounds=True, target=34962),
            "NORMAL": file.add(normals.astype(np.float32), "VEC3", target=34962),
            "TEXCOORD_0": file.add((part.vertices[:, :2] % 1).astype(np.float32), "VEC2", target=34962),
        }
        if skinned:
            slots = np.zeros((len(points), 4), np.uint8)
            slots[:, :2] = part.joint, 0
            weights = np.zeros((len(points), 4), np.float32)
            height = part.vertices[:, 1] - part.vertices[:, 1].min()
            # A vertex has a joint once, as the validator of glTF asks: the body has the spine alone.
            weights[:, 0] = 0.5 + 0.5 * height / height.max() if posed and part.joint else 1
            weights[:, 1] = 1 - weights[:, 0]
            attributes |= {
                "JOINTS_0": file.add(slots, "VEC4", target=34962),
                "WEIGHTS_0": file.add(weights, "VEC4", target=34962),
            }
        indices = file.add(part.faces.astype(np.uint16).ravel(), "SCALAR", target=34963)
        primitive: dict[str, Any] = {"attributes": attributes, "indices": indices, "material": k}
        if part.targets:
            primitive["targets"] = [
                {
                    "POSITION": file.add(
                        (unit / most * d @ turn.T).astype(np.float32), "VEC3", bounds=True, sparse=sparse
                    )
                }
                for d in part.targets.values()
            ]
        labels = [(names or {}).get(target, target) for target in part.targets]
        if joined and part.targets and whole is not None:
            whole["primitives"].append(primitive)
            continue
        mesh: dict[str, Any] = {"name": f"{name}Mesh", "primitives": [primitive]}
        if part.targets:
            mesh |= {"weights": [0.0] * len(labels), "extras": {"targetNames": labels}}
            whole = whole or mesh
        content["meshes"].append(mesh)
        nodes.append({"name": name, "mesh": len(content["meshes"]) - 1, **({"skin": k % skins} if skinned else {})})
        if quantised:
            nodes[-1]["scale"] = [most] * 3
        root["children"].append(len(nodes) - 1)
    roots = [0]
    if skinned:
        # A skinned mesh's own node does not place it, and is best a root.
        own = [index for index, node in enumerate(nodes) if "skin" in node]
        root["children"] = [1]
        roots += own
    content["scenes"] = [{"name": "Scene", "nodes": roots}]
    if quantised:
        content["extensionsUsed"] = content["extensionsRequired"] = ["KHR_mesh_quantization"]
    if animated:
        times = file.add(np.float32([0, 0.5, 1]), "SCALAR", bounds=True)
        nod = np.float32([[0, 0, 0, 1], [0.0998334, 0, 0, 0.9950042], [0, 0, 0, 1]])
        head = next(index for index, node in enumerate(nodes) if node["name"] == "Head")
        count = len(parts["Head"].targets)
        opened = np.zeros((3, count), np.float32)
        opened[1, list(parts["Head"].targets).index("jawOpen")] = 0.5
        content["animations"] = [
            {
                "name": "idle",
                "samplers": [
                    {"input": times, "output": file.add(nod, "VEC4"), "interpolation": "LINEAR"},
                    {"input": times, "output": file.add(opened.ravel(), "SCALAR"), "interpolation": "LINEAR"},
                ],
                "channels": [
                    {"sampler": 0, "target": {"node": 2, "path": "rotation"}},
                    {"sampler": 1, "target": {"node": head, "path": "weights"}},
                ],
            }
        ]
    file.write(path)
    return parts
