"""The folder of an exported model: its content, writing its description, and reading it safely.

``model.json`` says everything that is no array, ``arrays.npz`` holds templates, styles and regions, and each graph is a
file of its own: ``speech.onnx`` and ``motion.onnx`` of every model, ``step.onnx`` of one that samples, ``start.onnx``
where its loop starts from more than noise, ``style.onnx`` of one that takes styles from motion.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, OptionError, damaged
from facediff.runtime.graph_check import REMEDY
from facediff.spaces import VERTICES, Space
from facediff.spaces.decoding import ChannelDecoder
from facediff.speech.windows import FrameClock, Rule, WindowPlan
from facediff.utils.arrays import read_arrays
from facediff.utils.files import atomic_folder
from facediff.utils.limits import quoted
from facediff.utils.plain_files import load_json
from facediff.utils.ranges import Expressivity, Range
from facediff.utils.records import read_record

FORMAT = "facediff model"
VERSION = 1
DESCRIPTION = "model.json"
ARRAYS = "arrays.npz"
NEEDED = {"sampled": ("speech", "step", "motion"), "direct": ("speech", "motion")}
"""Graphs that every folder has, by the kind of generation."""

OPTIONAL = {"sampled": ("start", "style"), "direct": ("style",)}
"""Graphs that some folders have besides."""

Arrays = Mapping[str, npt.NDArray[Any]]

EXPECTED = "expected a folder that `facediff export-model` wrote"


@dataclass(frozen=True)
class Description:
    """Content of ``model.json``. Folders of earlier versions lack later entries, which have defaults."""

    model: str  # class of the model
    facediff: str  # version that wrote the folder
    corpus: str  # that the model was trained on
    synthetic: bool  # whether that corpus is synthetic
    licences: dict[str, str]  # labels by subject: data, weights …
    opset: int  # of the graphs
    precision: str  # how weights are stored: float32, float16 or int8
    sizes: dict[str, int]  # bytes of each file
    graphs: dict[str, dict[str, list[dict[str, Any]]]]  # inputs and outputs: name, type, shape; names for open lengths
    sample_rate: Literal[16_000]  # of the speech, in Hz
    frame_rate: Annotated[float, Range(1, 1000)]  # of the motion
    unit: str  # of length
    identities: Sequence[str]  # training identities, in the order of the identity index
    faces: Sequence[str]  # identities with a neutral face, in the order of the array templates
    styles: Sequence[str]  # names of the array styles; a name of an identity is its default
    windows: dict[str, float]  # how long speech is cut, as WindowPlan takes it
    epsilon: Annotated[float, Range(0, 1, above=True, below=True)]  # added to the variance of speech
    equal_lengths: bool  # whether all clips of a batch must be of one length; reference motions of one always must
    state: int  # numbers in a frame of noisy motion
    kept: int  # numbers in a frame by which windows of long speech are blended
    sampler: str  # its name
    steps: Sequence[int]  # the diffusion steps visited
    # For each of them the factors of the noisy motion, of the last three predictions (latest first) and noise; where
    # there is a sixth, of the first prediction.
    table: Sequence[Sequence[float]]
    last_step: int  # the step at which only the mean is left; -1 in a model that predicts no mean
    decoded: Literal["sample", "kept"]  # input of the last graph: the sample, or the kept numbers of the last step
    generation: Literal["sampled", "direct"] = "sampled"  # by a loop over the graph step, or by motion alone
    blending: Literal["steps", "motion"] = "steps"  # where windows go over into one another
    clock: dict[str, Any] = field(default_factory=lambda: {"rule": "rounded"})  # as FrameClock takes it
    style_source: Literal["reference", "identity", "none"] = "reference"  # motion, or a training identity
    longest: int = 0  # frames at most that are animated in one pass; 0 for any number
    drawn: int = 0  # numbers in a frame of the noise that the loop starts from; state if 0
    noise_of: Literal["clip", "seed"] = "clip"  # what noise depends on, the seed besides
    # How far the stored references move; reference motion is rejected as another face if its static vertices (the array
    # still) deviate by more than a fraction of this.
    stillness: float = 0.0
    usual_expressivity: Expressivity = 1.0  # unless another is asked for
    quick_steps: Sequence[int] = ()  # visited at low latency; none where the model does not change its steps
    quick_table: Sequence[Sequence[float]] = ()
    voice_gate: Literal["energy", "off"] = "energy"  # the default; off for imported models
    space: dict[str, Any] = field(default_factory=dict)  # of the motion, as Space.state says it; empty for vertices
    check: dict[str, Any] = field(default_factory=dict)  # the comparison with PyTorch when the folder was written

    def content(self) -> dict[str, Any]:
        """The JSON object that is written."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    def require_commercial_use(self) -> None:
        """Refuse a model that is not cleared for commercial use."""
        if self.licences.get("commercial_use") != "allowed":
            raise OptionError("commercial_only", f"{self.model} is not cleared for commercial use; omit the option")

    @property
    def known(self) -> list[str]:
        """The identities that it was trained on and has faces of, or else all faces; the first is the default."""
        return [name for name in self.identities if name in self.faces] or list(self.faces)

    @cached_property
    def motion_space(self) -> Space:
        """Meaning of the motion's numbers."""
        return Space.from_state(self.space) if self.space else VERTICES

    @property
    def plan(self) -> WindowPlan:
        """How long speech is cut."""
        return WindowPlan(**self.windows)

    @property
    def frame_clock(self) -> FrameClock:
        """How the model counts its frames."""
        facts = dict(self.clock)
        if "convolutions" in facts:
            facts["convolutions"] = tuple((kernel, stride) for kernel, stride in facts["convolutions"])
        return FrameClock(self.frame_rate, **facts)


def read_folder(folder: Path) -> tuple[Description, Arrays]:
    """Description and arrays of an exported model; its graphs are checked where they are opened."""
    path = folder / DESCRIPTION
    content = load_json(path, remedy=EXPECTED)
    if not isinstance(content, dict) or (content.get("format"), content.get("version")) != (FORMAT, VERSION):
        raise FaceDiffError(f"{path}: is not version {VERSION} of a model's description; {EXPECTED}")
    description = read_record(Description, content, path, remedy=REMEDY, strict=False)
    with damaged(path, REMEDY):
        _check(description)
    for name in (*(f"{graph}.onnx" for graph in description.graphs), ARRAYS):
        size = (folder / name).stat().st_size if (folder / name).is_file() else None
        if size != description.sizes.get(name):
            problem = "is missing" if size is None else f"has {size} bytes"
            raise FaceDiffError(
                f"{folder / name}: {problem}, expected {description.sizes.get(name)}; copy or export the model again"
            )
    arrays = read_arrays(folder / ARRAYS)
    with damaged(folder / ARRAYS, REMEDY):
        _check_arrays(description, arrays)
    return description, arrays


def _check(description: Description) -> None:
    """Refuse what would be taken for something else, or would leave the folder."""
    if (rule := description.frame_clock.rule) not in get_args(Rule):
        raise ValueError(f"clock is {quoted(rule)}; expected {' or '.join(get_args(Rule))}")
    needed, optional = NEEDED[description.generation], OPTIONAL[description.generation]
    if not {*needed} <= {*description.graphs} <= {*needed, *optional}:
        raise ValueError(f"graphs are {', '.join(description.graphs)}; expected {', '.join(needed)}")
    if not description.faces:
        raise ValueError("faces is empty")
    for steps, table in (("steps", "table"), ("quick_steps", "quick_table")):
        rows = [np.asarray(row, np.float64) for row in getattr(description, table)]
        fits = all(row.shape in ((5,), (6,)) and (np.abs(row) < 1e9).all() for row in rows)
        empty = steps == "steps" and description.generation == "sampled" and not rows
        if len(rows) != len(getattr(description, steps)) or not fits or empty:
            raise ValueError(f"{table} has not five or six numbers below 10^9 for each step, of one step at least")
    _ = description.motion_space
    description.plan.in_frames(description.frame_rate)


def _check_arrays(description: Description, arrays: Arrays) -> None:
    """Refuse arrays of other shapes, numbers that are not finite, and indices of vertices that do not exist."""
    space, faces, vertices = description.motion_space, len(description.faces), arrays["templates"].shape[1]
    shapes: dict[str, tuple[int | None, ...]] = {
        "templates": (faces, vertices, 3),
        "rest_weights": (faces, len(space.channels) or vertices),
    }
    if description.style_source == "reference":
        shapes["styles"] = (len(description.styles), None)
    if not space.is_vertices:
        rigs = len(arrays["deltas"])
        shapes |= {"resting": (faces, len(space.channels)), "deltas": (None, len(space.face), vertices, 3)}
        shapes |= {"delta_scales": (rigs, len(space.face)), "rigs": (faces,)}
    optional: dict[str, tuple[int | None, ...]] = {
        "noise": (description.state, description.state),
        "faces": (None, 3),
        "colours": (faces, vertices, 3) if "colours" in arrays and arrays["colours"].ndim == 3 else (vertices, 3),
        "inner_lip_pairs": (None, 2),
    }
    shapes |= {name: shape for name, shape in optional.items() if name in arrays}
    shapes |= {name: (None,) for name in arrays if name.startswith("region_") or name == "still"}
    for name, shape in shapes.items():
        array = arrays[name]
        if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            raise ValueError(f"{name} has the shape {array.shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
        indexed = rigs if name == "rigs" else vertices
        holds_indices = (shape == (None,) or name in ("faces", "inner_lip_pairs", "rigs")) and array.size
        if holds_indices and not 0 <= int(array.min()) <= int(array.max()) < indexed:
            raise ValueError(f"{name} has an index outside 0 to {indexed - 1}")


LEVELS = 32767
"""Steps of 16 bits that a channel's largest displacement has."""


def packed_deltas(rigs: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.float32]]:
    """Displacements (R, K, V, 3) in 16 bits, and the size (R, K) of a step: one for each channel.

    Example:
        >>> packed, scales = packed_deltas(np.array([[[[0.5, 0.0, -1.0]]]]))
        >>> packed.tolist(), bool(np.abs(packed * scales[..., None, None] - [0.5, 0, -1]).max() < 2e-5)
        ([[[[16384, 0, -32767]]]], True)
    """
    sizes = np.abs(rigs).max(axis=(2, 3)).astype(np.float32)
    scales = np.asarray(np.where(sizes > 0, sizes, 1.0) / LEVELS, np.float32)
    return np.rint(rigs / scales[..., None, None]).astype(np.int16), scales


def decoder_of(description: Description, arrays: Arrays, face: int) -> ChannelDecoder | None:
    """What turns a folder's channels into the vertices of one of its faces; None for vertices."""
    if description.motion_space.is_vertices:
        return None
    rig = int(arrays["rigs"][face])
    deltas = arrays["deltas"][rig] * arrays["delta_scales"][rig, :, None, None]
    template = arrays["templates"][face].astype(np.float32)
    return ChannelDecoder(description.motion_space, arrays["resting"][face], template, deltas.astype(np.float32))


def copy_exported(source: Path, folder: Path) -> int:
    """Copy a folder of ``facediff export-model``, whole or not at all.

    Returns:
        the bytes of its files.
    """
    description, _ = read_folder(source)
    with atomic_folder(folder) as staged:
        for name in (DESCRIPTION, ARRAYS, *(f"{graph}.onnx" for graph in description.graphs)):
            shutil.copyfile(source / name, staged / name)
        return sum(path.stat().st_size for path in staged.iterdir())
