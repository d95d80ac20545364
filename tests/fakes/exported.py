"""A folder as ``facediff export-model`` writes it, in miniature: its graphs have a few nodes, made without PyTorch."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from facediff.pipelines.export_model import OPSET, described_ends
from facediff.runtime.folder import ARRAYS, DESCRIPTION, Description, packed_deltas
from facediff.spaces import VERTICES as VERTICES_SPACE
from facediff.spaces import Rotation, Space
from facediff.spaces.arkit import ARKIT, ROTATIONS
from facediff.utils.plain_files import write_json

VERTICES, STATE, WIDTH = 6, 18, 3

FLOAT, INT, BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.BOOL
FRAMES = ["batch", "frames"]
ENDS: dict[str, tuple[dict[str, tuple[int, list[Any]]], dict[str, list[Any]]]] = {
    "speech": (
        {"audio": (FLOAT, ["batch", "samples"]), "mean": (FLOAT, ["batch"]), "mask": (BOOL, FRAMES)},
        {"features": [*FRAMES, WIDTH]},
    ),
    "step": (
        {"features": (FLOAT, [*FRAMES, WIDTH]), "state": (FLOAT, [*FRAMES, STATE]), "step": (INT, ["batch"])},
        {"prediction": [*FRAMES, STATE], "kept": [*FRAMES, STATE]},
    ),
    "motion": ({"sample": (FLOAT, [*FRAMES, STATE])}, {"offsets": [*FRAMES, VERTICES, 3]}),
}

Graphs = dict[str, onnx.ModelProto]


def node(operator: str, inputs: str, outputs: str, **attributes: Any) -> onnx.NodeProto:  # noqa: ANN401
    """A node with the names of its inputs and outputs."""
    return helper.make_node(operator, inputs.split(), outputs.split(), **attributes)


def stored(name: str, value: Any) -> onnx.TensorProto:  # noqa: ANN401
    """A tensor of the file; whole numbers are of 64 bits, others of 32."""
    array = np.asarray(value)
    return numpy_helper.from_array(array.astype(np.int64 if array.dtype.kind in "iu" else np.float32), name)


CHANNELS = Space(
    "arkit",
    (*[name for name in ARKIT if "Left" not in name][: STATE - 3], *ROTATIONS[:3]),
    version="arkit",
    rotations=(Rotation("head", STATE - 3, "euler"),),
    valid_range=(0.0, 1.0),
)
"""A space with as many channels as a state has numbers."""


def graphs(space: Space = VERTICES_SPACE) -> Graphs:
    """The graphs of a model that samples, in a space of its motion."""
    points = [VERTICES, 3] if space.is_vertices else [STATE, 1]
    nodes = {
        "speech": [
            node("Cast", "mask", "wide", to=FLOAT),
            node("Unsqueeze", "wide axis", "column"),
            node("Mul", "column weights", "features"),
        ],
        "step": [node("Mul", "state half", "prediction"), node("Identity", "prediction", "kept")],
        "motion": [node("Reshape", "sample shape", "offsets")],
    }
    tensors = {
        "speech": [stored("axis", [-1]), stored("weights", [0.1, 0.2, 0.3])],
        "step": [stored("half", [0.5])],
        "motion": [stored("shape", [0, 0, *points])],
    }
    made = {}
    for name, (inputs, outputs) in ENDS.items():
        ends = [helper.make_tensor_value_info(key, *value) for key, value in inputs.items()]
        if name == "motion":
            outputs = {"offsets": [*FRAMES, *points]}
        results = [helper.make_tensor_value_info(key, FLOAT, shape) for key, shape in outputs.items()]
        graph = helper.make_graph(nodes[name], name, ends, results, tensors[name])
        made[name] = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10)
    return made


def write_exported(
    folder: Path,
    change: Callable[[Graphs, dict[str, Any]], object] | None = None,
    space: Space = VERTICES_SPACE,
    **changes: object,
) -> Path:
    """Write the folder.

    Args:
        folder: to write.
        change: of the graphs, which are described as they are then, and of what the description says.
        space: of the motion.
        changes: what replaces what the description says.
    """
    folder.mkdir(parents=True)
    documents = graphs(space)
    if change is not None:
        change(documents, changes)
    rng = np.random.default_rng(0)
    arrays: dict[str, Any] = {
        "templates": rng.normal(0, 0.05, (2, VERTICES, 3)).astype(np.float32),
        "styles": rng.normal(size=(2, 4)).astype(np.float32),
        "rest_weights": np.ones((2, VERTICES), np.float32),
        "faces": np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]], np.int32),
    }
    if not space.is_vertices:
        deltas, scales = packed_deltas(rng.normal(0, 0.01, (1, len(space.face), VERTICES, 3)))
        arrays |= {
            "rest_weights": np.ones((2, STATE), np.float32),
            "resting": np.zeros((2, STATE), np.float32),
            "deltas": deltas,
            "delta_scales": scales,
            "rigs": np.zeros(2, np.int32),
        }
    np.savez_compressed(folder / ARRAYS, **arrays)
    for name, document in documents.items():
        (folder / f"{name}.onnx").write_bytes(document.SerializeToString())
    description = Description(
        model="DualPathDiffusion",
        facediff="0",
        corpus="tiny",
        synthetic=True,
        licences={},
        opset=OPSET,
        precision="float32",
        sizes={path.name: path.stat().st_size for path in folder.iterdir()},
        graphs={name: described_ends(document) for name, document in documents.items()},
        sample_rate=16_000,
        frame_rate=25.0,
        unit="m",
        identities=["A", "B"],
        faces=["A", "B"],
        styles=["A", "B"],
        windows={"seconds": 4.0, "overlap": 1.0, "before": 2.0, "after": 0.5, "above": 10.0},
        epsilon=1e-7,
        equal_lengths=False,
        state=STATE,
        kept=STATE,
        sampler="ddim",
        steps=[3, 0],
        table=[[0.5, 0.5, 0.0, 0.0, 0.0]] * 2,
        last_step=0,
        decoded="sample",
        space={} if space.is_vertices else space.state(),
    )
    write_json(folder / DESCRIPTION, {**description.content(), **changes})
    return folder


def fit_sizes(folder: Path) -> None:
    """Let ``model.json`` state the sizes that its files have."""
    path = folder / DESCRIPTION
    content = json.loads(path.read_text())
    content["sizes"] = {each.name: each.stat().st_size for each in folder.iterdir() if each != path}
    path.write_text(json.dumps(content))
