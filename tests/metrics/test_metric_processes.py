"""Two gloo processes get the digits of one, also when one of them has no sequence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import facediff
from facediff.metrics import Region, protocol

Corpus = Any  # the class of that name in conftest.py, which test files cannot import
WORKER = Path(__file__).with_name("distributed_worker.py")


def test_two_processes_equal_one(corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...], tmp_path: Path) -> None:
    clips = [
        {name: value[0] for name, value in corpus.batch([place]).items() if name != "lengths"} for place in range(5)
    ]
    torch.save(clips, tmp_path / "corpus.pt")
    processes = [
        subprocess.Popen(  # noqa: S603
            [
                sys.executable,
                str(WORKER),
                str(rank),
                "2",
                str(tmp_path / "rendezvous"),
                str(tmp_path / "corpus.pt"),
                str(tmp_path / f"rank{rank}.pt"),
            ],
            env=os.environ | {"PYTHONPATH": str(Path(facediff.__file__).parents[1])},
        )
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
        split, lopsided, nothing, afterwards = torch.load(tmp_path / f"rank{rank}.pt", weights_only=True)
        for found in (split, lopsided):
            for name in ("protocol", "regions"):
                assert found.pop(name) == whole[name]
            assert found == pytest.approx({name: whole[name] for name in found}, rel=1e-14)
            assert len(found) == 8
        assert "has no sequence to score" in nothing
        assert afterwards == pytest.approx({name: two[name] for name in afterwards}, rel=1e-14)
