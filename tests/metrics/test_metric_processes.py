"""Two gloo processes get the digits of one, also when one of them has no sequence."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist

from facediff.metrics import RealTimeFactor, Region, ShannonIndex, protocol
from tests.fakes.processes import Forked
from tests.metrics.further_cases import CASES, LIPS, UPPER, pair_batch

Corpus = Any  # the class of that name in conftest.py, which test files cannot import
Batches = dict[str, list[dict[str, Any]]]
CHOSEN = list({case.make().__class__: case for case in reversed(CASES)}.values())
ROUNDS: list[list[list[int]]] = [[[0, 1, 2], [3, 4]], [[0, 1, 2, 3, 4], []], [[], []]]
"""Sequences by rank: unequal shares, all on rank 0, none at all."""


def metrics() -> dict[str, Any]:
    return {
        **{case.name: case.make() for case in CHOSEN},
        "speed": RealTimeFactor("this machine"),
        "shannon": ShannonIndex([3, 4], clusters=5),
        "protocol": protocol("facediffuser").build(Region("lips", LIPS), Region("upper", UPPER)),
    }


def batches_of(corpus: Corpus) -> Batches:
    """What each metric is fed for each of the five sequences."""
    found = {case.name: [case.arguments(corpus, [place], 0) for place in range(5)] for case in CHOSEN}
    found["speed"] = [{"computing": float(place), "speech": 1.0 + place} for place in range(5)]
    found["shannon"] = [pair_batch(corpus, [place], 0) for place in range(5)]
    found["protocol"] = [corpus.batch([place]) for place in range(5)]
    return found


def told(metric: Any) -> Any:  # noqa: ANN401
    """What a metric gives and has counted, also in other processes, or its complaint; its own states stay."""
    before = repr(getattr(metric, "metric_state", None))
    try:
        value = metric.compute()
    except ValueError as error:
        return str(error)
    assert repr(getattr(metric, "metric_state", None)) == before
    counted = [getattr(metric, name)() for name in ("coverage", "summary") if hasattr(metric, name)]
    values = value if isinstance(value, dict) else {"value": value}
    return {name: number.item() for name, number in values.items()}, str(counted)


def work(rank: int, folder: Path, batches: Batches) -> None:
    """Score this process's part of every round."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    found: dict[str, list[Any]] = {}
    for name, metric in metrics().items():
        found[name] = []
        for shares in ROUNDS:
            metric.reset()
            for place in shares[rank]:
                metric.update(**batches[name][place])
            found[name].append(told(metric))
        metric.update(**batches[name][rank])  # after the error above every metric still works
        found[name].append(told(metric))
    torch.save(found, folder / f"{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_equal_one(corpus: Corpus, tmp_path: Path) -> None:
    batches = batches_of(corpus)
    processes = [Forked(partial(work, rank, tmp_path, batches)) for rank in range(2)]
    try:
        codes = [process.wait(timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert codes == [0, 0], processes[0].printed(1)
    written = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    for name, metric in metrics().items():
        expected = []
        for places in (range(5), range(2)):
            metric.reset()
            for place in places:
                metric.update(**batches[name][place])
            expected.append(told(metric))
        for split, lopsided, nothing, afterwards in (each[name] for each in written):
            for found, wanted in ((split, expected[0]), (lopsided, expected[0]), (afterwards, expected[1])):
                assert found[1:] == wanted[1:], name
                assert isinstance(wanted, str) or found[0] == pytest.approx(wanted[0], rel=1e-12), name
            assert "has no sequence" in nothing or "has no clip" in nothing
