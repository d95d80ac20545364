"""The graphs of an exported model in ONNX Runtime, with the description and the arrays of its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.runtime.folder import Arrays, Description, read_folder
from facediff.runtime.graph_check import REMEDY, check_graph
from facediff.utils.limits import brief

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

Array = npt.NDArray[np.float32]


class ExportedGraphs:
    """Content of a folder of ``facediff export-model``, ready to run.

    Attributes:
        clock: how the model counts its frames.
        loop: each step with its row of the sampler's table.
    """

    def __init__(
        self, description: Description, arrays: Arrays, load: Callable[[str], onnxruntime.InferenceSession]
    ) -> None:
        self.description = description
        self.clock = description.frame_clock
        self.arrays = arrays
        self.loop = list(zip(description.steps, description.table, strict=True))
        self._load = load
        # What encodes styles is opened where it is needed: most animations take a style by its name.
        self._sessions = {name: load(name) for name in description.graphs if name != "style"}

    @classmethod
    def open(cls, folder: str | Path, *, threads: int = 0, providers: Sequence[str] | None = None) -> Self:
        """Read a folder of ``facediff export-model``.

        Args:
            folder: the folder.
            threads: of the processor; as many as it has cores if 0.
            providers: what computes, by ONNX Runtime's names; the processor if None.
        """
        folder = Path(folder)
        description, arrays = read_folder(folder)

        def load(name: str) -> onnxruntime.InferenceSession:
            return open_session(folder / f"{name}.onnx", threads=threads, providers=providers)

        return cls(description, arrays, load)

    @property
    def frame_rate(self) -> float:
        """Motion frames a second."""
        return self.description.frame_rate

    def run(self, graph: str, inputs: Mapping[str, npt.NDArray[Any]]) -> list[Array]:
        """Results of a graph in the description's order; inputs that it does not declare are ignored."""
        if graph not in self._sessions:
            self._sessions[graph] = self._load(graph)
        session = self._sessions[graph]
        declared = {node.name for node in session.get_inputs()}
        arguments = {name: inputs[name] for name in inputs if name in declared}
        ends, axes = self.description.graphs[graph], dict[str, int]()
        for end in ends.get("inputs", ()):
            axes.update(zip(end["shape"], arguments[end["name"]].shape, strict=False))
        what = f"{graph}.onnx of {self.description.model}"
        results = run_session(session, arguments, what, [end["name"] for end in ends.get("outputs", ())])
        for end, result in zip(ends.get("outputs", ()), results, strict=False):
            shape = tuple(axes.get(size, size) for size in end["shape"])
            flat = result.ravel()
            with np.errstate(all="ignore"):
                if result.shape == shape and result.dtype == np.float32 and np.isfinite(flat @ flat):
                    continue
            raise FaceDiffError(
                f"{what}: gives {result.dtype} {result.shape} as {end['name']}, expected finite float32 {shape}; "
                f"{REMEDY}"
            )
        return results


def open_session(
    path: Path, *, threads: int = 0, providers: Sequence[str] | None = None
) -> onnxruntime.InferenceSession:
    """Open a graph that :func:`~facediff.runtime.graph_check.check_graph` lets pass; as :meth:`ExportedGraphs.open`."""
    import onnxruntime

    check_graph(path)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised; warnings are about optimisations that do not apply
    # Threads that wait by spinning take the processor from other programs: where some run, a frame takes
    # twice as long.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # as it was checked, never as another format
    try:
        return onnxruntime.InferenceSession(path, options, providers=list(providers or ["CPUExecutionProvider"]))
    except Exception as error:  # ONNX Runtime's own errors share no base class
        raise FaceDiffError(f"{path}: ONNX Runtime cannot read it ({brief(error)}); {REMEDY}") from error


def run_session(
    session: onnxruntime.InferenceSession,
    inputs: Mapping[str, npt.NDArray[Any]],
    source: str,
    outputs: Sequence[str] | None = None,
) -> list[Array]:
    """Results of a graph, by the names of its outputs or all in its order; ``source`` is the graph in messages."""
    import onnxruntime

    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # the error says it
    try:
        return cast(list[Array], session.run(outputs, dict(inputs), options))
    except Exception as error:  # ONNX Runtime's own errors share no base class
        raise FaceDiffError(f"{source}: cannot be computed ({brief(error)}); {REMEDY}") from error
