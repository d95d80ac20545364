"""Two gloo processes get the digits of one, also when one of them has no sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from facediff.metrics import RealTimeFactor, Region, ShannonIndex, StyleRetrievalAccuracy, protocol
from tests.fakes.processes import Forked, program
from tests.metrics.further_cases import CASES, pair_batch

Corpus = Any  # the class of that name in conftest.py, which test files cannot import
WORKER = Path(__file__).with_name("distributed_worker.py")


CHOSEN = list({case.make().__class__: case for case in reversed(CASES)}.values())


def further_batches(corpus: Corpus) -> dict[str, list[dict[str, Any]]]:
    """What each further metric is fed for each of the five sequences."""
    found = {case.name: [case.arguments(corpus, [place], 0) for place in range(5)] for case in CHOSEN}
    embeddings = torch.randn(5, 3, 4, generator=torch.manual_seed(0))
    found["style"] = [{"embeddings": some, "labels": torch.tensor([0, 1, 2])} for some in embeddings]
    found["speed"] = [{"computing": float(place), "speech": 1.0 + place} for place in range(5)]
    found["shannon"] = [pair_batch(corpus, [place], 0) for place in range(5)]
    return found


def compare_further(written: dict[str, Any], batches: dict[str, list[dict[str, Any]]]) -> None:
    """Two processes against one, for every further metric, in each round of shares."""
    metrics: dict[str, Any] = {case.name: case.make() for case in CHOSEN}
    metrics |= {
        "style": StyleRetrievalAccuracy(),
        "speed": RealTimeFactor("this machine"),
        "shannon": ShannonIndex([3, 4], clusters=5),
    }
    assert written.keys() == metrics.keys()
    for name, metric in metrics.items():
        for batch in batches[name]:
            metric.update(**batch)
        counted = metric.coverage() if hasattr(metric, "coverage") else getattr(metric, "queries", int)()
        *rounds, nothing = written[name]
        for value, covered in rounds:
            assert value == pytest.approx(metric.compute().item(), rel=1e-12), name
            assert covered == str(counted), name
        assert "has no sequence" in nothing or "has no clip" in nothing or "0 style embeddings" in nothing


def test_two_processes_equal_one(corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...], tmp_path: Path) -> None:
    clips = [
        {name: value[0] for name, value in corpus.batch([place]).items() if name != "lengths"} for place in range(5)
    ]
    further = further_batches(corpus)
    torch.save({"clips": clips, "further": further}, tmp_path / "corpus.pt")
    processes = [
        Forked(program(WORKER, rank, 2, tmp_path / "rendezvous", tmp_path / "corpus.pt", tmp_path / f"rank{rank}.pt"))
        for rank in range(2)
    ]
    try:
        codes = [process.wait(timeout=120) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert codes == [0, 0]

    def one_process(places: range) -> dict[str, Any]:
        metrics = protocol("facediffuser").build(Region("lips", lips), Region("upper", upper))
        for place in places:
            metrics.update(**clips[place])
        return {name: value.item() for name, value in metrics.compute().items()} | metrics.summary().as_dict()

    whole, two = one_process(range(5)), one_process(range(2))
    for rank in range(2):
        written = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        split, lopsided, nothing, afterwards = written["protocol"]
        for found in (split, lopsided):
            for name in ("protocol", "regions"):
                assert found.pop(name) == whole[name]
            assert found == pytest.approx({name: whole[name] for name in found}, rel=1e-14)
            assert len(found) == 8
        assert "has no sequence to score" in nothing
        assert afterwards == pytest.approx({name: two[name] for name in afterwards}, rel=1e-14)
        compare_further(written["further"], further)
