"""One of the processes of test_metric_processes.py: scores its share and writes what it got.

Usage: distributed_worker.py RANK WORLD RENDEZVOUS CORPUS OUTPUT
"""

from __future__ import annotations

import sys
from typing import Any

import torch
import torch.distributed as dist

from facediff.metrics import RealTimeFactor, Region, ShannonIndex, StyleRetrievalAccuracy, protocol
from tests.metrics.further_cases import CASES

# Rounds of sequences by rank: unequal shares, all on rank 0, none at all.
ROUNDS: list[list[list[int]]] = [[[0, 1, 2], [3, 4]], [[0, 1, 2, 3, 4], []], [[], []]]


def score(metric: Any, batches: list[dict[str, Any]]) -> Any:  # noqa: ANN401
    """What a metric gives for the batches of this process and those of the others, or its complaint."""
    metric.reset()
    for batch in batches:
        metric.update(**batch)
    try:
        value = metric.compute().item()
    except ValueError as error:
        return str(error)
    counted = metric.coverage() if hasattr(metric, "coverage") else getattr(metric, "queries", int)()
    return [value, str(counted)]


def main(rank: int, world: int, rendezvous: str, corpus: str, output: str) -> None:
    """Score every round of shares and save the results."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=world)
    given: dict[str, Any] = torch.load(corpus, weights_only=True)
    clips: list[dict[str, Any]] = given["clips"]
    lips, upper = Region("lips", (3, 4, 9, 31)), Region("upper", (0, 1, 20, 25, 39))
    metrics = protocol("facediffuser").build(lips, upper)
    results: list[Any] = []
    for shares in ROUNDS:
        metrics.reset()
        for place in shares[rank]:
            metrics.update(**clips[place])
        local = sum(len(clips[place]["truth"]) for place in shares[rank])
        try:
            scores = {name: value.item() for name, value in metrics.compute().items()}
        except ValueError as error:
            results.append(str(error))
            continue
        states = metrics["lve"].metric_state["counts"]
        assert states[0] == local, "the local states come back after compute"  # noqa: S101
        results.append(scores | metrics.summary().as_dict())
    metrics.update(**clips[rank])  # after the error above every metric still works
    results.append({name: value.item() for name, value in metrics.compute().items()})
    others = {case.name: case.make() for case in CASES if case.name in given["further"]}
    others |= {
        "style": StyleRetrievalAccuracy(),
        "speed": RealTimeFactor("this machine"),
        "shannon": ShannonIndex([3, 4], clusters=5),
    }
    further = {
        name: [score(metric, [given["further"][name][place] for place in shares[rank]]) for shares in ROUNDS]
        for name, metric in others.items()
    }
    torch.save({"protocol": results, "further": further}, output)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:6])
