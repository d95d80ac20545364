"""The graphs of an exported model in ONNX Runtime, with the description and the arrays of its folder."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.runtime.folder import Arrays, Description, check_graphs, read_folder
from facediff.runtime.graph_check import REMEDY
from facediff.utils.limits import LIMITS, brief

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
        folder = Path(folder)
        description, arrays = read_folder(folder)

        def load(name: str) -> onnxruntime.InferenceSession:
            path = folder / f"{name}.onnx"
            largest = check_graphs(folder, description, [name])
            return open_session(path, largest, threads=threads, providers=providers)

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
        given = {name: inputs[name] for name in inputs if name in declared}
        ends, axes = self.description.graphs[graph], dict[str, int]()
        for end in ends.get("inputs", ()):
            axes.update(zip(end["shape"], given[end["name"]].shape, strict=False))
        what = f"{graph}.onnx of {self.description.model}"
        results = run_session(session, given, what, seconds=math.ceil(axes.get("frames", 1) / self.frame_rate))
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
    path: Path, largest: int, *, threads: int = 0, providers: Sequence[str] | None = None
) -> onnxruntime.InferenceSession:
    """Open a graph that :func:`~facediff.runtime.graph_check.check_graph` has read.

    Args:
        path: the graph.
        largest: bytes that a node may have that is computed while the graph is opened.
        threads: of the processor; as many as it has cores if 0.
        providers: what computes, by ONNX Runtime's names; the processor if None.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # errors are raised; warnings are about optimisations that do not apply
    # Threads that wait by spinning take the processor from whatever else runs: where something does, a frame takes
    # twice as long.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.use_env_allocators", "1")
    # Where shapes contradict one another, optimisations may end the process. So may the one that is left out: it merges
    # stored numbers of 16 bits that were not widened on opening, and otherwise has nothing to do.
    options.add_session_config_entry("session.strict_shape_type_inference", "1")
    options.add_session_config_entry(
        "optimization.disable_specified_optimizers", "FuseFp16InitializerToFp32NodeTransformer"
    )
    options.add_session_config_entry("optimization.constant_folding_max_output_size_in_bytes", str(largest))
    try:
        limit_memory()
        return onnxruntime.InferenceSession(path, options, providers=list(providers or ["CPUExecutionProvider"]))
    except Exception as error:  # ONNX Runtime's own errors share no base class
        raise FaceDiffError(f"{path}: ONNX Runtime cannot read it ({brief(error)}); {REMEDY}") from error


def run_session(
    session: onnxruntime.InferenceSession, inputs: Mapping[str, npt.NDArray[Any]], what: str, *, seconds: float = 1
) -> list[Array]:
    """Results of a graph.

    Args:
        session: the graph.
        inputs: those that it declares.
        what: what messages call it.
        seconds: of motion that it computes, which bound how long it may take.
    """
    allowed = LIMITS.computing * max(1, seconds)
    try:
        with limited_time(allowed) as options:
            return cast(list[Array], session.run(None, dict(inputs), options))
    except Exception as error:  # ONNX Runtime's own errors share no base class
        if options.terminate:
            problem = f"computes for more than {allowed:g} s; if you trust it, set FACEDIFF_MAX_COMPUTING higher"
        elif "requested b" in str(error) or isinstance(error, MemoryError):
            problem = (
                f"needs more memory than {LIMITS.bytes:g} bytes; animate in shorter windows, or, if you trust it, "
                f"set FACEDIFF_MAX_BYTES higher"
            )
        else:
            problem = f"cannot be computed ({brief(error)}); {REMEDY}"
        raise FaceDiffError(f"{what}: {problem}") from error


def limit_memory() -> None:
    """Let the session that is opened next take no more memory than the budget, what its operators compute included."""
    import onnxruntime

    kinds = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    limit = onnxruntime.OrtArenaCfg({"max_mem": int(min(LIMITS.bytes, 1 << 62))})
    # A session keeps the allocator that is registered when it is opened, so that each has a budget of its own. Where
    # ONNX Runtime refuses to register a second one, all share the first.
    with suppress(Exception):
        onnxruntime.create_and_register_allocator(onnxruntime.OrtMemoryInfo("Cpu", *kinds), limit)


_RUNNING: dict[onnxruntime.RunOptions, float] = {}
"""Graphs that compute, and until when they may."""

_WATCH: list[threading.Thread] = []
"""The thread that ends them: one for all, since starting a thread takes longer than the run of a small graph."""


@contextmanager
def limited_time(seconds: float) -> Iterator[onnxruntime.RunOptions]:
    """Options of a run that ends with an error after so many seconds; an operator that has begun is finished first."""
    import onnxruntime

    options = onnxruntime.RunOptions()
    options.log_severity_level = 4  # what is wrong is said by the error
    _RUNNING[options] = time.monotonic() + seconds
    if not (_WATCH and _WATCH[0].is_alive()):
        _WATCH[:] = [threading.Thread(target=_watch, name="facediff graphs", daemon=True)]
        _WATCH[0].start()
    try:
        yield options
    finally:
        del _RUNNING[options]


def _watch() -> None:
    while True:
        time.sleep(min(1.0, LIMITS.computing / 2))
        for options, end in list(_RUNNING.items()):
            if time.monotonic() > end:
                options.terminate = True
