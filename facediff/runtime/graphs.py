"""The graphs of an exported model in ONNX Runtime, with the description and the arrays of its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.runtime.folder import Arrays, Description, read_folder

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

Array = npt.NDArray[np.float32]


class ExportedGraphs:
    """What a folder of ``facediff export-model`` holds, ready to run.

    Args:
        description: of the folder.
        arrays: of the folder.
        load: opens a graph by its name.

    Attributes:
        description: content of ``model.json``.
        arrays: content of ``arrays.npz``.
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
        import onnxruntime

        folder = Path(folder)
        description, arrays = read_folder(folder)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3  # warnings are about optimisations that do not apply
        # Threads that wait by spinning take the processor from whatever else runs: where something does, a frame takes
        # twice as long.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")

        def load(name: str) -> onnxruntime.InferenceSession:
            path = folder / f"{name}.onnx"
            try:
                return onnxruntime.InferenceSession(
                    path, options, providers=list(providers or ["CPUExecutionProvider"])
                )
            except Exception as error:  # ONNX Runtime's own errors share no base class
                raise FaceDiffError(
                    f"{path}: ONNX Runtime cannot read it ({str(error)[:80]}); export the model again"
                ) from error

        return cls(description, arrays, load)

    @property
    def frame_rate(self) -> float:
        """Motion frames a second."""
        return self.description.frame_rate

    def has(self, graph: str) -> bool:
        """Whether the folder has such a graph."""
        return graph in self.description.graphs

    def run(self, graph: str, inputs: Mapping[str, npt.NDArray[Any]]) -> list[Array]:
        """Results of a graph, which ignores the inputs that it does not declare."""
        if graph not in self._sessions:
            self._sessions[graph] = self._load(graph)
        session = self._sessions[graph]
        declared = {node.name for node in session.get_inputs()}
        return cast(list[Array], session.run(None, {name: inputs[name] for name in inputs if name in declared}))
