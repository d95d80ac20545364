"""glTF 2.0 in one binary file: a mesh with animated morph targets.

Source: Khronos Group, glTF 2.0 Specification. Metres, y up, the face looks along +z, as the standard prescribes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.animation.animation import stretches_of
from facediff.animation.options import ExportOptions
from facediff.editing.controls.eyelids import puppet_eyes
from facediff.export.format import FileSpace, Format, facts, linear_colours, normals_of, outward, surface_of
from facediff.export.glb_writer import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbWriter
from facediff.export.motion_shapes import BLOCK, Array, Morphs, compress, compress_long
from facediff.mesh.textures import Textures
from facediff.registry import export_format
from facediff.spaces.rotations import convert
from facediff.utils.colours import to_linear

ROUNDING = 1e-5  # Share of a face's size that single precision loses over several steps
LINEAR = "LINEAR"  # Interpolation between keys
LONG_BYTES = 1 << 27  # Motion that is larger is never in memory as a whole


@export_format.register("glb")
class GlbFormat(Format):
    """glTF 2.0 with morph targets, exact or named by weights or --shapes: Blender, Unity, three.js, Unreal."""

    next_step = "Blender: File > Import > glTF 2.0, then play; other programs: docs/export.md"
    speech = "next to it"
    units = "m"
    up_axes = ("y",)
    uses = ("tolerance", "shapes", "key_tolerance", "surface")

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write one animation: all of it, by its own weights where it has some, or weights of the given shapes."""
        (animation,) = animations
        space = FileSpace.of(animation, options, "m")
        head, animation = animation.head, animation.still()
        rest = space.place(animation.template)
        extras = facts(animation, space)
        if options.shapes is not None:
            morphs, fit = named_shapes(animation, space, Path(options.shapes), options.key_tolerance)
            extras |= fit
        elif (weighted := weighted_shapes(animation, space, options.tolerance / 1000)) is not None:
            rest, morphs = weighted
            extras["tolerance_mm"] = options.tolerance
        else:
            morphs = shapes_of_motion(animation, space, rest, options.tolerance / 1000)
            extras["tolerance_mm"] = 0.0 if morphs.components is None else options.tolerance
        if options.speech_file is not None:
            extras["speech"] = options.speech_file
        document = make_document(animation, space, rest, morphs, extras, surface_of(animation, options))
        add_nodes(document, animation.frame_rate, moving_nodes(animation, space, head))
        document.write(path)


def named_shapes(
    animation: Animation, space: FileSpace, shapes: Path, key_tolerance: float
) -> tuple[Morphs, dict[str, object]]:
    """The motion as weights of blendshapes under their own names, and facts on how well they fit."""
    from facediff.editing.blendshapes import SolveOptions, key_frames, solve
    from facediff.editing.shapes import read_shapes

    shape_set = read_shapes(shapes, animation.template, animation.unit)
    weights = solve(animation, shape_set, SolveOptions())
    # All curves of a mesh share their keys in glTF.
    keys = key_frames(weights.values, key_tolerance)
    offsets = np.asarray(shape_set.deltas * space.factor, np.float32)
    morphs = Morphs(offsets, weights.values[keys].astype(np.float32), None, shape_set.names, keys)
    return morphs, {
        "shapes": shapes.name,
        "residual_rms_mm": round(float(np.sqrt(np.square(weights.residual_rms_mm).mean())), 6),
        "residual_max_mm": round(float(weights.residual_max_mm.max()), 6),
        "key_tolerance": key_tolerance,
        "keys": len(keys),
    }


def weighted_shapes(animation: Animation, space: FileSpace, tolerance: float) -> tuple[Array, Morphs] | None:
    """The weights of ARKit's shapes that an animation was made of, and the face (V, 3) where all are 0.

    None if there are no weights, or vertices that are further from their sum than the tolerance, in the unit of the
    file. The animation's head does not move.
    """
    values, deltas = animation.values, animation.deltas
    if values is None or deltas is None or animation.space.kind != "arkit":
        return None
    names = tuple(animation.space.channels[channel] for channel in animation.space.face)
    weights = np.ascontiguousarray(values[:, list(animation.space.face)])
    shapes = np.asarray(deltas * space.factor, np.float32)
    moved = (frame - np.tensordot(row, shapes, 1) for row, frame in zip(weights, space.frames(animation), strict=True))
    rest = next(moved)
    # A person's resting values need not be 0: the template is not always the face of weights 0.
    if np.abs(rest - space.place(animation.template)).max() < ROUNDING * np.ptp(rest):
        rest = space.place(animation.template)
    if any(np.square(pose - rest).sum(-1).max() > tolerance**2 for pose in moved):
        return None
    return rest, Morphs(shapes, weights, None, names)


def shapes_of_motion(animation: Animation, space: FileSpace, rest: Array, tolerance: float) -> Morphs:
    """As few shapes as keep every vertex of every frame within a distance of the original, see :func:`compress`.

    The animation's head does not move; the face at rest (V, 3) and the tolerance are in the unit of the file.
    """
    if len(animation.vertices) * rest.nbytes > LONG_BYTES:

        def parts() -> Iterator[Array]:
            for _, vertices in stretches_of(animation.vertices):
                yield (space.place(vertices) - rest).reshape(len(vertices), -1)

        if (found := compress_long(parts, tolerance)) is not None:
            weights, shapes, components = found
            return Morphs(shapes.reshape(-1, *rest.shape), weights, components)
    return compress(np.stack([frame - rest for frame in space.frames(animation)]), tolerance)


def normal_shapes(weights: Array, rest: Array, normals: Iterable[Array]) -> Array:
    """Offsets of normals (M, V, 3) which, added with the shapes' weights, come nearest to the true normals.

    Normals are no linear function of the vertices, so that the normals of the shapes themselves would not add up. These
    are the least-squares solution over all frames, without weak directions, which would only fit noise.

    Args:
        weights: (T, M).
        rest: (V, 3) normals of the rest face.
        normals: the normals (V, 3) of every frame.
    """
    inverse = pseudo_inverse(weights)
    offsets = np.zeros((weights.shape[1], *rest.shape), np.float32)
    turned, step = iter(normals), 16
    for start in range(0, len(weights), step):
        batch = np.stack([normal - rest for normal in islice(turned, step)])
        offsets += np.tensordot(inverse(slice(start, start + step)), batch, axes=1)
    return offsets


def pseudo_inverse(weights: Array) -> Callable[[slice], Array]:
    """Columns (M, n) of the pseudo-inverse of weights (T, M) for some of the frames, without weak directions."""
    # (WᵀW)⁻¹Wᵀ, whose singular values are the roots of WᵀW's: a few columns at a time take no memory.
    gram = np.zeros((weights.shape[1], weights.shape[1]))
    for first in range(0, len(weights), BLOCK):
        some = weights[first : first + BLOCK].astype(np.float64)
        gram += some.T @ some
    squares, vectors = np.linalg.eigh(gram)
    strong = squares > 1e-4 * squares.max()
    left = (vectors[:, strong] / squares[strong]) @ vectors[:, strong].T
    return lambda frames: (left @ weights[frames].T).astype(np.float32)


def make_document(
    animation: Animation,
    space: FileSpace,
    rest: Array,
    morphs: Morphs,
    extras: dict[str, object],
    surface: Textures | None = None,
) -> GlbWriter:
    """The glTF document of one animated mesh at rest (V, 3), with its arrays."""
    document = GlbWriter({"asset": {"version": "2.0", "generator": "facediff"}})
    if (licence := animation.metadata.get("licence")) is not None:
        document.content["asset"]["copyright"] = licence

    faces = outward(animation)
    if surface is None:
        split, corners, coordinates = np.arange(len(rest)), faces, None
    else:
        # A vertex of glTF has one texture coordinate: at a seam it becomes several.
        pairs = np.stack([faces, surface.turned(animation.triangles, faces)], axis=-1).reshape(-1, 2)
        unique, row_of_corner = np.unique(pairs, axis=0, return_inverse=True)
        split, corners = unique[:, 0], row_of_corner.reshape(-1, 3).astype(np.int32)
        coordinates = (surface.uvs * [1, -1] + [0, 1])[unique[:, 1]].astype(np.float32)  # v downwards

    def add_vertices(positions: Array, normals: Array) -> dict[str, int]:
        return {
            "POSITION": document.add(positions[split], target=ARRAY_BUFFER, bounds=True),
            "NORMAL": document.add(normals[split], target=ARRAY_BUFFER),
        }

    rest_normals = normals_of(rest, faces)
    attributes = add_vertices(rest, rest_normals)
    plain: dict[str, object] = {"metallicFactor": 0.0, "roughnessFactor": 0.7}
    if animation.colours is None:
        plain["baseColorFactor"] = [0.6, 0.6, 0.6, 1.0]
    else:
        attributes["COLOR_0"] = document.add(linear_colours(animation.colours)[split], target=ARRAY_BUFFER)
    if coordinates is not None:
        attributes["TEXCOORD_0"] = document.add(coordinates, target=ARRAY_BUFFER)
    # The largest number of a type is reserved: it restarts a strip of triangles.
    index_type = np.uint16 if len(split) < 65_535 else np.uint32
    of_face = np.zeros(len(corners), int) if surface is None else surface.of_face
    indices = [
        document.add(corners[of_face == number].astype(index_type).ravel(), target=ELEMENT_ARRAY_BUFFER)
        for number in range(int(of_face.max()) + 1)
    ]
    if morphs.names:
        # Named shapes are used for other motions too, so that each has the normals of its own pose.
        normal_offsets = np.stack([normals_of(rest + shape, faces) - rest_normals for shape in morphs.shapes])
    else:
        true_normals = (normals_of(points, faces) for points in space.frames(animation))
        normal_offsets = normal_shapes(morphs.weights, rest_normals, true_normals)
    targets = [add_vertices(shape, normals) for shape, normals in zip(morphs.shapes, normal_offsets, strict=True)]
    prefix = "frame" if morphs.components is None else "shape"
    frames = np.arange(len(animation.vertices)) if morphs.keys is None else morphs.keys
    times = document.add((frames / animation.frame_rate).astype(np.float32), bounds=True)
    document.content |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": animation.name, "mesh": 0, "extras": extras}],
        "meshes": [
            {
                "name": "face",
                "primitives": [
                    {"attributes": attributes, "indices": index, "material": number, "targets": targets}
                    for number, index in enumerate(indices)
                ],
                "weights": [0.0] * len(targets),
                "extras": {
                    "targetNames": list(morphs.names) or [f"{prefix}_{index:04d}" for index in range(len(targets))]
                },
            }
        ],
        "materials": [{"name": "face", "doubleSided": True, "pbrMetallicRoughness": plain}],
        "animations": [
            {
                "name": animation.name,
                "samplers": [{"input": times, "output": document.add(morphs.weights.ravel()), "interpolation": LINEAR}],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ],
    }
    if surface is not None:
        add_materials(document, surface)
    return document


def add_materials(document: GlbWriter, surface: Textures) -> None:
    """Give a document the materials of a mesh file, with its pictures in the file."""
    images: dict[Path | bytes, int] = {}
    content, materials = document.content, []
    for material in surface.materials:
        look: dict[str, object] = {"metallicFactor": 0.0, "roughnessFactor": 0.7}
        picture = material.picture_bytes()
        if picture is None or material.picture is None:
            look["baseColorFactor"] = [*(float(part) for part in to_linear(material.colour)), 1.0]
        else:
            if material.picture not in images:
                images[material.picture] = len(images)
                view = document.add_bytes(picture[0])
                name = material.picture.stem if isinstance(material.picture, Path) else material.name
                entry = {"name": name, "mimeType": picture[1], "bufferView": view}
                content.setdefault("images", []).append(entry)
                content.setdefault("textures", []).append({"source": images[material.picture]})
            look["baseColorTexture"] = {"index": images[material.picture]}
        materials.append({"name": material.name, "doubleSided": True, "pbrMetallicRoughness": look})
    content["materials"] = materials


@dataclass(frozen=True)
class MovingNode:
    """A node that turns or moves: the head, which carries the face, or an eye, which carries nothing."""

    name: str  # head, left_eye or right_eye
    curves: Mapping[str, Array]  # (T, n) by the path that they change: rotation x, y, z, w; translation in metres
    translation: Array | None = None  # (3,) its position; None at the origin


def moving_nodes(animation: Animation, space: FileSpace, head: npt.NDArray[np.float64] | None) -> list[MovingNode]:
    """Nodes that turn besides the face, by the head (T, 6) in the animation's unit and by its channels.

    Shapes (``eyeLook…``) move the eyeballs of the one mesh: the eyes' nodes carry the angles that channels say, at the
    eyeballs' centres where these are known. The animation's head does not move.
    """
    nodes = []
    if head is not None:
        turns = gltf_rotations(convert(head[:, :3], "axis_angle", "quaternion"))
        nodes.append(
            MovingNode("head", {"rotation": turns, "translation": (head[:, 3:] * space.factor).astype(np.float32)})
        )
    turning = [turn for turn in animation.space.rotations if turn.joint in ("left_eye", "right_eye")]
    if animation.values is None or not turning:
        return nodes
    eyes = puppet_eyes(animation.template * metres_per_unit(animation.unit), animation.faces)
    for turn in turning:
        ball = None if eyes is None else eyes.eyeballs[turn.joint == "right_eye"]
        translation = None if ball is None else (animation.template[ball].mean(0) * space.factor).astype(np.float32)
        turns = gltf_rotations(convert(animation.values[:, list(turn.channels)], turn.form, "quaternion"))
        nodes.append(MovingNode(turn.joint, {"rotation": turns}, translation))
    return nodes


def gltf_rotations(quaternions: npt.NDArray[np.float64]) -> Array:
    """Quaternions (T, 4) w, x, y, z as glTF has them: x, y, z, w."""
    # One rotation has two quaternions: the one nearer to the frame before it keeps players on the short way.
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
    return np.roll(quaternions * np.cumprod([1.0, *signs])[:, None], -1, axis=1).astype(np.float32)


def add_nodes(document: GlbWriter, frame_rate: float, added: Sequence[MovingNode]) -> None:
    """Add nodes to a document of :func:`make_document`, where the face is the only node; a head carries all others."""
    nodes, siblings = document.content["nodes"], document.content["scenes"][0]["nodes"]
    (motion,) = document.content["animations"]
    times: int | None = None  # of all curves
    for moving in added:
        node: dict[str, Any] = {"name": moving.name}
        if moving.translation is not None:
            node["translation"] = moving.translation.tolist()
        nodes.append(node)
        if moving.name == "head":
            node["children"] = siblings
            document.content["scenes"][0]["nodes"] = [len(nodes) - 1]
        else:
            siblings.append(len(nodes) - 1)
        for path, values in moving.curves.items():
            if times is None:
                times = document.add((np.arange(len(values)) / frame_rate).astype(np.float32), bounds=True)
            output = document.add(values)
            motion["samplers"].append({"input": times, "output": output, "interpolation": LINEAR})
            target = {"node": len(nodes) - 1, "path": path}
            motion["channels"].append({"sampler": len(motion["samplers"]) - 1, "target": target})
