"""Figures of papers, shown next to ours where protocol and data agree; else the reason why not.

The figures are data of the package, ``published.yaml``, with their source. docs/which_lve.md says why two tables of the
field can seldom be compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from facediff.utils.yaml_files import load_yaml

FILE = Path(__file__).with_name("published.yaml")


@dataclass(frozen=True)
class Published:
    """A table of a paper."""

    name: str  # by which plans call it
    source: str  # paper and table
    corpus: str
    split: str
    protocol: str  # the named protocol that its figures follow
    rows: Mapping[str, Mapping[str, float]]  # scores by the paper's name of the method
    lips: int | None = None  # number of lip vertices; None if it is not said
    frames: int | None = None  # that were scored; None if the paper does not say
    sequences: int | None = None  # that were scored; None if the paper does not say
    doubt: str = ""  # why its figures cannot be compared with any others; empty if they can


@dataclass(frozen=True)
class PublishedScores:
    """Figures of papers next to a table of ours."""

    scores: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # the printed figures, by row and score
    sources: tuple[str, ...] = ()  # their papers and tables
    reasons: tuple[str, ...] = ()  # why tables that a plan names are not shown


@cache
def published() -> dict[str, Published]:
    """All tables of papers that are known, by name."""
    content: dict[str, dict[str, Any]] = load_yaml(FILE, "it is part of the package; install it again")
    return {name: Published(name, **table) for name, table in content.items()}


def shown_tables(
    names: Sequence[str],
    *,
    rows: Mapping[str, str],
    corpus: str,
    synthetic: bool,
    split: str,
    protocol: str,
    lips: Mapping[str, Any],
    frames: int,
    sequences: int,
) -> PublishedScores:
    """The figures of papers that are comparable with a table; ``rows`` has the papers' names of our rows."""

    def disagreement(table: Published) -> str:
        """Why a paper's figures cannot stand next to ours; empty if they can."""
        if table.corpus != corpus:
            origin = ", which a program made" if synthetic else ""
            return f"its corpus is {table.corpus}, and this is {corpus}{origin}"
        if table.split != split:
            return f"it scores {table.split}, and this is {split}"
        if table.doubt:
            return table.doubt
        for what, printed, value in (
            ("follows the protocol", table.protocol, protocol),
            ("has lip vertices", table.lips, lips.get("count")),
            ("scores sequences", table.sequences, sequences),
            ("scores frames", table.frames, frames),
        ):
            if printed is not None and printed != value:
                return f"it {what} {printed}, and this {value}"
        return ""

    scores: dict[str, dict[str, float]] = {}
    sources, reasons = [], []
    for table in (published()[name] for name in names if name in published()):
        if reason := disagreement(table):
            reasons.append(f"{table.source}: not shown, since {reason}")
            continue
        sources.append(table.source)
        for row, name in rows.items():
            if name in table.rows:
                scores.setdefault(row, {}).update(table.rows[name])
    return PublishedScores(scores, tuple(sources), tuple(reasons))
