"""An animation played by an avatar's own shapes and bones: tracks are added to its .glb, and all else in it stays.

Shapes are ARKit's, Oculus' visemes, or the vowels and blinks of VRM: by the names of targets, as exporters write them
into ``mesh.extras.targetNames``, or as VRM's extensions (``VRM`` 0.x and ``VRMC_vrm`` 1.0) bind expressions.
"""

from __future__ import annotations

import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, Weights, arkit_weights, has_arkit_weights, solve
from facediff.editing.shapes import ShapeSet
from facediff.errors import FaceDiffError, damaged
from facediff.export.glb import gltf_rotations
from facediff.export.glb_added import open_to_add, parts_of
from facediff.export.glb_writer import GlbWriter
from facediff.mesh.glb import POSITIONS, Glb, open_glb, whole_number
from facediff.mesh.glb_scene import node_matrix, placed_nodes
from facediff.mesh.glb_shapes import target_names
from facediff.spaces.arkit import ARKIT, arkit_name, plain
from facediff.spaces.files.csv_files import gaze
from facediff.spaces.rotations import convert, matrices
from facediff.spaces.visemes import OCULUS, VRM

Array = npt.NDArray[np.float64]
Kind = Literal["ARKit", "Oculus", "VRM"]

REMEDY = "not a readable GLB mesh, export it again"
JAW = np.deg2rad(25.0)
"""Turn of a jaw's bone at a weight of 1 of jawOpen, where no shape opens the mouth."""
ROUND_ABOUT = (-1.0, 1.0, -1.0)
"""Signs of a turn's axis for an avatar that looks along -z."""
ENOUGH = {"Oculus": 8, "VRM": 3}
"""Least number of visemes of a set that make it the avatar's."""
BONES = {
    "head": r"head",
    "neck": r"neck",
    "left_eye": r"lefteye|eyeleft|leye|eyel|lfaceeye",
    "right_eye": r"righteye|eyeright|reye|eyer|rfaceeye",
    "jaw": r"jaw",
}
"""Names of bones, without case and punctuation, between a rig's prefix and ``joint``, ``jnt`` or ``bone``."""
VOWELS = {"aa": "A", "ih": "I", "ou": "U", "ee": "E", "oh": "O", **{name.lower(): name for name in VRM}}
RENAMED = {"i": "ih", "o": "oh", "u": "ou"}  # Ready Player Me's spelling of Oculus' vowels
LIDS = {"": ("blink", "eyesclosed", "fcleyeclose"), "Left": ("blinkl", "blinkleft", "fcleyeclosel")}
LIDS["Right"] = ("blinkr", "blinkright", "fcleyecloser")
BLINK = "blink"  # Both lids, where an avatar has no shape for one


@dataclass(frozen=True)
class ShapeBinding:
    """A target that a shape moves: its mesh, its number, and its weight at a weight of 1 of the shape."""

    mesh: int
    target: int
    share: float = 1.0


@dataclass(frozen=True)
class OwnShapes:
    """The shapes and bones of an avatar that an animation can drive."""

    kind: Kind  # naming scheme of the mouth's shapes
    binds: dict[str, list[ShapeBinding]]  # by shape: ARKit's names, visemes, and ``blink`` for both lids
    bones: dict[str, int]  # numbers of nodes by the part that they turn
    names: dict[str, str]  # of these nodes

    @property
    def summary(self) -> str:
        """The shapes and bones in a sentence."""
        meshes = {bind.mesh for binds in self.binds.values() for bind in binds}
        bones = ", ".join(self.names.values())
        return (
            f"{len(self.binds)} shapes of its own ({self.kind}) in {len(meshes)} meshes play it; bones for head, jaw "
            f"and gaze: {bones or 'none'}. --carry moves its surface instead"
        )

    def left_out(self, animation: Animation) -> list[str]:
        """A sentence for each motion of head or jaw that stays out of the avatar's."""
        notes = []
        if animation.head is not None and {"head", "neck"}.isdisjoint(self.bones):
            notes.append("the head's motion is left out, since there is no bone for it; call one Head or Neck")
        if "jaw" in self.bones and not has_arkit_weights(animation):
            notes.append("the jaw's bone stays still, since this motion is of vertices; --carry moves the surface")
        return [f"note: {note}" for note in notes]


def own_shapes(target: Path) -> OwnShapes:
    """The shapes and bones of an avatar by their names."""
    with damaged(target, REMEDY):
        return _own_shapes(open_glb(target))


def shapes_to_drive(target: Path, output: Path) -> OwnShapes | None:
    """The shapes and bones of an avatar that play a motion in a file; None if one of both has no place for them."""
    if target.suffix.lower() == output.suffix.lower() == ".glb":
        with suppress(FaceDiffError):
            return own_shapes(target)
    return None


def drive_avatar(path: Path, target: Path, animation: Animation) -> None:
    """Write a copy of an avatar that plays an animation by its own shapes and bones.

    Weights go by name where the animation has ARKit's, or is of the built-in face, which has shapes under these names;
    else the avatar's own shapes are solved for, for which the animation must be on the avatar's mesh. Visemes are
    computed from ARKit's weights. A head's motion turns the bone of the head, or else of the neck; eyes turn by their
    bones where no shape lets them look, a jaw where no shape opens the mouth.

    Args:
        path: the file to write.
        target: the avatar; its face looks along +z as glTF has it, or along -z as VRM 0.x has it.
        animation: of any face with ARKit's shapes, or on the avatar's mesh.
    """
    with damaged(target, REMEDY):
        glb, writer = open_to_add(target)
        shapes = _own_shapes(glb)
        by_name = has_arkit_weights(animation)
        weights = arkit_weights(animation) if by_name else _solved(glb, shapes, animation)
        if by_name and _looks_back(glb) and weights.head is not None:  # solved for, it is in the avatar's axes already
            weights = replace(weights, head=weights.head * ROUND_ABOUT)
        _animate(glb, writer, shapes, _for_avatar(shapes, weights), weights, animation.name)
    writer.write(path)


def _looks_back(glb: Glb) -> bool:
    """Whether the face looks along -z, as in VRM 0.x."""
    extensions = glb.content.get("extensions", {})
    return "VRM" in extensions and "VRMC_vrm" not in extensions


def _own_shapes(glb: Glb) -> OwnShapes:
    targets: list[tuple[int, int, str]] = []
    for mesh in range(len(glb.entries("meshes"))):
        targets += [(mesh, index, name) for index, name in enumerate(target_names(glb, mesh))]
    arkit: dict[str, list[ShapeBinding]] = defaultdict(list)
    oculus: dict[str, list[ShapeBinding]] = defaultdict(list)
    vrm: dict[str, list[ShapeBinding]] = defaultdict(list)
    lids: dict[str, list[ShapeBinding]] = defaultdict(list)
    for mesh, index, name in targets:
        bind, suffix = ShapeBinding(mesh, index), re.split(r"[_.:| ]", name)[-1]
        named = re.search(r"(?i)viseme|v_", name)
        if (shape := arkit_name(name)) is not None:
            arkit[shape].append(bind)
        elif named or suffix in OCULUS:
            viseme = next((n for n in OCULUS if n.lower() == RENAMED.get(suffix.lower(), suffix.lower())), None)
            if viseme is not None:
                oculus[viseme].append(bind)
        # Both sets have an E; whichever is whole is the avatar's.
        alone = len(name) == len(suffix) or re.search(r"(?i)mth|mouth|vowel", name)
        if shape is None and not named and suffix.lower() in VOWELS and alone:
            vrm[VOWELS[suffix.lower()]].append(bind)
        for side, spellings in LIDS.items():
            if plain(name) in spellings:
                lids[f"eyeBlink{side}" if side else BLINK].append(bind)
    bound = _expressions(glb)
    for name, bound_targets in bound.items():
        (vrm if name in VRM else lids)[name] = bound_targets
    bones = _bones(glb)
    sets: dict[Kind, dict[str, list[ShapeBinding]]] = {"ARKit": arkit, "Oculus": oculus, "VRM": vrm}
    has_mouth: dict[Kind, bool] = {
        "ARKit": "jawOpen" in arkit or ("jaw" in bones and len(arkit) > len(ARKIT) // 3),
        "Oculus": len(oculus) >= ENOUGH["Oculus"],
        "VRM": len(vrm) >= ENOUGH["VRM"],
    }
    # A jaw beside visemes is no mouth of ARKit.
    kinds: tuple[Kind, ...] = ("Oculus", "VRM")
    order = ("ARKit", *kinds) if any(name.startswith("mouth") for name in arkit) else (*kinds, "ARKit")
    kind = next((one for one in order if has_mouth[one]), None)
    if kind is None:
        raise FaceDiffError(
            f"{glb.source}: has no shapes for a mouth under names of ARKit (jawOpen …), Oculus (viseme_aa …) or VRM "
            f"(A, I, U, E, O); rename them"
        )
    # Lids and brows under ARKit's names belong to any avatar's face; its mouth is one set's.
    upper = {name: binds for name, binds in arkit.items() if name.startswith(("eye", "brow"))}
    binds = {**sets[kind], **upper}
    sides = [name for name in ("eyeBlinkLeft", "eyeBlinkRight") if name not in binds]
    if sides and all(name in lids for name in sides):
        binds |= {name: lids[name] for name in sides}
    elif sides and BLINK in lids:
        binds[BLINK] = lids[BLINK]
    looks = any(name.startswith("eyeLook") for name in binds)
    unused = {"left_eye", "right_eye"} if looks else set()
    unused |= {"jaw"} if kind != "ARKit" or "jawOpen" in binds else set()
    unused |= {"neck"} if "head" in bones else set()
    bones = {name: node for name, node in bones.items() if name not in unused}
    return OwnShapes(kind, binds, bones, {name: str(glb.entry("nodes", node)["name"]) for name, node in bones.items()})


def _expressions(glb: Glb) -> dict[str, list[ShapeBinding]]:
    """Targets of VRM's vowels and blinks as the extension of either version binds them."""
    extensions = glb.content.get("extensions", {})
    lids = {"blink": BLINK, "blinkl": "eyeBlinkLeft", "blinkr": "eyeBlinkRight"}
    lids |= {"blinkleft": "eyeBlinkLeft", "blinkright": "eyeBlinkRight"}
    result: dict[str, list[ShapeBinding]] = {}
    for group in extensions.get("VRM", {}).get("blendShapeMaster", {}).get("blendShapeGroups", []):
        name = plain(str(group.get("presetName", "")))
        if shape := VOWELS.get(name) or lids.get(name):
            # Version 0.x counts weights from 0 to 100, and names meshes.
            result[shape] = [
                ShapeBinding(b["mesh"], b["index"], float(b["weight"]) / 100) for b in group.get("binds", [])
            ]
    for preset, expression in extensions.get("VRMC_vrm", {}).get("expressions", {}).get("preset", {}).items():
        if shape := VOWELS.get(plain(preset)) or lids.get(plain(preset)):
            result[shape] = [
                ShapeBinding(whole_number(glb.entry("nodes", b["node"]), "mesh"), b["index"], float(b["weight"]))
                for b in expression.get("morphTargetBinds", [])
            ]
    return {name: binds for name, binds in result.items() if binds}


def _bones(glb: Glb) -> dict[str, int]:
    """Numbers of the scene's nodes by the part that they turn; joints of skins first, and no nodes with a mesh."""
    joints = {joint for skin in glb.entries("skins") for joint in skin.get("joints", []) if type(joint) is int}
    scene = placed_nodes(glb)
    order = sorted(scene, key=lambda node: (node not in joints, node))
    result: dict[str, int] = {}
    for node in order:
        entry = glb.entry("nodes", node)
        name = plain(str(entry.get("name", "")))
        for bone, pattern in BONES.items():
            fits = re.fullmatch(rf".*(?<!fore)(?:{pattern})(?:joint|jnt|bone)?", name)
            if fits and "mesh" not in entry and bone not in result:
                result[bone] = node
    return result


def _solved(glb: Glb, avatar: OwnShapes, animation: Animation) -> Weights:
    """Weights of the avatar's own shapes that come nearest to an animation of its mesh."""
    parts, animation = parts_of(glb, animation)
    total = len(animation.template)
    deltas, first = np.zeros((len(avatar.binds), total, 3)), 0
    for part in parts:
        targets = glb.entries("targets", part.primitive)
        for k, binds in enumerate(avatar.binds.values()):
            for bind in binds:
                if bind.mesh == part.mesh and "POSITION" in (target := targets[bind.target] if targets else {}):
                    moves = glb.numbers(target["POSITION"], "VEC3", POSITIONS, len(part.local)).astype(np.float64)
                    deltas[k, first : first + len(part.local)] += bind.share * part.turned(moves)
        first += len(part.local)
    shapes = ShapeSet(tuple(avatar.binds), np.asarray(animation.template, np.float64), deltas)
    return solve(animation, shapes, SolveOptions(residual_limit=1.0))


def _for_avatar(avatar: OwnShapes, weights: Weights) -> dict[str, Array]:
    """Weights (T,) of the avatar's shapes, by their names."""
    tracks = dict(zip(weights.names, weights.values.T, strict=True))
    if avatar.kind != "ARKit" and not any(name in tracks for name in avatar.binds if name in (*OCULUS, *VRM)):
        visemes = weights.tracks("oculus" if avatar.kind == "Oculus" else "vrm")
        tracks |= dict(zip(visemes.names, visemes.values.T, strict=True))
    lids = [tracks[name] for name in ("eyeBlinkLeft", "eyeBlinkRight") if name in tracks]
    if BLINK not in tracks and lids:
        tracks[BLINK] = np.mean(lids, axis=0)
    return {name: np.clip(tracks[name], 0.0, 1.0) for name in avatar.binds if name in tracks}


def _animate(
    glb: Glb, writer: GlbWriter, avatar: OwnShapes, tracks: dict[str, Array], weights: Weights, name: str
) -> None:
    frames = len(weights.values)
    times = writer.add((np.arange(frames) / weights.frame_rate).astype(np.float32), bounds=True)
    motion: dict[str, Any] = {"name": name, "samplers": [], "channels": []}
    samplers: dict[bytes, int] = {}  # Head, teeth and lashes often have the same targets

    def add(node: int, path: str, values: npt.NDArray[np.float32]) -> None:
        key = path.encode() + values.tobytes()
        if key not in samplers:
            output = writer.add(values.ravel() if path == "weights" else values)
            motion["samplers"].append({"input": times, "output": output, "interpolation": "LINEAR"})
            samplers[key] = len(motion["samplers"]) - 1
        motion["channels"].append({"sampler": samplers[key], "target": {"node": node, "path": path}})

    by_mesh: dict[int, list[tuple[str, ShapeBinding]]] = defaultdict(list)
    for shape in tracks:
        for bind in avatar.binds[shape]:
            by_mesh[bind.mesh].append((shape, bind))
    for node, entry in enumerate(glb.entries("nodes")):
        if entry.get("mesh") not in by_mesh:
            continue
        binds, mesh = by_mesh[entry["mesh"]], glb.entry("meshes", entry["mesh"])
        count = max(len(glb.entries("targets", primitive)) for primitive in glb.primitives(entry["mesh"]))
        rest = np.array(entry.get("weights", mesh.get("weights", [0.0] * count)), np.float64)
        rows = np.tile(rest, (frames, 1))
        driven = [bind.target for _, bind in binds]
        rows[:, driven] = 0.0
        for shape, bind in binds:
            rows[:, bind.target] += bind.share * tracks[shape]
        rows[:, driven] = np.clip(rows[:, driven], 0.0, 1.0)
        add(node, "weights", rows.astype(np.float32))
    for node, turns in _turns(avatar, weights, _looks_back(glb)):
        add(node, "rotation", _local(glb, node, turns))
    if motion["channels"]:
        glb.put_first(motion)


def _turns(avatar: OwnShapes, weights: Weights, looks_back: bool) -> list[tuple[int, Array]]:
    """Nodes and the quaternions (T, 4) by which they turn about the scene's axes."""
    none = np.zeros(len(weights.values))
    round_about = np.array([1.0, *ROUND_ABOUT]) if looks_back else np.ones(4)
    result = []
    for bone in ("head", "neck"):
        if bone in avatar.bones and weights.head is not None:
            result.append((avatar.bones[bone], convert(weights.head, "axis_angle", "quaternion")))
    eyes = weights.eyes
    if eyes is None and any(name.startswith("eyeLook") for name in weights.names):
        eyes = gaze(weights.names, weights.values)
    for k, bone in enumerate(("left_eye", "right_eye")):
        if bone in avatar.bones and eyes is not None:
            turns = convert(eyes[:, 3 * k : 3 * k + 3], "euler", "quaternion")
            result.append((avatar.bones[bone], round_about * turns))
    if "jaw" in avatar.bones and "jawOpen" in weights.names:
        opening = JAW * weights.values[:, weights.names.index("jawOpen")]
        turns = convert(np.stack([opening, none, none], 1), "axis_angle", "quaternion")
        result.append((avatar.bones["jaw"], round_about * turns))
    return result


def _local(glb: Glb, node: int, turns: Array) -> npt.NDArray[np.float32]:
    """Rotations (T, 4) x, y, z, w of a node which turn it by some (T, 4) w, x, y, z about the scene's axes."""
    nodes, placed = glb.entries("nodes"), placed_nodes(glb)
    parent = next((index for index, entry in enumerate(nodes) if node in entry.get("children", [])), None)
    above = None if parent is None else placed[parent]
    transform = node_matrix(nodes[node])
    frame, rest = (np.eye(3) if matrix is None else _rotation(matrix[:3, :3]) for matrix in (above, transform))
    if "matrix" in nodes[node]:  # which a node must not have where its rotation is animated
        assert transform is not None  # noqa: S101 - for type checkers
        del nodes[node]["matrix"]
        scale = np.linalg.norm(transform[:3, :3], axis=0)
        nodes[node] |= {
            "translation": transform[:3, 3].tolist(),
            "scale": scale.tolist(),
            "rotation": _quaternion(rest),
        }
    local = frame.T @ matrices(turns) @ frame @ rest
    quaternions = convert(np.concatenate([local[..., 0], local[..., 1]], axis=-1), "six_d", "quaternion")
    return gltf_rotations(quaternions)


def _rotation(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix, without its scale."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right)


def _quaternion(rotation: Array) -> list[float]:
    """X, y, z, w of a matrix."""
    six = np.concatenate([rotation[:, 0], rotation[:, 1]])
    return [float(value) for value in np.roll(convert(six[None], "six_d", "quaternion")[0], -1)]
