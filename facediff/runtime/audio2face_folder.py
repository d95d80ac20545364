"""The folder of an Audio2Face-3D model (v2.3, regression) as NVIDIA distributes it, read safely.

``model.json`` names all other files: ``network_info.json``, the network, the database of implicit emotions, the
settings of the face's animator, its geometry, and the blendshapes of skin and tongue with the settings of their solver.
Everything may come from anybody: paths stay in the folder, and no array may be larger than what the folder says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.arrays import read_arrays
from facediff.utils.limits import check_number, in_range, quoted
from facediff.utils.plain_files import load_json

Array = npt.NDArray[np.float32]

REMEDY = "expected a model folder of Audio2Face-3D v2.3; get it again"
SAMPLE_RATE = 16_000
LONGEST_BUFFER = 160_000
"""Samples that a window may have; the released networks have 8 320."""

MOST = 10_000
"""Coefficients, emotions or poses that a folder may state; the released ones have at most 272."""


@dataclass(frozen=True)
class NetworkFacts:
    """What ``network_info.json`` says.

    Attributes:
        actor: whose face it is.
        implicit: numbers of the implicit emotion.
        emotions: names of the explicit emotions.
        default_emotion: their strengths where nobody chooses.
        skin: coefficients of the skin.
        tongue: coefficients of the tongue.
        jaw: numbers of the jaw, three for each point.
        eyes: numbers of the eyes: x and y of the right one, then of the left one.
        skin_vertices: vertices of the skin.
        tongue_vertices: vertices of the tongue.
        buffer: samples of a window.
        before: samples of a window before its frame's moment.
    """

    actor: str
    implicit: int
    emotions: tuple[str, ...]
    default_emotion: tuple[float, ...]
    skin: int
    tongue: int
    jaw: int
    eyes: int
    skin_vertices: int
    tongue_vertices: int
    buffer: int
    before: int

    @property
    def size(self) -> int:
        """Numbers that the network gives for a frame."""
        return self.skin + self.tongue + self.jaw + self.eyes


@dataclass(frozen=True)
class AnimatorSettings:
    """How coefficients become a face, as ``config`` of the model's settings says; lengths in the face's unit.

    Attributes:
        input_strength: factor of the sound.
        lower_face_smoothing: seconds in which half of a change of the lower face is followed, by each of two filters.
        upper_face_smoothing: the same of the upper face.
        lower_face_strength: factor of the lower face's motion.
        upper_face_strength: factor of the upper face's motion.
        face_mask_level: height of the border between both, as a share of the face's height.
        face_mask_softness: how wide that border is.
        skin_strength: factor of all motion of the skin.
        blink_strength: factor of blinks that are added from outside.
        eyelid_open_offset: how far the lids are opened, in shares of closing.
        lip_open_offset: how far the lips are opened.
        tongue_strength: factor of the tongue's motion.
        tongue_height_offset: added to the tongue's y.
        tongue_depth_offset: added to the tongue's z.
        lower_teeth_strength: factor of the jaw's motion.
        lower_teeth_height_offset: added to the jaw's y.
        lower_teeth_depth_offset: added to the jaw's z.
        eyeballs_strength: factor of the eyes' motion.
        saccade_strength: factor of the stored saccades.
        right_eye_rot_x_offset: added to the right eye's first angle.
        right_eye_rot_y_offset: added to its second angle.
        left_eye_rot_x_offset: added to the left eye's first angle.
        left_eye_rot_y_offset: added to its second angle.
        eye_saccade_seed: the first row of the stored saccades.
    """

    input_strength: float = 1.0
    lower_face_smoothing: float = 0.0
    upper_face_smoothing: float = 0.0
    lower_face_strength: float = 1.0
    upper_face_strength: float = 1.0
    face_mask_level: float = 0.6
    face_mask_softness: float = 0.0085
    skin_strength: float = 1.0
    blink_strength: float = 1.0
    eyelid_open_offset: float = 0.0
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
    eye_saccade_seed: float = 0.0


@dataclass(frozen=True)
class SolverSettings:
    """``blendshape_params`` of a solver; the lists have a value for each pose.

    Attributes:
        l1: strength of the term that keeps the sum of the weights small.
        l2: strength of the term that keeps each weight small.
        temporal: strength of the term that keeps weights near those of the frame before.
        symmetry: strength of the term that keeps the weights of a symmetric pair alike.
        active: whether a pose is used.
        cancel: poses with the same number, not negative, exclude one another.
        symmetric: poses with the same number are a left one and a right one.
        multipliers: factor of each weight that was solved for.
        offsets: what is added to it then.
        template_size: diagonal of the face for which the strengths are stated.
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
    template_size: float = 54.7


@dataclass(frozen=True)
class Poses:
    """Blendshapes of the skin or of the tongue with the settings of their solver.

    Attributes:
        names: K names.
        neutral: (V, 3) the face at rest.
        deltas: (K, V, 3) what a weight of 1 adds.
        mask: vertices that are compared; all if empty.
        settings: of the solver.
    """

    names: tuple[str, ...]
    neutral: Array
    deltas: Array
    mask: npt.NDArray[np.int64]
    settings: SolverSettings


@dataclass(frozen=True)
class Audio2FaceFolder:
    """All that a folder holds but its network.

    Attributes:
        network: the graph's file.
        facts: sizes and names.
        settings: of the animator.
        implicit: (I,) the implicit emotion of the chosen shot and frame.
        arrays: ``skin_shapes`` (skin, V, 3), ``skin`` (V, 3) at rest, ``lip_open`` and ``eye_close`` (V, 3),
            ``tongue_shapes``, ``tongue``, ``jaw`` (points, 3) at rest, ``saccades`` (rows, 2).
        poses: blendshapes by ``skin`` and ``tongue``; empty where the folder has none.
    """

    network: Path
    facts: NetworkFacts
    settings: AnimatorSettings
    implicit: Array
    arrays: Mapping[str, Array]
    poses: Mapping[str, Poses]


def read_audio2face(folder: Path) -> Audio2FaceFolder:
    """Read a folder.

    Raises:
        FaceDiffError: naming the file and what is wrong in it.
    """
    about = folder / "model.json"
    content = _object(load_json(about, remedy=REMEDY), about)
    facts = read_facts(_named(folder, about, content, "networkInfoPath"))
    config = _named(folder, about, content, "modelConfigPath")
    chosen = _object(_object(load_json(config, remedy=REMEDY), config).get("config"), config, "config")
    database = _named(folder, about, content, "emotionDatabasePath")
    shapes = content.get("blendshapePaths", {})
    poses = {}
    for name, vertices in (("skin", facts.skin_vertices), ("tongue", facts.tongue_vertices)):
        if name in _object(shapes, about, "blendshapePaths"):
            paths = _object(shapes[name], about, f"blendshapePaths.{name}")
            settings, data = (_named(folder, about, paths, key) for key in ("config", "data"))
            poses[name] = read_poses(data, settings, vertices)
    return Audio2FaceFolder(
        network=network_file(folder, about, content),
        facts=facts,
        settings=read_settings(config, chosen),
        implicit=implicit_emotion(database, facts.implicit, config, chosen),
        arrays=read_geometry(_named(folder, about, content, "modelDataPath"), facts),
        poses=poses,
    )


def network_file(folder: Path, about: Path, content: Mapping[str, Any]) -> Path:
    """The graph of ONNX, which lies next to the engine of TensorRT that ``model.json`` may name instead."""
    path = _path(folder, about, content, "networkPath", ".onnx")
    if not path.is_file():
        raise FaceDiffError(
            f"{path}: no such file; {about.name} names the network so, and its graph of ONNX is needed: an engine of "
            f"TensorRT runs on one kind of GPU only"
        )
    return path


def read_facts(path: Path) -> NetworkFacts:
    """Content of ``network_info.json``."""
    content = _object(load_json(path, remedy=REMEDY), path)
    kind, params, audio = (_object(content.get(name), path, name) for name in ("id", "params", "audio_params"))
    if kind.get("type") != "regression" or kind.get("output") != "geometry":
        raise FaceDiffError(
            f"{path}: its network is of the type {quoted(kind.get('type'))} with the output "
            f"{quoted(kind.get('output'))}; expected regression of geometry, as in v2.3; choose such a model"
        )
    emotions = params.get("explicit_emotions")
    if (
        not isinstance(emotions, list)
        or len(emotions) > MOST
        or not all(isinstance(name, str) and name.isprintable() and len(name) < 100 for name in emotions)
        or len(set(emotions)) < len(emotions)
    ):
        raise FaceDiffError(f"{path}: explicit_emotions are {quoted(emotions)}; expected different names; {REMEDY}")

    def count(name: str, least: int, most: float, group: Mapping[str, Any] = params) -> int:
        return int(check_number(path, name, group.get(name), least, most, whole=True, remedy=REMEDY))

    check_number(path, "samplerate", audio.get("samplerate"), SAMPLE_RATE, SAMPLE_RATE, whole=True)
    buffer = count("buffer_len", 1, LONGEST_BUFFER, audio)
    facts = NetworkFacts(
        actor=str(kind.get("actor", ""))[:100],
        implicit=count("implicit_emotion_len", 0, MOST),
        emotions=tuple(emotions),
        default_emotion=_numbers(path, "default_emotion", params.get("default_emotion"), len(emotions)),
        skin=count("num_shapes_skin", 1, MOST),
        tongue=count("num_shapes_tongue", 1, MOST),
        jaw=count("result_jaw_size", 9, MOST),
        eyes=count("result_eyes_size", 4, 4),
        skin_vertices=count("num_verts_skin", 1, 2**31),
        tongue_vertices=count("num_verts_tongue", 1, 2**31),
        buffer=buffer,
        before=count("buffer_ofs", 0, buffer, audio),
    )
    if facts.jaw % 3:
        raise FaceDiffError(f"{path}: result_jaw_size is {facts.jaw}; expected three numbers for each point; {REMEDY}")
    return facts


def read_settings(path: Path, config: Mapping[str, Any]) -> AnimatorSettings:
    """Settings of the animator; what a file lacks has its usual value."""
    values = {
        field.name: check_number(path, field.name, config[field.name], -1e6, 1e6, remedy=REMEDY)
        for field in fields(AnimatorSettings)
        if field.name in config
    }
    settings = AnimatorSettings(**values)
    for name in ("lower_face_smoothing", "upper_face_smoothing"):
        check_number(path, name, getattr(settings, name), 0)
    check_number(path, "face_mask_softness", settings.face_mask_softness, 1e-9)
    return settings


def implicit_emotion(path: Path, length: int, config_path: Path, config: Mapping[str, Any]) -> Array:
    """The row of the database of implicit emotions that the settings choose."""
    arrays = read_arrays(path, ("emo_db", "emo_spec_names", "emo_spec_start", "emo_spec_size"), remedy=REMEDY)
    rows = _matrix(path, arrays, "emo_db", (None, length))
    names = _names(path, arrays, "emo_spec_names")
    starts, sizes = (_whole(path, arrays, name) for name in ("emo_spec_start", "emo_spec_size"))
    shot = config.get("source_shot")
    if not isinstance(shot, str) or shot not in names[: min(len(starts), len(sizes))]:
        raise FaceDiffError(f"{config_path}: source_shot is {quoted(shot)}; expected a shot of {path.name}; {REMEDY}")
    at = names.index(shot)
    most = int(sizes[at]) - 1
    frame = int(check_number(config_path, "source_frame", config.get("source_frame"), 0, most, whole=True))
    row = int(starts[at]) + frame
    if not 0 <= row < len(rows):
        raise FaceDiffError(f"{path}: {quoted(shot)} begins at row {starts[at]} of {len(rows)}; {REMEDY}")
    return rows[row]


def read_geometry(path: Path, facts: NetworkFacts) -> dict[str, Array]:
    """Arrays of ``model_data.npz`` under the names of :class:`Audio2FaceFolder`."""
    skin, tongue = facts.skin_vertices, facts.tongue_vertices
    shapes: dict[str, tuple[str, tuple[int | None, ...]]] = {
        "skin_shapes": ("shapes_matrix_skin", (facts.skin, skin, 3)),
        "skin": ("shapes_mean_skin", (skin, 3)),
        "lip_open": ("lip_open_pose_delta", (skin, 3)),
        "eye_close": ("eye_close_pose_delta", (skin, 3)),
        "tongue_shapes": ("shapes_matrix_tongue", (facts.tongue, tongue, 3)),
        "tongue": ("shapes_mean_tongue", (tongue, 3)),
        "jaw": ("neutral_jaw", (facts.jaw // 3, 3)),
        "saccades": ("saccade_rot_matrix", (None, 2)),
    }
    arrays = read_arrays(path, {stored for stored, _ in shapes.values()}, remedy=REMEDY)
    geometry = {name: _matrix(path, arrays, stored, shape) for name, (stored, shape) in shapes.items()}
    if not len(geometry["saccades"]):
        raise FaceDiffError(f"{path}: saccade_rot_matrix holds no rows; {REMEDY}")
    if np.ptp(geometry["skin"][:, 1]) <= 0:
        raise FaceDiffError(f"{path}: shapes_mean_skin has no height (y); {REMEDY}")
    return geometry


def read_poses(path: Path, config_path: Path, vertices: int) -> Poses:
    """Blendshapes and the settings of their solver."""
    arrays = read_arrays(path, remedy=REMEDY)
    names = _names(path, arrays, "poseNames")
    names = [name for place, name in enumerate(names) if place or name != "neutral"]
    if not 0 < len(names) <= MOST or len(set(names)) < len(names) or "neutral" in names:
        raise FaceDiffError(f"{path}: poseNames are {quoted(names)}; expected different names of poses; {REMEDY}")
    # Joined when all are there: names alone take no memory.
    deltas = np.stack([_matrix(path, arrays, name, (vertices, 3)) for name in names])
    mask = _whole(path, arrays, "frontalMask") if "frontalMask" in arrays else np.zeros(0, np.int64)
    if len(mask) and not 0 <= mask.min() <= mask.max() < vertices:
        raise FaceDiffError(f"{path}: frontalMask names a vertex that is not one of {vertices}; {REMEDY}")
    neutral = _matrix(path, arrays, "neutral", (vertices, 3))
    if not np.ptp(neutral, axis=0).any():
        raise FaceDiffError(f"{path}: all vertices of neutral are one point; {REMEDY}")
    return Poses(tuple(names), neutral, deltas, mask, read_solver_settings(config_path, len(names)))


def read_solver_settings(path: Path, count: int) -> SolverSettings:
    """Content of a solver's settings, which must be for so many poses."""
    content = _object(load_json(path, remedy=REMEDY), path)
    params = _object(content.get("blendshape_params"), path, "blendshape_params")
    check_number(path, "numPoses", params.get("numPoses"), count, count, whole=True, remedy=REMEDY)

    def pairs(name: str) -> tuple[int, ...]:
        numbers = _numbers(path, name, params.get(name), count, whole=True)
        partners = [int(number) for number in numbers]
        if any(number >= 0 and poses != 2 for number, poses in Counter(partners).items()):
            raise FaceDiffError(f"{path}: {name} has a number that is not that of two poses; {REMEDY}")
        return tuple(partners)

    def strength(name: str) -> float:
        return check_number(path, name, params.get(name), 0, 1e6, remedy=REMEDY)

    active = tuple(
        bool(number) for number in _numbers(path, "bsSolveActivePoses", params.get("bsSolveActivePoses"), count)
    )
    if not any(active):
        raise FaceDiffError(f"{path}: bsSolveActivePoses uses no pose; expected at least one; {REMEDY}")
    return SolverSettings(
        l1=strength("strengthL1regularization"),
        l2=strength("strengthL2regularization"),
        temporal=strength("strengthTemporalSmoothing"),
        symmetry=strength("strengthSymmetry"),
        active=active,
        cancel=pairs("bsSolveCancelPoses"),
        symmetric=pairs("bsSolveSymmetryPoses"),
        multipliers=_numbers(path, "bsWeightMultipliers", params.get("bsWeightMultipliers"), count),
        offsets=_numbers(path, "bsWeightOffsets", params.get("bsWeightOffsets"), count),
        template_size=check_number(path, "templateBBSize", params.get("templateBBSize", 54.7), 1e-6, 1e9),
    )


def _object(value: object, path: Path, name: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        raise FaceDiffError(f"{path}: {name or 'it'} is {quoted(value)}; expected an object; {REMEDY}")
    return value


def _path(folder: Path, about: Path, content: Mapping[str, Any], key: str, suffix: str | None = None) -> Path:
    """A file of the folder by its name in ``model.json``, or with another suffix; one elsewhere is refused."""
    text = content.get(key)
    pure = PurePosixPath(text.replace("\\", "/")) if isinstance(text, str) and text.isprintable() else PurePosixPath()
    if not pure.parts or pure.is_absolute() or ".." in pure.parts or ":" in str(text):
        raise FaceDiffError(f"{about}: {key} is {quoted(text)}; expected a file of the folder; {REMEDY}")
    path = folder / (pure if suffix is None else pure.with_suffix(suffix))
    if path.exists() and not path.resolve().is_relative_to(folder.resolve()):
        raise FaceDiffError(f"{about}: {key} is a link to {quoted(str(path.resolve()))}; expected a file of the folder")
    return path


def _named(folder: Path, about: Path, content: Mapping[str, Any], key: str) -> Path:
    path = _path(folder, about, content, key)
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file, and {about.name} names it as {key}; {REMEDY}")
    return path


def _numbers(path: Path, name: str, value: object, count: int, *, whole: bool = False) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise FaceDiffError(f"{path}: {name} is {quoted(value)}; expected {count} numbers; {REMEDY}")
    return tuple(check_number(path, name, number, -1e9, 1e9, whole=whole, remedy=REMEDY) for number in value)


def _matrix(path: Path, arrays: Mapping[str, npt.NDArray[Any]], name: str, shape: tuple[int | None, ...]) -> Array:
    """An array in this shape, however its axes are folded in the file; ``None`` stands for any length."""
    array = arrays.get(name)
    shown = "missing" if array is None else f"{array.dtype} {array.shape}"
    if array is not None and array.dtype.kind == "f":
        folded = tuple(-1 if length is None else length for length in shape)
        rest = int(np.prod([length for length in shape if length is not None]))
        if array.size == rest if None not in shape else rest and array.size % rest == 0:
            with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused
                result: Array = np.ascontiguousarray(array, np.float32).reshape(folded)
            if in_range(result):
                return result
            shown = "not finite"
    raise FaceDiffError(f"{path}: {name} is {shown}; expected finite numbers of the shape {quoted(shape)}; {REMEDY}")


def _whole(path: Path, arrays: Mapping[str, npt.NDArray[Any]], name: str) -> npt.NDArray[np.int64]:
    array = arrays.get(name)
    if array is None or array.dtype.kind not in "iu":
        raise FaceDiffError(f"{path}: {name} is missing or no list of whole numbers; {REMEDY}")
    return array.ravel().astype(np.int64)


def _names(path: Path, arrays: Mapping[str, npt.NDArray[Any]], name: str) -> list[str]:
    array = arrays.get(name)
    if array is None or array.dtype.kind not in "SU" or array.ndim != 1:
        raise FaceDiffError(f"{path}: {name} is missing or no list of names; {REMEDY}")
    return [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in array.tolist()]
