"""An exported folder of a stranger: its graphs have known operators and read no files, and errors are sentences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import facediff
from facediff.errors import FaceDiffError
from facediff.runtime import RuntimeModel
from tests.fakes.exported import FLOAT, Graphs, node, stored, write_exported

SPEECH = np.random.default_rng(0).normal(size=4800).astype(np.float32) * 0.1

Change = Callable[[Graphs, dict[str, Any]], object]


def bent(*nodes: onnx.NodeProto, tensors: list[onnx.TensorProto] | None = None, graph: str = "step") -> Change:
    """Nodes before those of a graph; a value ``spoilt`` becomes a part of the first result."""

    def change(documents: Graphs, _: dict[str, Any]) -> None:
        inner = documents[graph].graph
        for place, each in enumerate(nodes):
            inner.node.insert(place, each)
        inner.initializer.extend(tensors or [])
        if any("spoilt" in each.output for each in nodes):
            inner.node[len(nodes)].output[0] = "clean"
            inner.node.append(node("Add", "clean spoilt", "prediction"))

    return change


def body() -> onnx.GraphProto:
    ends = [helper.make_tensor_value_info("b", FLOAT, [])]
    return helper.make_graph([node("Constant", "", "b", value_float=1.0)], "body", [], ends)


def external(documents: Graphs, _: dict[str, Any]) -> None:
    tensor = documents["step"].graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")


def function(documents: Graphs, _: dict[str, Any]) -> None:
    made = helper.make_function("mine", "F", ["x"], ["y"], [node("Identity", "x", "y")], [helper.make_opsetid("", 20)])
    documents["step"].functions.append(made)


def sparse(documents: Graphs, _: dict[str, Any]) -> None:
    made = helper.make_sparse_tensor(stored("s", [1.0]), stored("i", [0]), [2**40])
    documents["step"].graph.sparse_initializer.append(made)


def attribute(documents: Graphs, _: dict[str, Any]) -> None:
    tensor = stored("v", [1.0])
    tensor.external_data.add(key="location", value="/etc/passwd")
    bent(node("Constant", "", "c", value=tensor))(documents, {})


def twice(documents: Graphs, _: dict[str, Any]) -> None:
    """Readers of Protocol Buffers join two messages of one field, so that a graph's nodes could stand in the other."""

    class Twice:
        graph = documents["step"].graph
        whole = documents["step"].SerializeToString()

        def SerializeToString(self) -> bytes:  # noqa: N802
            hidden = onnx.ModelProto(graph=onnx.GraphProto(node=[node("Loop", "", "z", body=body())]))
            return hidden.SerializeToString() + self.whole

    documents["step"] = Twice()  # type: ignore[assignment]


REFUSED: dict[str, tuple[Change, str]] = {
    "loop": (bent(node("Loop", "n", "l", body=body()), tensors=[stored("n", 2**62)]), "'Loop'"),
    "branch": (bent(node("If", "c", "l", then_branch=body(), else_branch=body())), "'If'"),
    "subgraph": (bent(node("Identity", "half", "l", body=body())), "another graph"),
    "function": (function, "functions"),
    "domain": (bent(node("Gelu", "half", "l", domain="com.microsoft")), "com.microsoft.Gelu"),
    "random": (bent(node("RandomNormal", "", "l", shape=[9])), "RandomNormal"),
    "external data": (external, "another file"),
    "external data of an attribute": (attribute, "another file"),
    "sparse": (sparse, "sparse"),
    "no inputs": (bent(node("Relu", "", "l")), "step.onnx: ONNX Runtime cannot read it"),
    "two graphs": (twice, "step.onnx"),
    "no steps": (lambda _, facts: facts.update(steps=[], table=[]), "of one step at least"),
    "endless factor": (lambda _, facts: facts.update(table=[[0, 1e308, 0, 0, 0]] * 2), "table has"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_hostile_folder_is_refused_before_it_is_run(case: str, tmp_path: Path) -> None:
    change, named = REFUSED[case]
    folder = write_exported(tmp_path / "folder", change)
    with pytest.raises(FaceDiffError, match=named) as caught:
        facediff.load(folder).animate(SPEECH, 16_000)
    assert str(folder) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_the_folder_itself_animates(tmp_path: Path) -> None:
    model = RuntimeModel.open(write_exported(tmp_path / "folder"))
    assert model.animate(SPEECH).vertices.shape == (8, 6, 3)


RUN: dict[str, tuple[Change, str]] = {
    "another shape": (
        lambda documents, _: documents["motion"].graph.initializer[0].CopyFrom(stored("shape", [0, -1, 2, 3])),
        r"motion.onnx",
    ),
    "not finite": (
        bent(node("Log", "minus", "spoilt"), tensors=[stored("minus", -1.0)]),
        r"step.onnx of DualPathDiffusion: gives",
    ),
    "impossible": (bent(node("Gather", "half n", "spoilt"), tensors=[stored("n", [99])]), r"step.onnx"),
}


@pytest.mark.parametrize("case", RUN)
def test_what_a_graph_makes_when_it_runs_is_held_to_the_law(case: str, tmp_path: Path) -> None:
    change, named = RUN[case]
    folder = write_exported(tmp_path / "folder", change)
    with pytest.raises(FaceDiffError, match=named):
        RuntimeModel.open(folder).animate(SPEECH)


def test_fewer_frames_than_declared_are_refused(tmp_path: Path) -> None:
    def change(documents: Graphs, _: dict[str, Any]) -> None:
        inner = documents["motion"].graph
        inner.node[0].input[0] = "cut"
        inner.node.insert(0, node("Slice", "sample from to axis", "cut"))
        inner.initializer.extend([stored("from", [1]), stored("to", [9]), stored("axis", [1])])

    model = RuntimeModel.open(write_exported(tmp_path / "folder", change))
    with pytest.raises(FaceDiffError, match=r"motion.onnx of .*: gives float32 \(1, 7, 6, 3\) as offsets, expected"):
        model.animate(SPEECH)


def test_serving_reads_the_graphs_first(tmp_path: Path) -> None:
    from facediff.runtime.site import make_site

    with pytest.raises(FaceDiffError, match="'Loop'"):
        make_site(write_exported(tmp_path / "folder", REFUSED["loop"][0]), {})
