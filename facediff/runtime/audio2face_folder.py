"""The folder of an Audio2Face-3D model (v2.3, regression) as NVIDIA distributes it, read safely.

``model.json`` names all other files: ``network_info.json``, the network, the database of implicit emotions, the
settings of the face's animator, its geometry, and the blendshapes of skin and tongue with the settings of their solver.
The files are not trusted: paths stay in the folder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import damaged
from facediff.utils.arrays import read_arrays
from facediff.utils.plain_files import load_json

Array = npt.NDArray[np.float32]

REMEDY = "expected a model folder of Audio2Face-3D v2.3; get it again"
SAMPLE_RATE = 16_000
LONGEST_BUFFER = 160_000
"""Samples that a window may have; the released networks have 8 320."""


@dataclass(frozen=True)
class NetworkFacts:
    """What ``network_info.json`` says: numbers of coefficients, vertices and samples."""

    actor: str
    implicit: int  # numbers of the implicit emotion
    emotions: tuple[str, ...]  # names of the explicit ones
    default_emotion: tuple[float, ...]
    skin: int
    tongue: int
    jaw: int  # three for each point
    eyes: int  # x and y of the right one, then of the left one
    skin_vertices: int
    tongue_vertices: int
    buffer: int  # samples of a window
    before: int  # of these, before its frame's moment

    @property
    def size(self) -> int:
        """Numbers that the network gives for a frame."""
        return self.skin + self.tongue + self.jaw + self.eyes


@dataclass(frozen=True)
class AnimatorSettings:
    """How coefficients become a face, as ``config`` of the model's settings says; lengths in the face's unit.

    Smoothing is the seconds in which each of two filters follows half of a change; strengths are factors of motion. The
    border between the lower and the upper face is at a share (``level``) of the face's height.
    """

    input_strength: float = 1.0
    lower_face_smoothing: float = 0.0
    upper_face_smoothing: float = 0.0
    lower_face_strength: float = 1.0
    upper_face_strength: float = 1.0
    face_mask_level: float = 0.6
    face_mask_softness: float = 0.0085
    skin_strength: float = 1.0
    eyelid_open_offset: float = 0.0  # in shares of closing
    lip_open_offset: float = 0.0
    tongue_strength: float = 1.0
    tongue_height_offset: float = 0.0
    tongue_depth_offset: float = 0.0
    lower_teeth_strength: float = 1.0
    lower_teeth_height_offset: float = 0.0
    lower_teeth_depth_offset: float = 0.0
    eyeballs_strength: float = 1.0
    saccade_strength: float = 0.0
    right_eye_rot_x_offset: float = 0.0
    right_eye_rot_y_offset: float = 0.0
    left_eye_rot_x_offset: float = 0.0
    left_eye_rot_y_offset: float = 0.0
    eye_saccade_seed: float = 0.0  # the first row of the stored saccades


@dataclass(frozen=True)
class SolverSettings:
    """``blendshape_params`` of a solver; the lists have a value for each pose.

    Poses with the same number, not negative, exclude one another (``cancel``), or are a left one and a right one.
    """

    l1: float
    l2: float
    temporal: float
    symmetry: float
    active: tuple[bool, ...]
    cancel: tuple[int, ...]
    symmetric: tuple[int, ...]
    multipliers: tuple[float, ...]
    offsets: tuple[float, ...]
    template_size: float = 54.7  # diagonal of the face for which the strengths are stated


@dataclass(frozen=True)
class Poses:
    """Blendshapes of the skin or of the tongue with the settings of their solver."""

    names: tuple[str, ...]
    neutral: Array  # (V, 3)
    deltas: Array  # (K, V, 3)
    mask: npt.NDArray[np.int64]  # vertices that are compared; all if empty
    settings: SolverSettings


@dataclass(frozen=True)
class Audio2FaceFolder:
    """All that a folder holds but its network."""

    network: Path
    facts: NetworkFacts
    settings: AnimatorSettings
    implicit: Array  # (I,) emotion of the chosen shot and frame
    arrays: Mapping[str, Array]  # as read_geometry gives them
    poses: Mapping[str, Poses]  # by skin and tongue, where the folder has them


def read_audio2face(folder: Path) -> Audio2FaceFolder:
    """Read a folder."""
    about = folder / "model.json"
    content = load_json(about, remedy=REMEDY)
    with damaged(about, REMEDY):
        names = {key: content[f"{key}Path"] for key in ("networkInfo", "modelConfig", "emotionDatabase", "modelData")}
        shapes = {name: content["blendshapePaths"][name] for name in content.get("blendshapePaths", {})}
        network = content["networkPath"]
    files = {key: inside(folder, about, f"{key}Path", name) for key, name in names.items()}
    facts = read_facts(files["networkInfo"])
    settings, implicit = read_settings(files["modelConfig"], files["emotionDatabase"])
    poses = {}
    for name, vertices in (("skin", facts.skin_vertices), ("tongue", facts.tongue_vertices)):
        if name in shapes:
            with damaged(about, REMEDY):
                data, config = (inside(folder, about, f"{name}.{key}", shapes[name][key]) for key in ("data", "config"))
            poses[name] = read_poses(data, config, vertices)
    return Audio2FaceFolder(
        # The graph lies next to the engine of TensorRT that model.json may name, which runs on one kind of GPU only.
        network=inside(folder, about, "networkPath", network, ".onnx"),
        facts=facts,
        settings=settings,
        implicit=implicit,
        arrays=read_geometry(files["modelData"], facts),
        poses=poses,
    )


def inside(folder: Path, about: Path, key: str, name: str, suffix: str | None = None) -> Path:
    """A file of the folder by its name in ``model.json``, or with another suffix; one elsewhere is refused."""
    with damaged(about, REMEDY):
        path = folder / name.replace("\\", "/")
        path = path if suffix is None else path.with_suffix(suffix)
        if ":" in name or not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
            raise ValueError(f"{key} is {path.name}, which is no file inside the folder")
    return path


def read_facts(path: Path) -> NetworkFacts:
    """Content of ``network_info.json``."""
    content = load_json(path, remedy=REMEDY)
    with damaged(path, REMEDY):
        kind, params, audio = content["id"], content["params"], content["audio_params"]
        if (kind["type"], kind["output"], audio["samplerate"]) != ("regression", "geometry", SAMPLE_RATE):
            raise ValueError(
                f"type {kind['type']}, output {kind['output']}, samplerate {audio['samplerate']} is not the regression "
                f"of geometry at {SAMPLE_RATE} Hz of v2.3"
            )
        emotions = params["explicit_emotions"]
        facts = NetworkFacts(
            actor=str(kind.get("actor", "")),
            implicit=int(params["implicit_emotion_len"]),
            emotions=tuple(map(str, emotions)),
            default_emotion=_numbers(params, "default_emotion", len(emotions)),
            skin=int(params["num_shapes_skin"]),
            tongue=int(params["num_shapes_tongue"]),
            jaw=int(params["result_jaw_size"]),
            eyes=int(params["result_eyes_size"]),
            skin_vertices=int(params["num_verts_skin"]),
            tongue_vertices=int(params["num_verts_tongue"]),
            buffer=int(audio["buffer_len"]),
            before=int(audio["buffer_ofs"]),
        )
        if len(set(facts.emotions)) < len(emotions):
            raise ValueError("explicit_emotions has a name twice")
        if not 0 <= facts.before <= facts.buffer <= LONGEST_BUFFER:
            raise ValueError(f"buffer_len is {facts.buffer} with buffer_ofs {facts.before}")
    return facts


def read_settings(path: Path, database: Path) -> tuple[AnimatorSettings, Array]:
    """Settings of the animator, with the defaults of its class, and the implicit emotion that they choose."""
    content = load_json(path, remedy=REMEDY)
    arrays = read_arrays(database, ("emo_db", "emo_spec_names", "emo_spec_start", "emo_spec_size"), remedy=REMEDY)
    with damaged(path, REMEDY):
        config = content["config"]
        settings = AnimatorSettings(
            **{field.name: float(config[field.name]) for field in fields(AnimatorSettings) if field.name in config}
        )
        if settings.face_mask_softness <= 0:
            raise ValueError(f"face_mask_softness is {settings.face_mask_softness:g}; expected more than 0")
        shots = _names(arrays, "emo_spec_names")
        shot, frame = shots.index(config["source_shot"]), int(config["source_frame"])
        if not 0 <= frame < arrays["emo_spec_size"][shot]:
            raise ValueError(f"source_frame {frame} lies outside its shot")
    with damaged(database, REMEDY):
        rows = _matrix(arrays, "emo_db", (len(arrays["emo_db"]), -1))
        return settings, rows[int(arrays["emo_spec_start"][shot]) + frame]


def read_geometry(path: Path, facts: NetworkFacts) -> dict[str, Array]:
    """Arrays of ``model_data.npz`` under the names of :class:`Audio2FaceFolder`."""
    skin, tongue = facts.skin_vertices, facts.tongue_vertices
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {
        "skin_shapes": ("shapes_matrix_skin", (facts.skin, skin, 3)),
        "skin": ("shapes_mean_skin", (skin, 3)),
        "lip_open": ("lip_open_pose_delta", (skin, 3)),
        "eye_close": ("eye_close_pose_delta", (skin, 3)),
        "tongue_shapes": ("shapes_matrix_tongue", (facts.tongue, tongue, 3)),
        "tongue": ("shapes_mean_tongue", (tongue, 3)),
        "jaw": ("neutral_jaw", (facts.jaw // 3, 3)),
        "saccades": ("saccade_rot_matrix", (-1, 2)),
    }
    arrays = read_arrays(path, {stored for stored, _ in shapes.values()}, remedy=REMEDY)
    with damaged(path, REMEDY):
        geometry = {name: _matrix(arrays, stored, shape) for name, (stored, shape) in shapes.items()}
        if np.ptp(geometry["skin"][:, 1]) <= 0:
            raise ValueError("shapes_mean_skin has no height (y)")
    return geometry


def read_poses(path: Path, config_path: Path, vertices: int) -> Poses:
    """Blendshapes and the settings of their solver."""
    arrays = read_arrays(path, remedy=REMEDY)
    with damaged(path, REMEDY):
        names = [name for number, name in enumerate(_names(arrays, "poseNames")) if number or name != "neutral"]
        if not names or len(set(names)) < len(names) or "neutral" in names:
            raise ValueError("poseNames are not different names of poses")
        # Joined when all are there: names alone take no memory.
        deltas = np.stack([_matrix(arrays, name, (vertices, 3)) for name in names])
        mask = arrays.get("frontalMask", np.zeros(0)).ravel().astype(np.int64)
        if len(mask) and not 0 <= mask.min() <= mask.max() < vertices:
            raise ValueError(f"frontalMask names a vertex that is not one of {vertices}")
        neutral = _matrix(arrays, "neutral", (vertices, 3))
    return Poses(tuple(names), neutral, deltas, mask, read_solver_settings(config_path, len(names)))


def read_solver_settings(path: Path, count: int) -> SolverSettings:
    """Content of a solver's settings, which must be for so many poses."""
    content = load_json(path, remedy=REMEDY)
    with damaged(path, REMEDY):
        params = content["blendshape_params"]
        return SolverSettings(
            l1=float(params["strengthL1regularization"]),
            l2=float(params["strengthL2regularization"]),
            temporal=float(params["strengthTemporalSmoothing"]),
            symmetry=float(params["strengthSymmetry"]),
            active=tuple(map(bool, _numbers(params, "bsSolveActivePoses", count))),
            cancel=_pairs(params, "bsSolveCancelPoses", count),
            symmetric=_pairs(params, "bsSolveSymmetryPoses", count),
            multipliers=_numbers(params, "bsWeightMultipliers", count),
            offsets=_numbers(params, "bsWeightOffsets", count),
            template_size=float(params.get("templateBBSize", 54.7)),
        )


def _numbers(params: Mapping[str, Any], name: str, count: int) -> tuple[float, ...]:
    numbers = tuple(map(float, params[name]))
    if len(numbers) != count:
        raise ValueError(f"{name} has {len(numbers)} numbers; expected {count}")
    return numbers


def _pairs(params: Mapping[str, Any], name: str, count: int) -> tuple[int, ...]:
    partners = tuple(map(int, _numbers(params, name, count)))
    if any(number >= 0 and poses != 2 for number, poses in Counter(partners).items()):
        raise ValueError(f"{name} has a number that does not belong to two poses")
    return partners


def _matrix(arrays: Mapping[str, npt.NDArray[Any]], name: str, shape: tuple[int, ...]) -> Array:
    """An array in this shape, however its axes are folded in the file."""
    array: Array = np.ascontiguousarray(arrays[name], np.float32)
    if arrays[name].dtype.kind != "f" or not np.isfinite(array).all():
        raise ValueError(f"{name} is {arrays[name].dtype} of shape {array.shape}; expected finite floating point")
    with damaged(name, REMEDY):
        return array.reshape(shape)


def _names(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> list[str]:
    return [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in arrays[name].tolist()]
