"""An exported folder of a stranger is held to the law: what its graphs may be and cost, and that errors are sentences.

The long test mutates 2 000 folders and runs in about two minutes:
``python -m pytest -n 0 -m slow tests/runtime/test_graph_check.py``. Other numbers and seeds:
``python -m tests.robustness.hostile_folders --rounds 10000 --seed 7``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import facediff
from facediff.errors import FaceDiffError
from facediff.runtime import RuntimeModel, graphs
from facediff.runtime.graph_check import check_graph
from facediff.utils import hub
from facediff.utils.limits import Limits
from tests.fakes.exported import FLOAT, STATE, Graphs, fit_sizes, node, stored, write_exported

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


def total(value: str = "grown") -> onnx.NodeProto:
    return node("ReduceSum", value, "spoilt", keepdims=0)


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


def huge_constant(documents: Graphs, _: dict[str, Any]) -> None:
    documents["step"].graph.initializer[0].dims[:] = [2**40]


def short_constant(documents: Graphs, _: dict[str, Any]) -> None:
    documents["step"].graph.initializer[0].dims[:] = [7]


def huge_value(documents: Graphs, _: dict[str, Any]) -> None:
    documents["step"].graph.value_info.append(helper.make_tensor_value_info("kept", FLOAT, [2**20, 2**20]))


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
    "loop": (bent(node("Loop", "n", "l", body=body()), tensors=[stored("n", 2**62)]), "operator 'Loop'"),
    "branch": (bent(node("If", "c", "l", then_branch=body(), else_branch=body())), "operator 'If'"),
    "subgraph": (bent(node("Identity", "half", "l", body=body())), "another graph"),
    "function": (function, "functions"),
    "domain": (bent(node("Gelu", "half", "l", domain="com.microsoft")), "com.microsoft.Gelu"),
    "random": (bent(node("RandomNormal", "", "l", shape=[9])), "RandomNormal"),
    "external data": (external, "another file"),
    "external data of an attribute": (attribute, "another file"),
    "sparse": (sparse, "sparse"),
    "huge constant": (huge_constant, "FACEDIFF_MAX_BYTES"),
    "short constant": (short_constant, "declared as"),
    "huge value": (huge_value, "FACEDIFF_MAX_BYTES"),
    "constant of 6 GB": (
        bent(node("ConstantOfShape", "n", "grown"), total(), tensors=[stored("n", [1_500_000_000])]),
        "ConstantOfShape: declares .*FACEDIFF_MAX_BYTES",
    ),
    "expanded": (
        bent(node("Expand", "half n", "grown"), total(), tensors=[stored("n", [2**20, 2**20])]),
        "Expand: declares",
    ),
    "tiled": (bent(node("Tile", "half n", "grown"), total(), tensors=[stored("n", [2**40])]), "Tile: declares"),
    "range": (
        bent(node("Range", "o n i", "grown"), tensors=[stored("o", 0), stored("n", 2**40), stored("i", 1)]),
        "Range: declares",
    ),
    "outer product": (
        bent(
            node("Mul", "a b", "grown"),
            total(),
            tensors=[stored("a", np.ones((2**16, 1))), stored("b", np.ones(2**16))],
        ),
        "FACEDIFF_MAX_BYTES",
    ),
    "division": (bent(node("Div", "step n", "l"), tensors=[stored("n", [-1])]), "divides by 'n'"),
    "division by a computed number": (bent(node("Neg", "step", "n"), node("Mod", "step n", "l")), "divides by 'n'"),
    "no inputs": (bent(node("Relu", "", "l")), "step.onnx: ONNX Runtime cannot read it"),
    "empty input": (bent(helper.make_node("Max", ["half", ""], ["l"])), "Max lacks an input"),
    "opset": (lambda documents, _: documents["step"].opset_import[0].__setattr__("version", 21), "version 20"),
    "two graphs": (twice, "step.onnx"),
    "no steps": (lambda _, facts: facts.update(steps=[], table=[]), "steps is"),
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


def test_ends_that_the_description_does_not_state_are_refused(tmp_path: Path) -> None:
    folder = write_exported(tmp_path / "folder")
    documents = onnx.load(folder / "step.onnx")
    documents.graph.output[0].type.tensor_type.shape.dim[2].dim_value = STATE + 1
    (folder / "step.onnx").write_bytes(documents.SerializeToString())
    fit_sizes(folder)
    with pytest.raises(FaceDiffError, match=r"step.onnx: has the outputs .*expected those that model.json describes"):
        RuntimeModel.open(folder)


COMPUTED = [node("Shape", "state", "s"), node("Mul", "s many", "large")]
RUN: dict[str, tuple[Change, str]] = {
    "computed size": (
        bent(*COMPUTED, node("ConstantOfShape", "large", "grown"), total(), tensors=[stored("many", [2**12] * 3)]),
        r"step.onnx of DualPathDiffusion: needs more memory .*FACEDIFF_MAX_BYTES",
    ),
    "computed terabytes": (
        bent(*COMPUTED, node("ConstantOfShape", "large", "grown"), total(), tensors=[stored("many", [2**20] * 3)]),
        r"step.onnx of DualPathDiffusion: ",
    ),
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


def test_a_graph_that_computes_for_too_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    square = [stored("w0", np.full((700, 700), 1e-3))]
    chain = [node("MatMul", f"v{index} w0", f"v{index + 1}") for index in range(300)]
    begin = [node("Cast", "step", "begun", to=FLOAT), node("Mul", "w0 begun", "v0")]
    folder = write_exported(tmp_path / "folder", bent(*begin, *chain, total("v300"), tensors=square))
    model = RuntimeModel.open(folder, threads=1)
    monkeypatch.setattr(graphs, "LIMITS", replace(Limits(), computing=0.2))
    with pytest.raises(FaceDiffError, match=r"step.onnx of .*: computes for more than 0.2 s.*FACEDIFF_MAX_COMPUTING"):
        model.animate(SPEECH)


def test_stored_numbers_of_16_bits_may_stay_narrow(tmp_path: Path) -> None:
    """Those above the limit of opening are widened by every run; ONNX Runtime's merging of both ended the process."""
    program = (
        "import sys\n"
        "from facediff.runtime import graphs\n"
        "graphs.check_graphs = lambda *_: 1000\n"
        "model = graphs.ExportedGraphs.open(sys.argv[1])\n"
        "print(len(model.arrays))\n"
    )
    command = [sys.executable, "-c", program, str(hub.BUNDLED)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_serving_reads_the_graphs_first(tmp_path: Path) -> None:
    from facediff.runtime.site import make_site

    with pytest.raises(FaceDiffError, match="operator 'Loop'"):
        make_site(write_exported(tmp_path / "folder", REFUSED["loop"][0]), {})


def test_the_bundled_model_is_read_quickly() -> None:
    import time

    about = json.loads((hub.BUNDLED / "model.json").read_text())
    begin = time.process_time()
    for name, ends in about["graphs"].items():
        assert check_graph(hub.BUNDLED / f"{name}.onnx", about["opset"], ends) > 50e6
    assert time.process_time() - begin < 0.5  # 0.03 on an idle machine


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_mutated_folders_end_in_motion_or_in_a_sentence(tmp_path: Path) -> None:
    from tests.robustness.hostile_folders import run

    law = run(2000, 0, tmp_path)
    assert law.broken == []
    assert law.counts["read"] > 50
    assert law.counts["refused"] > 500
