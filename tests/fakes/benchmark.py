"""Results of a benchmark that never ran: made-up scores, with both sources of chance as large as asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from facediff.benchmark import ReportOutline, Result
from facediff.benchmark.outline import write_outline

COLUMNS: dict[str, dict[str, str | None]] = {
    "lve": {"pooling": "frames", "better": "lower"},
    "fdd": {"pooling": "sequences", "better": "lower"},
}
REGIONS = {"lips": {"name": "lips", "count": 12, "hash": "abcd", "duplicates": 0}}


def results(
    *,
    rows: int = 3,
    seeds: int = 3,
    clips: int = 24,
    effects: Sequence[float] = (),
    of_runs: float = 0.05,
    of_sentences: float = 0.2,
    seed: int = 0,
    corpus: str = "tiny",
    further: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> list[Result]:
    """A result for each method and seed: 1 + effect + chance of the run + difficulty + chance of the sentence.

    ``further`` are what ``test`` scores besides, by name: by how much it is off the method's own score, for each.
    """
    rng = np.random.default_rng(seed)
    difficulty = rng.normal(0, 0.3, clips)
    frames = rng.integers(20, 60, clips)
    found = []
    for place in range(rows):
        effect = effects[place] if place < len(effects) else 0.0
        for run in range(seeds):
            level = 1 + effect + rng.normal(0, of_runs)
            values = {name: level + difficulty + rng.normal(0, of_sentences, clips) for name in COLUMNS}
            sequences = [
                {"split": "test_a", "method": method, "clip": f"A_e{n:02d}", "identity": "", "frames": int(frames[n])}
                | {name: float(4 + difficulty[n] if method == "still" else values[name][n]) for name in COLUMNS}
                for method in ("model", "still")
                for n in range(clips)
            ]
            for method, offsets in further.items():
                off = offsets[place] + rng.normal(0, 0.05, clips)
                sequences += [
                    row | {"method": method} | {name: float(row[name]) + off[n] for name in COLUMNS}  # type: ignore[arg-type]
                    for n, row in enumerate(sequences[:clips])
                    if offsets[place] == offsets[place]
                ]
            found.append(_result(place, run, sequences, corpus))
    return found


def _result(place: int, run: int, sequences: list[dict[str, object]], corpus: str) -> Result:
    scores = []
    for method in dict.fromkeys(str(row["method"]) for row in sequences):
        own = [row for row in sequences if row["method"] == method]
        weights = {"lve": [row["frames"] for row in own], "fdd": [1.0] * len(own)}
        pooled = {name: float(np.average([row[name] for row in own], weights=weights[name])) for name in COLUMNS}
        counts = {"frames": sum(int(str(row["frames"])) for row in own), "sequences": len(own)}
        facts = {"split": "test_a", "method": method, "protocol": "paper", "real_time_factor": 0.1 * (place + 1)}
        scores.append({**facts, **pooled, **counts, "regions": REGIONS})
    return Result(
        row=f"method_{place}",
        corpus=corpus,
        seed=run,
        kind="fit",
        key=f"{place}-{run}",
        name=f"method_{place}-{corpus}-seed{run}",
        code={"version": "0"},
        provenance={"model": "Made", "corpus": corpus, "manifest": "none", "parameters": 1000 * (place + 1)},
        synthetic=True,
        protocol="paper",
        definition="protocol paper: made up",
        machine={"processor": "none", "gpu": None, "threads": 1},
        measured={"fit": {"seconds": 10.0, "memory": 1e9}, "test": {"seconds": 1.0, "memory": 5e8}},
        columns=COLUMNS,
        scores=scores,
        sequences=sequences,
    )


def outline(
    *,
    rows: int = 3,
    seeds: int = 3,
    corpus: str = "tiny",
    baseline: str = "method_0",
    references: tuple[str, ...] = ("still",),
) -> ReportOutline:
    """The outline that :func:`results` belong to."""
    return ReportOutline(
        name="made",
        title="Made-up methods",
        description="",
        protocol="paper",
        columns=(),
        baseline=baseline,
        references=references,
        rows={f"method_{place}": (f"Method {place}", "") for place in range(rows)},
        corpora={corpus: "Tiny"},
        published=(),
        cells=tuple(f"method_{place}-{corpus}-seed{run}" for place in range(rows) for run in range(seeds)),
    )


def write_benchmark(folder: Path) -> None:
    """Write ``plan.yaml``, which scores the predictions in ``ours`` on ``corpus``, and a finished ``benchmark/``."""
    (folder / "tiny.yaml").write_text("class_path: tests.fakes.tiny.Tiny\ninit_args: {}\n")
    (folder / "plan.yaml").write_text(
        "corpora: {tiny: {data: tiny.yaml, root: corpus}}\nmethods: {ours: {predictions: ours}}\n"
    )
    made = results(rows=2, seeds=2, clips=4)
    write_outline(folder / "benchmark", dataclasses.replace(outline(rows=2, seeds=2), name="benchmark"))
    for result in made:
        result.write(folder / "benchmark")
