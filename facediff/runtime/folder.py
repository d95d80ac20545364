"""The folder of an exported model: what is in it, writing its description, and reading it safely.

``model.json`` says everything that is no array, ``arrays.npz`` holds templates, styles and regions, and each graph is a
file of its own: ``speech.onnx`` and ``motion.onnx`` of every model, ``step.onnx`` of one that samples, ``start.onnx``
where its loop starts from more than noise, ``style.onnx`` of one that takes styles from motion.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.runtime.graph_check import REMEDY, check_graph
from facediff.spaces import VERTICES, Space
from facediff.spaces.decoding import ChannelDecoder
from facediff.speech.voice_activity import OFF, USUAL_GATE
from facediff.speech.windows import FrameClock, Rule, WindowPlan
from facediff.utils.arrays import read_arrays
from facediff.utils.files import atomic_folder
from facediff.utils.limits import quoted
from facediff.utils.plain_files import load_json

FORMAT = "facediff model"
VERSION = 1
DESCRIPTION = "model.json"
ARRAYS = "arrays.npz"
NEEDED = {"sampled": ("speech", "step", "motion"), "direct": ("speech", "motion")}
"""Graphs that every folder has, by the kind of generation."""

OPTIONAL = {"sampled": ("start", "style"), "direct": ("style",)}
"""Graphs that some folders have besides."""

MOST_STEPS = 1000
"""Most diffusion steps that a folder may state."""

Arrays = Mapping[str, npt.NDArray[Any]]

EXPECTED = "expected a folder that `facediff export-model` wrote"


@dataclass(frozen=True)
class Description:
    """Content of ``model.json``.

    Attributes:
        model: class of the model.
        facediff: version that wrote the folder.
        corpus: that the model was trained on.
        synthetic: whether that corpus is synthetic.
        licences: licence labels by what they cover: data, weights …
        opset: of the graphs.
        precision: how weights are stored: ``float32``, ``float16`` or ``int8``.
        sizes: bytes of each file.
        graphs: inputs and outputs of each graph: name, type and shape, with names for what may be of any length.
        sample_rate: of the speech, in Hz.
        frame_rate: of the motion.
        unit: of length.
        identities: training identities, in the order of the identity index.
        faces: identities with a neutral face, in the order of the array ``templates``.
        styles: names of the style vectors, in the order of the array ``styles``; a name of an identity is its default.
        windows: how long speech is cut, as :class:`~facediff.speech.windows.WindowPlan` takes it.
        epsilon: added to the variance of speech before it is standardised.
        equal_lengths: whether all clips of a batch must be of one length; reference motions of one always must.
        state: numbers in a frame of noisy motion.
        kept: numbers in a frame by which windows of long speech are blended.
        sampler: its name.
        steps: the diffusion steps visited.
        table: for each of them the factors of the noisy motion, of the last three predictions (latest first) and noise;
            where there is a sixth, of the first prediction.
        last_step: the step at which only the mean is left.
        decoded: input of the last graph: the ``sample``, or what was ``kept`` of the last step.
        generation: ``sampled``, by a loop over ``step``; or ``direct``, by ``motion`` alone. In a direct model, what is
            said of the loop is 0, empty, and ``last_step`` −1, as in a model that predicts no mean.
        blending: where windows go over into one another: in all ``steps`` of the loop, or in the ``motion``.
        clock: how the model counts frames, as :class:`~facediff.speech.windows.FrameClock` takes it.
        style_source: what a style is: of a ``reference`` motion; a training ``identity``; ``none`` if there are none.
        longest: frames at most of what is animated in one pass; 0 for any number.
        drawn: numbers in a frame of the noise that the loop starts from; ``state`` if 0.
        noise_of: what noise depends on: the ``clip`` and the seed, or the ``seed``.
        stillness: how far the stored references move; reference motion is rejected as another face if its static
            vertices (the array ``still``) deviate by more than a fraction of this.
        quick_steps: the diffusion steps visited at low latency; none where the model does not change its steps.
        quick_table: for each of them, as in ``table``.
        voice_gate: the voice gate where nobody chooses one: ``energy``, or ``off`` for imported models.
        space: what the numbers of the motion mean, as :meth:`facediff.spaces.Space.state` says it; empty for vertices.
        check: the comparison with PyTorch when the folder was written.
    """

    model: str
    facediff: str
    corpus: str
    synthetic: bool
    licences: dict[str, str]
    opset: int
    precision: str
    sizes: dict[str, int]
    graphs: dict[str, dict[str, list[dict[str, Any]]]]
    sample_rate: int
    frame_rate: float
    unit: str
    identities: list[str]
    faces: list[str]
    styles: list[str]
    windows: dict[str, float]
    epsilon: float
    equal_lengths: bool
    state: int
    kept: int
    sampler: str
    steps: list[int]
    table: list[list[float]]
    last_step: int
    decoded: str
    generation: str = "sampled"
    blending: str = "steps"
    clock: dict[str, Any] = field(default_factory=lambda: {"rule": "rounded"})
    style_source: str = "reference"
    longest: int = 0
    drawn: int = 0
    noise_of: str = "clip"
    stillness: float = 0.0
    quick_steps: list[int] = field(default_factory=list)
    quick_table: list[list[float]] = field(default_factory=list)
    voice_gate: str = USUAL_GATE
    space: dict[str, Any] = field(default_factory=dict)
    check: dict[str, Any] = field(default_factory=dict)

    def content(self) -> dict[str, Any]:
        """The JSON object that is written."""
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    @property
    def known(self) -> list[str]:
        """The identities that it was trained on and whose faces it has, or else all faces; the first is the default."""
        return [name for name in self.identities if name in self.faces] or list(self.faces)

    @cached_property
    def motion_space(self) -> Space:
        """What the numbers of the motion mean."""
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


KINDS: dict[str, type | tuple[type, ...]] = {
    "str": str,
    "bool": bool,
    "int": int,
    "float": (int, float),
    "list": list,
    "dict": dict,
}


def read_folder(folder: Path) -> tuple[Description, Arrays]:
    """Description and arrays of an exported model; its graphs are read by :func:`check_graphs`."""
    if not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; {EXPECTED}")
    path = folder / DESCRIPTION
    content = load_json(path, remedy=EXPECTED)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FaceDiffError(f"{path}: does not describe a model; {EXPECTED}")
    if content.get("version") != VERSION:
        raise FaceDiffError(
            f"{path}: has version {str(content.get('version'))[:20]} of the format, this facediff reads {VERSION}; "
            f"export the model again"
        )
    values: dict[str, Any] = {}
    for entry in fields(Description):
        kind = KINDS[str(entry.type).split("[")[0]]
        if entry.name not in content and (entry.default_factory is not MISSING or entry.default is not MISSING):
            continue  # of a folder written before there were models of this kind
        value = content.get(entry.name)
        if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
            raise FaceDiffError(
                f"{path}: {entry.name} is {str(value)[:40]}, expected {entry.type}; export the model again"
            )
        values[entry.name] = value
    description = Description(**values)
    _check(path, description)
    for name in (*(f"{graph}.onnx" for graph in description.graphs), ARRAYS):
        size = (folder / name).stat().st_size if (folder / name).is_file() else None
        if size != description.sizes.get(name):
            problem = "is missing" if size is None else f"has {size} bytes"
            raise FaceDiffError(
                f"{folder / name}: {problem}, expected {description.sizes.get(name)}; copy or export the model again"
            )
    arrays = read_arrays(folder / ARRAYS)
    _check_arrays(folder / ARRAYS, description, arrays)
    _check_ends(path, description, arrays)
    return description, arrays


def check_graphs(folder: Path, description: Description, names: Iterable[str]) -> int:
    """Read graphs of a folder before anything runs them, as :func:`~facediff.runtime.graph_check.check_graph` does.

    Returns:
        how many bytes a node of any of them may have that is computed while it is opened.
    """
    return min(check_graph(folder / f"{name}.onnx", description.opset, description.graphs[name]) for name in names)


def _check(path: Path, description: Description) -> None:
    """Refuse numbers that cannot be."""

    def refuse(name: str, expected: str) -> None:
        raise FaceDiffError(f"{path}: {name} is {str(getattr(description, name))[:40]}, expected {expected}")

    if description.sample_rate != 16_000:
        refuse("sample_rate", "16000")
    if not 1 <= description.frame_rate <= 1000:
        refuse("frame_rate", "1 to 1000")
    if not 0 < description.epsilon < 1:
        refuse("epsilon", "more than 0, less than 1")
    for name, kinds in (
        ("generation", tuple(NEEDED)),
        ("blending", ("steps", "motion")),
        ("style_source", ("reference", "identity", "none")),
        ("noise_of", ("clip", "seed")),
        ("voice_gate", (USUAL_GATE, OFF)),
    ):
        if getattr(description, name) not in kinds:
            refuse(name, " or ".join(kinds))
    needed, optional = NEEDED[description.generation], OPTIONAL[description.generation]
    if not {*needed} <= {*description.graphs} <= {*needed, *optional}:
        refuse("graphs", ", ".join(needed))
    sampled = description.generation == "sampled"
    for name, least in (("state", 1), ("kept", 1), ("drawn", 0), ("longest", 0), ("last_step", -1)):
        if not (least if sampled else min(least, 0)) <= getattr(description, name) <= 10_000_000:
            refuse(name, f"{least} to 10000000")
    for steps, table, least in (("steps", "table", int(sampled)), ("quick_steps", "quick_table", 0)):
        visited, rows = getattr(description, steps), getattr(description, table)
        if not least <= len(visited) <= MOST_STEPS or not all(type(n) is int and 0 <= n < 2**31 for n in visited):
            refuse(steps, f"{least} to {MOST_STEPS} steps of the noise process")
        if len(rows) != len(visited) or not all(
            isinstance(row, list)
            and len(row) in (5, 6)
            and all(isinstance(n, int | float) and abs(n) < 1e9 for n in row)
            for row in rows
        ):
            refuse(table, "five or six numbers for each step, below 10^9")
    if description.decoded not in ("sample", "kept"):
        refuse("decoded", "sample or kept")
    for name in ("identities", "faces", "styles"):
        if not all(isinstance(text, str) for text in getattr(description, name)):
            refuse(name, "names")
    if not description.faces:
        refuse("faces", "one name at least")
    _check_clock(refuse, description)
    try:
        _ = description.motion_space
    except FaceDiffError as error:
        raise FaceDiffError(f"{path}: {error}. Export the model again") from error
    try:
        description.plan.in_frames(description.frame_rate)
    except (FaceDiffError, TypeError) as error:
        raise FaceDiffError(f"{path}: windows: {error}") from error


def _check_clock(refuse: Callable[[str, str], None], description: Description) -> None:
    """Refuse a clock that cannot be."""

    def whole(value: object, most: int) -> bool:
        return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most

    clock = description.clock
    layers = clock.get("convolutions", [])
    fits = (
        {*clock} <= {"rule", "rows", "convolutions"}
        and clock.get("rule") in get_args(Rule)
        and whole(clock.get("rows", 1), 1000)
        and isinstance(layers, list)
        and len(layers) <= 64
        and all(
            isinstance(layer, list) and len(layer) == 2 and all(whole(size, 10_000) for size in layer)
            for layer in layers
        )
    )
    if not fits:
        refuse("clock", f"a rule ({', '.join(get_args(Rule))}) with rows and convolutions")


def _check_arrays(path: Path, description: Description, arrays: Arrays) -> None:
    """Refuse arrays that do not fit the description."""

    def need(name: str, shape: tuple[int | None, ...], kinds: str) -> None:
        if name not in arrays:
            raise FaceDiffError(f"{path}: has no {name}; export the model again")
        array = arrays[name]
        fits = array.ndim == len(shape) and all(
            want in (None, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in kinds:
            raise FaceDiffError(f"{path}: {name} is {array.dtype} {array.shape}; export the model again")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise FaceDiffError(f"{path}: {name} holds numbers that are not finite; export the model again")

    need("templates", (len(description.faces), None, 3), "f")
    vertices = arrays["templates"].shape[1]
    if description.style_source == "reference":
        need("styles", (len(description.styles), None), "f")
    space = description.motion_space
    need("rest_weights", (len(description.faces), len(space.channels) or vertices), "f")
    if not space.is_vertices:
        need("resting", (len(description.faces), len(space.channels)), "f")
        need("deltas", (None, len(space.face), vertices, 3), "i")
        rigs = len(arrays["deltas"])
        need("delta_scales", (rigs, len(space.face)), "f")
        need("rigs", (len(description.faces),), "i")
        if not 0 <= int(arrays["rigs"].min()) <= int(arrays["rigs"].max()) < rigs:
            raise FaceDiffError(f"{path}: rigs names one that does not exist; export the model again")
    if "noise" in arrays:
        need("noise", (description.state, description.state), "f")
    if "faces" in arrays:
        need("faces", (None, 3), "iu")
    if "colours" in arrays:
        each = (len(description.faces),) if arrays["colours"].ndim == 3 else ()  # one for all faces, or one for each
        need("colours", (*each, vertices, 3), "u")
    if "inner_lip_pairs" in arrays:
        need("inner_lip_pairs", (None, 2), "iu")
    for name in arrays:
        if name.startswith("region_") or name == "still":
            need(name, (None,), "iu")
        if name.startswith("region_") or name in ("faces", "inner_lip_pairs", "still"):
            indices = arrays[name]
            if indices.size and not 0 <= int(indices.min()) <= int(indices.max()) < vertices:
                raise FaceDiffError(f"{path}: {name} names vertices that do not exist; export the model again")


def _check_ends(path: Path, description: Description, arrays: Arrays) -> None:
    """Refuse graphs whose inputs and outputs are not those of the model that the description and the arrays state."""
    about, graphs, space = description, description.graphs, description.motion_space
    points = [len(space.channels) or arrays["templates"].shape[1], space.dims]
    try:
        features = graphs["speech"]["outputs"][0]["shape"][2:]
    except (KeyError, TypeError, IndexError) as error:
        raise FaceDiffError(f"{path}: graphs describes no speech features; {REMEDY}") from error
    style = arrays["styles"].shape[1] if about.style_source == "reference" else 0
    drawn, decoded = about.drawn or about.state, about.kept if about.decoded == "kept" else about.state
    frames = ["batch", "frames"]
    shared: dict[str, list[Any]] = {
        **{"features": ["float", *frames, *features], "mask": ["bool", *frames], "identity": ["int64", "batch"]},
        **{"style": ["float", "batch", style], "template": ["float", "batch", *points]},
    }
    loop: dict[str, list[Any]] = {
        **{"state": ["float", *frames, about.state], "step": ["int64", "batch"]},
        **{"before": ["float", *frames, about.kept], "share": ["float", *frames]},
    }
    heard: dict[str, list[Any]] = {
        **{"audio": ["float", "batch", "samples"], "mean": ["float", "batch"], "deviation": ["float", "batch"]},
        **{"samples": ["int64", "batch"], "mask": ["bool", *frames]},
    }
    noise, offsets = ["float", *frames, drawn], ["float", *frames, *points]
    expected: dict[str, tuple[Mapping[str, list[Any]], list[list[Any]]]] = {
        "speech": (heard, [shared["features"]]),
        "start": ({"noise": noise}, [loop["state"]]),
        "step": ({**shared, **loop}, [loop["state"], loop["before"]]),
        "motion": ({"sample": ["float", *frames, decoded], "noise": noise}, [offsets]),
        "style": ({"motion": offsets, "mask": heard["mask"]}, [["float", "batch", style]]),
    }
    if about.generation == "direct":
        expected["motion"] = shared, [offsets]
    for graph, (inputs, outputs) in expected.items():
        for key in ("inputs", "outputs") if graph in graphs else ():
            ends = graphs[graph].get(key) if isinstance(graphs[graph], dict) else None
            fits = isinstance(ends, list) and len(ends) > 0 and all(isinstance(end, dict) for end in ends)
            wanted = [inputs.get(str(end.get("name"))) for end in ends or ()] if fits and key == "inputs" else outputs
            if not fits or len(ends or ()) != len(wanted) or not all(map(_is_end, ends or (), wanted)):
                raise FaceDiffError(
                    f"{path}: {key} of the graph {graph} are {quoted(ends)}, expected those of a model with "
                    f"{about.state} numbers of state, {about.kept} kept and {points[0]} points of {points[1]}; {REMEDY}"
                )


def _is_end(end: Mapping[str, Any], wanted: list[Any] | None) -> bool:
    """Whether an input or output has a type and a shape; text stands for any length."""
    shape = end.get("shape")
    if wanted is None or end.get("type") != wanted[0] or not isinstance(shape, list) or len(shape) + 1 != len(wanted):
        return False
    return all(
        isinstance(size, str) if isinstance(want, str) else type(size) is int and size == want
        for size, want in zip(shape, wanted[1:], strict=True)
    )


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

    Raises:
        FaceDiffError: if the source is damaged or the folder cannot be written.
    """
    description, _ = read_folder(source)
    with atomic_folder(folder) as staged:
        for name in (DESCRIPTION, ARRAYS, *(f"{graph}.onnx" for graph in description.graphs)):
            shutil.copyfile(source / name, staged / name)
        return sum(path.stat().st_size for path in staged.iterdir())
