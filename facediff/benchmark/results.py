"""The result of a cell: one JSON file of plain data, with protocol, regions, machine and training run."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

from facediff.benchmark.cells import Cell
from facediff.errors import FaceDiffError
from facediff.utils.checksums import hash_of
from facediff.utils.limits import check_format, quoted
from facediff.utils.plain_files import load_json, write_json
from facediff.utils.provenance import Provenance, provenance_of, read_provenance
from facediff.utils.ranges import Range
from facediff.utils.records import read_record
from facediff.version import __version__

CELLS = "cells"
FORMAT = 1
"""Goes up when a field changes its meaning; new fields do not count."""
REMEDY = "remove the file, and run the benchmark again"
COUNTS = Range(0, 1e12)
"""Frames, sequences, weights and seconds that a result can have."""


class Rows:
    """Rows of scores: all have a split, a method and a number of frames, and a clip if they are of a sentence."""

    def __init__(self, *keys: str) -> None:
        self.keys = keys

    def __contains__(self, rows: Sequence[Mapping[str, Any]]) -> bool:
        return all(
            isinstance(row.get("frames"), int)
            and all(row.get(name) in COUNTS for name in ("frames", "sequences") if name in row)
            and all(isinstance(row.get(key), str) for key in self.keys)
            for row in rows
        )

    def __str__(self) -> str:
        return f"rows with frames, {', '.join(self.keys)}"


@dataclass(frozen=True)
class Result:
    """The result of a cell."""

    row: str
    corpus: str  # the plan's name of the corpus
    seed: int | None
    kind: str  # ``fit``, ``checkpoint`` or ``predictions``
    key: str  # hash of the cell's recipe
    config: str = ""  # hash of the training without its seed
    problem: str = ""  # why the cell failed; empty if it did not
    code: Mapping[str, str] = field(default_factory=dict)  # version, and commit of a checkout
    source: str = ""  # the checkpoint or the folder that was scored
    # The training run, as plain data; empty where it is not known
    provenance: Mapping[str, Any] = field(default_factory=dict)
    synthetic: bool = False  # whether a program made the corpus
    protocol: str = ""  # of the scores
    definition: str = ""  # of each number, in words
    machine: Mapping[str, Any] = field(default_factory=dict)  # processor, GPU and versions
    # Seconds and bytes of memory of each step
    measured: Mapping[str, Mapping[str, Annotated[float, Range(0, 1e18)] | None]] = field(default_factory=dict)
    # How each score is pooled, and which way it is better
    columns: Mapping[str, Mapping[str, str | None]] = field(default_factory=dict)
    # A row for each split and method (``model``, ``still``, ``mean_face``, ``shuffled``), with regions, frames and
    # sequences
    scores: Annotated[Sequence[Mapping[str, Any]], Rows("split", "method")] = ()
    # A row for each split, method and clip
    sequences: Annotated[Sequence[Mapping[str, Any]], Rows("split", "method", "clip")] = ()
    name: str = ""

    @classmethod
    def failed(cls, cell: Cell, problem: str, machine: Mapping[str, Any]) -> Self:
        """The result of a cell that failed."""
        return cls(**_of(cell), problem=problem, machine=machine)

    @property
    def training_seconds(self) -> float | None:
        """Seconds of all trainings; None if nothing was trained."""
        steps = [step for name, step in self.measured.items() if not name.startswith(("test", "evaluate"))]
        measured = [step["seconds"] for step in steps if step.get("seconds") is not None]
        return sum(value for value in measured if value is not None) if measured else None

    @property
    def memory(self) -> float | None:
        """The most bytes that any step had in memory."""
        peaks = [value for step in self.measured.values() if (value := step.get("memory")) is not None]
        return max(peaks, default=None)

    @property
    def parameters(self) -> int | None:
        """Weights of the network."""
        value = self.provenance.get("parameters")
        return value if isinstance(value, int) else None

    def real_time_factor(self) -> float | None:
        """Seconds of computing for a second of speech, over all test splits."""
        pairs = [
            (row["real_time_factor"], row["frames"])
            for row in self.scores
            if row.get("method") == "model" and isinstance(row.get("real_time_factor"), int | float)
        ]
        frames = sum(count for _, count in pairs)
        return sum(value * count for value, count in pairs) / frames if frames else None

    def write(self, folder: Path) -> Path:
        """Write it into a benchmark's folder, whole or not at all; equal content gives equal bytes."""
        path = folder / CELLS / f"{self.name}.json"
        write_json(path, {"format": FORMAT, **asdict(self)})
        return path


def cell_file(folder: Path, cell: Cell) -> Path:
    """Where a cell's result is."""
    return folder / CELLS / f"{cell.file_name}.json"


def read_result(path: Path) -> Result | None:
    """A cell's result; None if there is none yet."""
    if not path.is_file():
        return None
    content = load_json(path, remedy=REMEDY)
    check_format(path, content.get("format") if isinstance(content, dict) else None, FORMAT)
    result = read_record(Result, content, path, remedy=REMEDY, strict=False)
    for row in (*result.scores, *result.sequences):
        for column in result.columns:
            if row.get(column) is not None and not isinstance(row[column], int | float):
                raise FaceDiffError(f"{path}: {column} is {quoted(row[column])}; {REMEDY}")
    if result.parameters is not None and result.parameters not in COUNTS:
        raise FaceDiffError(f"{path}: parameters is {quoted(result.parameters)}; {REMEDY}")
    if result.provenance:
        provenance_of(result.provenance, path)
    return result


def _of(cell: Cell) -> dict[str, Any]:
    trained = {key: value for key, value in cell.trained.items() if key != "seed"}
    facts = {"row": cell.row, "corpus": cell.corpus, "seed": cell.seed, "kind": cell.kind, "key": cell.key}
    return {**facts, "config": hash_of(trained), "name": cell.file_name}


def model_result(
    cell: Cell,
    report: Mapping[str, Any],
    *,
    machine: Mapping[str, Any],
    measured: Mapping[str, Mapping[str, float | None]],
    source: str,
) -> Result:
    """The result of a cell from the report of ``facediff test``."""
    return Result(
        **_of(cell),
        code=code_of(),
        source=source,
        provenance=report["provenance"],
        synthetic=bool(report["synthetic"]),
        protocol=str(report["scores"][0]["protocol"]),
        definition=str(report["definition"]),
        machine=machine,
        measured=measured,
        columns={name: facts for name, facts in report["columns"].items() if name != "real_time_factor"},
        scores=report["scores"],
        sequences=report["sequences"],
    )


def predictions_result(
    cell: Cell,
    report: Mapping[str, Any],
    splits: Mapping[str, str],
    *,
    machine: Mapping[str, Any],
    measured: Mapping[str, Mapping[str, float | None]],
    source: str,
) -> Result:
    """The result of a cell from the report of ``facediff evaluate``; clips outside the test splits do not count."""
    (method,) = report["methods"]
    facts = {score["metric"]: score for score in method["scores"]}
    columns = {name: {"pooling": score["pooling"], "better": score["better"]} for name, score in facts.items()}
    sequences = []
    for scored in method["sequences"]:
        split = splits.get(scored["clip"])
        if split is not None:
            values = {name.partition("/")[2]: value for name, value in scored["scores"].items()}
            who = {"split": split, "method": "model", "clip": scored["clip"], "identity": ""}
            sequences.append({**who, "frames": scored["frames"], **values})
    if not sequences:
        raise FaceDiffError(
            f"{cell.source}: holds no prediction of a test split's clips; expected such as {[*splits][:1]}"
        )
    scores = []
    for split in dict.fromkeys(splits.values()):
        rows = [row for row in sequences if row["split"] == split]
        if rows:
            pooled = {name: pool(rows, name, facts["pooling"]) for name, facts in columns.items()}
            counts = {"frames": sum(row["frames"] for row in rows), "sequences": len(rows)}
            regions = {"regions": report["regions"], "unseen_identity": report["identity"]}
            scores.append({"split": split, "method": "model", **pooled, **counts, **regions})
    provenance: Provenance | None = None if cell.source is None else read_provenance(cell.source)
    return Result(
        **_of(cell),
        code=code_of(),
        source=source,
        provenance={} if provenance is None else provenance.as_dict(),
        protocol=method["scores"][0]["protocol"],
        definition="\n".join(report["protocols"].values()),
        machine=machine,
        measured=measured,
        columns=columns,
        scores=scores,
        sequences=sequences,
    )


def code_of() -> dict[str, str]:
    """Version of the package, and the commit if it is run from a checkout."""
    folder = Path(__file__).parents[2]
    code = {"version": __version__}
    git = shutil.which("git")
    if git is not None and (folder / ".git").exists():
        with suppress(OSError, subprocess.SubprocessError):
            answer = subprocess.run(  # noqa: S603 - reads only
                [git, "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"],
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
            code["commit"] = answer.stdout.strip()
    return code


def pool(rows: Sequence[Mapping[str, Any]], column: str, pooling: str | None) -> float | None:
    """The pooled score of several sequences; None if it is no mean, or no sequence has a value."""
    valued = [(row[column], row["frames"] if pooling == "frames" else 1) for row in rows if row.get(column) is not None]
    total = sum(weight for _, weight in valued)
    return None if pooling is None or not total else sum(value * weight for value, weight in valued) / total
