"""Mutated folders of exported models, each opened and, if it is accepted, made to animate 0.3 s of speech.

The law: an animation, or a :class:`FaceDiffError` of one line; within a minute and a bounded address space. Workers are
processes of their own, so that a crash of ONNX Runtime is seen. ``python -m tests.robustness.hostile_folders --rounds
2000 --seed 0`` prints the counts.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError
from tests.robustness.mutations import INTEGERS, Law, json_leaf, mutate

BUDGET, SPACE, SECONDS = 128 * 2**20, 3 * 2**30, 60
"""Bytes for a graph and seconds of a processor; the address space is that of a worker with all of its libraries."""


def change_graph(data: bytes, rng: random.Random) -> bytes:
    """A graph that is valid as a message, in which something is another."""
    import onnx

    document = onnx.load_from_string(data)
    graph = document.graph
    for _ in range(rng.choice([1, 1, 2, 8])):
        with suppress(IndexError, TypeError, ValueError):  # an earlier change has left nothing to change
            change_once(graph, rng)
    return document.SerializeToString()


def change_once(graph: Any, rng: random.Random) -> None:  # noqa: ANN401 - onnx.GraphProto
    """One change of a node, a tensor or a declared value."""
    from onnx import numpy_helper

    from facediff.runtime.graph_check import OPERATORS

    node, tensor = rng.choice(graph.node), rng.choice(graph.initializer)
    number = rng.choice([*INTEGERS, 2, 3, 5, 100, 2**16])
    kind = rng.randrange(9)
    if kind == 0:
        node.op_type = rng.choice([*OPERATORS, "Loop", "If", "Scan", "RandomNormal", "NonZero"])
    elif kind == 1 and node.input:
        others = [*rng.choice(graph.node).output, tensor.name, graph.input[0].name, ""]
        node.input[rng.randrange(len(node.input))] = rng.choice(others)
    elif kind == 2 and node.attribute:
        attribute = rng.choice(node.attribute)
        attribute.i = number
        attribute.ints[:] = [rng.choice([number, each]) for each in attribute.ints]
    elif kind == 3:
        array = numpy_helper.to_array(tensor).copy()
        if array.size:
            with np.errstate(all="ignore"):
                array.flat[rng.randrange(array.size)] = np.array(number).astype(array.dtype)
        tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
    elif kind == 4:
        tensor.dims[:] = rng.choice([[number], [*tensor.dims, 1], list(tensor.dims)[::-1], []])
    elif kind == 5:
        graph.node.remove(node)
    elif kind == 6:
        value = rng.choice([*graph.input, *graph.output, *graph.value_info])
        dims = value.type.tensor_type.shape.dim
        if dims:
            dims[rng.randrange(len(dims))].dim_value = number
    elif kind == 7:
        small = [each for each in graph.initializer if each.data_type == 7 and sum(each.dims) < 9]
        if small:
            chosen = rng.choice(small)
            array = numpy_helper.to_array(chosen).copy().reshape(-1)
            array[rng.randrange(len(array)) if len(array) else slice(0)] = number
            shape = tuple(chosen.dims)
            chosen.CopyFrom(numpy_helper.from_array(array.reshape(shape), chosen.name))
    else:
        tensor.data_type = rng.randrange(25)


def spoil(folder: Path, rng: random.Random) -> str:
    """Damage one file of a folder, whose description states the sizes that its files then have; what was done."""
    from tests.fakes.exported import fit_sizes

    path = rng.choice([each for each in sorted(folder.iterdir()) if each.suffix in (".json", ".npz", ".onnx")] * 2)
    data = path.read_bytes()
    kind, body = "number", data
    if path.suffix == ".onnx" and rng.random() < 0.7:
        kind, body = "graph", change_graph(data, rng)
    elif path.suffix == ".json" and rng.random() < 0.7:
        kind, body = "leaf", json_leaf(data, rng)
    else:
        kind, body = mutate(data, rng, path.suffix)
    path.unlink()  # it may be a link
    path.write_bytes(body)
    if path.suffix != ".json":
        fit_sizes(folder)
    return f"{path.name}, {kind}"


def work(seed: int, begin: int, end: int, place: Path) -> None:
    """Print one line of JSON for each folder: its number, what was done, and what came of it."""
    import onnxruntime  # noqa: F401 - before the address space is bounded

    from facediff.runtime import RuntimeModel
    from facediff.utils.hub import BUNDLED
    from tests.fakes.exported import write_exported

    resource.setrlimit(resource.RLIMIT_AS, (SPACE, SPACE))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    tiny = write_exported(place / "tiny") if not (place / "tiny").exists() else place / "tiny"
    speech = np.random.default_rng(0).normal(size=4800).astype(np.float32) * 0.1
    for index in range(begin, end):
        rng, folder = random.Random(f"{seed} {index}"), place / f"folder {index}"  # noqa: S311
        source = BUNDLED if index % 3 == 0 else tiny
        folder.mkdir()
        for each in source.iterdir():
            (shutil.copyfile if each.suffix == ".json" else os.symlink)(each.resolve(), folder / each.name)
        what = f"{source.name}, {spoil(folder, rng)}"
        print(json.dumps([index, what, None, ""]), flush=True)
        signal.alarm(SECONDS)
        outcome, problem = "read", ""
        try:
            RuntimeModel.open(folder, threads=1).animate(speech)
        except FaceDiffError as error:
            outcome, problem = "refused", "" if len(str(error).splitlines()) == 1 else f"not one line: {error}"
        except BaseException as error:  # noqa: BLE001 - whatever else breaks the law
            outcome, problem = "broke", f"{type(error).__name__}: {error}"
        signal.alarm(0)
        print(json.dumps([index, what, outcome, problem]), flush=True)
        shutil.rmtree(folder)


def run(rounds: int, seed: int, place: Path) -> Law:
    """Mutate so many folders, in workers that are started anew where one dies."""
    law, begin = Law(), 0
    environment = {
        **os.environ,
        "FACEDIFF_MAX_BYTES": str(BUDGET),
        "FACEDIFF_MAX_COMPUTING": "5",
        "OMP_NUM_THREADS": "1",
    }
    while begin < rounds:
        words = ["--worker", str(place), "--seed", str(seed), "--begin", str(begin), "--rounds", str(rounds)]
        command = [sys.executable, "-m", "tests.robustness.hostile_folders", *words]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            index, what, outcome, problem = begin, "", None, ""
            for line in process.stdout or ():
                index, what, outcome, problem = json.loads(line)
                if outcome is not None:
                    law.counts[outcome] += 1
                    if problem:
                        law.broken.append(f"seed {seed}, round {index}, {what}: {problem}"[:500])
        if outcome is None:
            law.counts["broke"] += 1
            law.broken.append(f"seed {seed}, round {index}, {what}: the worker ended with {process.returncode}")
        begin = index + 1
    return law


def main() -> int:
    """Print the counts; 1 if the law was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("--rounds", 2000), ("--seed", 0), ("--begin", 0)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        work(args.seed, args.begin, args.rounds, args.worker)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        law = run(args.rounds, args.seed, Path(folder))
    print(f"{dict(law.counts)}; {len(law.broken)} broke the law", *law.broken[:20], sep="\n    ")
    return int(bool(law.broken))


if __name__ == "__main__":
    sys.exit(main())
