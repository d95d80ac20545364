"""Speaking styles of an exported model: by name, from a file, from motion, and mixtures, as ``--style`` takes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import metres_per_unit
from facediff.animation.parameter_styles import channels_of, recorded_parameters
from facediff.animation.style_files import (
    FILES,
    Stillness,
    StyleFile,
    frames_of,
    normalised,
    open_style,
    split_styles,
    stride_of,
    style_given,
    vector_in,
)
from facediff.errors import FaceDiffError, OptionError, choices
from facediff.runtime.graphs import ExportedGraphs
from facediff.spaces.files import ParameterClip

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class RuntimeStyle:
    """A style vector.

    Attributes:
        name: of its source.
        vector: as the model's style encoder gives it, (S,).
    """

    name: str
    vector: Array


def style_from(style: object, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    """The style that was given in Python; the model must take styles from reference motion.

    Args:
        style: the words of ``--style``; a path; names or paths with their weights; a motion as an animation, or as an
            array (T, V, 3) of absolute vertices; a style vector (S,); or what this function has returned.
        model: the model.
        identity: the speaker of an array, unless a file's name says it.
    """
    if isinstance(style, RuntimeStyle):
        return style
    reference = style_given(style, vertices=model.description.motion_space.is_vertices)
    if isinstance(reference, str):
        return read_style(reference, model, identity)
    if isinstance(reference, ParameterClip):
        return _of_parameters(reference, model, identity)
    return _of_vertices(reference, model, identity)


def read_style(text: str, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    """The style that the text of ``--style`` names; the model must take styles from reference motion.

    Args:
        text: a style's name, a file, or several of them with weights, ``F1:0.3,b.npz:0.7``.
        model: the model.
        identity: the speaker of a bare array (``.npy``), unless the file's name says it.
    """
    parts = split_styles(text, model.description.styles)
    if len(parts) == 1:
        return single_style(parts[0].name, model, identity)
    shares = normalised(text, [part.weight for part in parts])
    styles = [single_style(part.name, model, identity) for part in parts]
    vector = np.sum([np.float32(share) * style.vector for share, style in zip(shares, styles, strict=True)], 0)
    name = " + ".join(f"{share:.3g} {style.name}" for share, style in zip(shares, styles, strict=True))
    return RuntimeStyle(name, vector.astype(np.float32))


def single_style(name: str, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    """A style by its name in the folder, or from a file."""
    about, vectors = model.description, model.arrays["styles"]
    if name in about.styles:
        return RuntimeStyle(name, vectors[about.styles.index(name)].astype(np.float32))
    vertices = about.motion_space.is_vertices and name.endswith(FILES)
    recorded = None if vertices else recorded_parameters(name, about.frame_rate)
    if recorded is not None:
        return _of_parameters(recorded, model, identity)
    if not name.endswith(FILES):
        raise OptionError("style", f'there is no "{name}", and it is no file: {choices(name, about.styles)}')
    return _of_vertices(open_style(Path(name)), model, identity)


def _of_parameters(recorded: ParameterClip, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    about = model.description
    values = channels_of(recorded, about.motion_space, about.frame_rate)
    resting = model.arrays["resting"][about.faces.index(identity) if identity in about.faces else 0]
    return encode_style(model, (values - resting)[..., None], recorded.name)


def _of_vertices(opened: StyleFile, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    """The style of motion in vertices, or a vector."""
    about, vectors, path = model.description, model.arrays["styles"], opened.path
    if opened.array.ndim == 1:

        def still() -> Array:
            return encode_style(model, np.zeros((1, *_points(model)), np.float32), "still").vector

        vector = vector_in(opened, vectors.shape[1], still if model.has("style") else None)
        return RuntimeStyle(path.stem, vector)
    if not about.motion_space.is_vertices:
        raise OptionError.naming(
            f"{{style}} {path}: holds vertices, and this model takes channels; give motion in parameters, a style of "
            f"the folder, or a style vector of this model"
        )
    templates, rate, scale = model.arrays["templates"], opened.frame_rate or about.frame_rate, 1.0
    whose = next((name for name in (path.stem.rpartition("_")[0], identity) if name in about.faces), about.faces[0])
    face = templates[about.faces.index(whose)] if opened.template is None else opened.template
    if opened.unit not in (None, about.unit):
        scale = metres_per_unit(str(opened.unit)) / metres_per_unit(about.unit)
    motion = frames_of(opened, templates.shape[1], stride_of(path, rate, about.frame_rate))
    offsets = (scale * (motion - face)).astype(np.float32)
    if "still" in model.arrays and Stillness(model.arrays["still"], about.stillness).another_face(offsets):
        face_of = f"the neutral face of {whose}" if opened.template is None else "its own template"
        raise OptionError.naming(
            f"{{style}} {path}: does not lie on {face_of}, or the head moves; give an animation (.npz) of a head that "
            f"keeps still, or an array that is named <identity>_<clip>.npy"
        )
    return encode_style(model, offsets, path.stem)


def encode_style(model: ExportedGraphs, motion: Array, name: str) -> RuntimeStyle:
    """The style of reference motion: offsets (T, points, dims) from rest, at the model's unit and frame rate."""
    if not model.has("style"):
        raise FaceDiffError(
            f"style: the folder has no style encoder, so {model.description.model} takes styles by name alone; "
            f"choose one of {', '.join(model.description.styles[:5])}, or export the model again"
        )
    points = _points(model)
    motion = np.ascontiguousarray(motion, np.float32)
    if motion.ndim != 3 or not len(motion) or motion.shape[1:] != points or not np.isfinite(motion).all():
        raise FaceDiffError(f"style: is {motion.shape}; expected finite offsets (frames, {points[0]}, {points[1]})")
    inputs = {"motion": motion[None], "mask": np.ones((1, len(motion)), bool)}
    return RuntimeStyle(name, model.run("style", inputs)[0][0])


def _points(model: ExportedGraphs) -> tuple[int, int]:
    """Points of a frame, and numbers of a point."""
    space = model.description.motion_space
    return len(space.channels) or model.arrays["templates"].shape[1], space.dims
