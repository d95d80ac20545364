"""The result of an evaluation, as plain data and as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError, printable
from facediff.evaluation.file_pairs import Missing, Pair, errors_of
from facediff.evaluation.scoring import METRICS, ClipScores, Column
from facediff.metrics import Region
from facediff.reporting.scores import ScoreMatrix
from facediff.reporting.statistics import Bootstrap, Interval
from facediff.utils.paths import name_of_file
from facediff.utils.provenance import Provenance, read_provenance
from facediff.utils.text_tables import format_table


@dataclass(frozen=True)
class Score:
    """One number of one method."""

    protocol: str
    metric: str
    value: float  # the number, in the unit that the definition names
    # None with a single sequence, without resamples, or if the metric is no mean of sequences.
    interval: Interval | None
    frames: int
    sequences: int
    region: dict[str, Any] | str  # name, count and hash of the vertices that it was taken over, or "all vertices"
    pooling: str | None = None  # ``frames`` or ``sequences``; None if it is no mean of the scores of sequences
    better: str | None = None  # ``lower``, ``higher``, ``zero``, or None if no direction is the better one

    @property
    def name(self) -> str:
        """``<protocol>/<metric>``."""
        return f"{self.protocol}/{self.metric}"


@dataclass(frozen=True)
class SequenceScores:
    """The numbers of one clip under one method."""

    method: str
    clip: str
    subject: str
    sentence: str
    conditions: tuple[str, ...]  # identities that the predictions were given; empty where the names do not say
    frames: int  # frames scored, all conditions together
    cut_prediction: int  # frames cut from predictions
    cut_truth: int
    # ``<protocol>/<metric>`` to value; the mean over conditions where there are several; None where the metric has no
    # value on the clip.
    scores: dict[str, float | None]
    attributes: dict[str, str] = field(default_factory=dict)  # by which scores are grouped, such as the emotion

    def row(self) -> dict[str, Any]:
        """The same in one flat row for a table."""
        row = asdict(self) | {"conditions": " ".join(self.conditions)}
        scores, attributes = row.pop("scores"), row.pop("attributes")
        return attributes | row | scores


@dataclass(frozen=True)
class MethodResult:
    """Everything about one method."""

    name: str
    folder: str
    scores: list[Score]  # protocol by protocol
    sequences: list[SequenceScores]  # sorted by clip
    missing: Missing
    provenance: Provenance | None = None  # the training run that the files say they are of


@dataclass(frozen=True)
class Comparison:
    """A method against the first, over the sequences that both have.

    The interval shows the chance between sentences, not between training runs; where both are runs of one method, the
    difference is only the latter.
    """

    method: str
    baseline: str  # the first method
    protocol: str
    metric: str
    difference: float  # the method's score minus the baseline's
    interval: Interval | None  # of the difference, over the same resamples; None as in :class:`Score`
    sequences: int  # of which both have a value
    same_method: bool = False  # whether both are training runs of one method that differ in the seed alone

    @property
    def starred(self) -> bool:
        """Whether the interval does not contain 0, and the difference is one between methods."""
        return not self.same_method and self.interval is not None and (self.interval.low > 0 or self.interval.high < 0)


@dataclass(frozen=True)
class GroupScores:
    """The scores of one method over clips with equal attributes."""

    method: str
    attributes: dict[str, str]
    sequences: int
    scores: dict[str, float | None]  # ``<protocol>/<metric>`` to value; None where no clip of the group has one


@dataclass(frozen=True)
class EvaluationReport:
    """The result of an evaluation."""

    truth: str  # the folder of truths
    lips: Region
    upper_face: Region | None  # upper-face vertices; None if no protocol uses them
    n_vertices: int
    # The definition of each protocol, by name; under ``metrics`` of metrics chosen by name.
    protocols: dict[str, str]
    identity: str  # which conditions were scored
    truth_stride: int  # 2 if every second frame of the truth was taken, and so on
    resamples: int  # of the bootstrap; 0 for none
    level: float  # of the intervals, e.g. 0.95
    seed: int
    methods: list[MethodResult]  # the results, in the order asked for
    comparisons: list[Comparison]  # every further method against the first
    groups: list[GroupScores]  # scores by the attributes asked for, method by method
    unnamed_truths: list[str]  # files among the truths that do not fit the pattern
    remarks: list[str]  # whether the regions are those in use on the topology, if one was named
    points: str = "vertices"  # in regions: vertices, or channels where only these are scored

    def regions(self) -> dict[str, dict[str, Any]]:
        """Name, vertex count, hash and repeated indices of each region."""
        parts = {"lips": self.lips, "upper_face": self.upper_face}
        return {part: region.as_dict() for part, region in parts.items() if region is not None}

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; every score carries its protocol, regions, frames and sequences."""
        return {
            "truth": self.truth,
            "n_vertices": self.n_vertices,
            "regions": self.regions(),
            "remarks": self.remarks,
            "protocols": self.protocols,
            "identity": self.identity,
            "truth_stride": self.truth_stride,
            "bootstrap": {"resamples": self.resamples, "level": self.level, "seed": self.seed},
            "methods": [asdict(method) for method in self.methods],
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
            "groups": [asdict(group) for group in self.groups],
            "unnamed_truths": self.unnamed_truths,
        }

    def rows(self) -> list[dict[str, Any]]:
        """One flat row for each sequence and method."""
        return [sequence.row() for method in self.methods for sequence in method.sequences]


# The values of all clips of a method, pooled and compared.


class MethodTable:
    """One method's values: a row a clip, sorted by clip, so that no order of files or workers changes a digit.

    ``clip_scores`` has the scores by clip, or the reason why there are none; ``unscored`` follows from file names.
    """

    def __init__(
        self,
        name: str,
        folder: str,
        pairs: Sequence[Pair],
        unscored: Missing,
        clip_scores: Mapping[str, ClipScores | str],
        columns: Sequence[Column],
    ) -> None:
        self.name, self.folder, self.columns = name, folder, columns
        unusable = {clip: reason for clip, reason in sorted(clip_scores.items()) if isinstance(reason, str)}
        self.missing = replace(unscored, unusable=unusable)
        self.provenance = read_provenance(Path(folder))
        self.rows = [(pair, scores) for pair in pairs if isinstance(scores := clip_scores[pair.clip], ClipScores)]
        if not self.rows:
            raise FaceDiffError(f"{folder}: {_why_nothing(self.missing)}")
        by_frames = [column.pooling == "frames" for column in columns]
        weights = np.where(by_frames, np.array([scores.weights for _, scores in self.rows]), 1.0)
        values = np.array([scores.values for _, scores in self.rows])
        self.table = ScoreMatrix.of([pair.clip for pair, _ in self.rows], values, weights)

    def _pooled(self, column: Column) -> bool:
        """Whether a score is a mean of the clips'; others are made of the sums of all clips."""
        return column.source not in self.rows[0][1].states

    def _by_name(self, values: Iterable[float]) -> dict[str, float | None]:
        """Values of all columns by name, without those that single clips do not have."""
        pairs = zip(self.columns, values, strict=True)
        return {column.name: None if math.isnan(v) else v for column, v in pairs if self._pooled(column)}

    def groups(self, attributes: Mapping[str, dict[str, str]]) -> list[GroupScores]:
        """The scores of clips with equal attributes, by the name of the truth's file; pooled as over all clips."""
        clips: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for pair, _ in self.rows:
            if name_of_file(pair.truth.path) in attributes:
                clips.setdefault(tuple(attributes[name_of_file(pair.truth.path)].items()), []).append(pair.clip)
        return [
            GroupScores(self.name, dict(key), len(names), self._by_name(self.table.at(names).pool().tolist()))
            for key, names in sorted(clips.items())
        ]

    def result(self, bootstrap: Bootstrap, attributes: Mapping[str, dict[str, str]] | None = None) -> MethodResult:
        """The scores with their intervals, and the values of each clip."""
        frames = sum(scores.frames for _, scores in self.rows)
        counts = np.count_nonzero(self.table.weights, axis=0).tolist()
        scores = []
        for column, total, interval, count in zip(
            self.columns, self._totals(), self.table.intervals(bootstrap), counts, strict=True
        ):
            sequences, pooling = (count, column.pooling) if self._pooled(column) else (len(self.rows), None)
            facts = (frames, sequences, column.region, pooling, column.better)
            scores.append(Score(column.protocol, column.metric, total, interval, *facts))
        clips = [
            SequenceScores(
                self.name,
                pair.clip,
                pair.truth.name.subject,
                pair.truth.name.sentence,
                tuple(pair.predictions),
                scored.frames,
                scored.cut_prediction,
                scored.cut_truth,
                self._by_name(scored.values),
                (attributes or {}).get(name_of_file(pair.truth.path), {}),
            )
            for pair, scored in self.rows
        ]
        return MethodResult(self.name, self.folder, scores, clips, self.missing, self.provenance)

    def _totals(self) -> list[float]:
        """The score of each column over all clips."""
        totals: list[float] = self.table.pool().tolist()
        for index, column in enumerate(self.columns):
            if not self._pooled(column):
                metric = self.rows[0][1].states[column.source].clone()
                with errors_of(f"{self.folder}: metric {column.metric}"):
                    for _, scores in self.rows[1:]:
                        metric.merge_state(scores.states[column.source])
                    totals[index] = float(metric.compute())
            elif math.isnan(totals[index]):
                raise FaceDiffError(
                    f"{self.folder}: metric {column.metric} has no value on any of its {len(self.rows)} clips; omit it"
                )
        return totals

    def compare(self, baseline: MethodTable, bootstrap: Bootstrap) -> list[Comparison]:
        """This method's scores minus another's, over the clips with a value in both and over the same resamples.

        Empty if they share no clip.
        """
        table, reference = self.table.common(baseline.table)
        if not table.clips:
            return []
        one, two = table.resampled(bootstrap), reference.resampled(bootstrap)
        spread = None if one is None or two is None else one - two
        same = same_method(self.provenance, baseline.provenance)
        facts = zip(
            self.columns,
            (table.pool() - reference.pool()).tolist(),
            bootstrap.intervals(spread, len(self.columns)),
            np.count_nonzero(table.weights, axis=0).tolist(),
            strict=True,
        )
        return [
            Comparison(self.name, baseline.name, column.protocol, column.metric, difference, interval, count, same)
            for column, difference, interval, count in facts
            if not math.isnan(difference)
        ]


def same_method(one: Provenance | None, two: Provenance | None) -> bool:
    """Whether two folders are known to be of two training runs of one method."""
    return one is not None and two is not None and one.checkpoint != two.checkpoint and one.same_method(two)


def _why_nothing(unscored: Missing) -> str:
    """The first reason why no clip of a method can be scored."""
    if unscored.unusable:
        clip, reason = next(iter(unscored.unusable.items()))
        return f"no clip can be scored; {clip}: {reason}"
    if unscored.unused:
        return f"no prediction has this condition, but {unscored.unused[0]} is there; give --identity all or a name"
    if unscored.without_truth:
        return f"no prediction has a truth, such as {unscored.without_truth[0]}; check --truth-pattern and the folders"
    example = f", such as {unscored.unnamed[0]}" if unscored.unnamed else ""
    return f"no file's name fits the pattern{example}; give --pattern"


# An evaluation as text for people.

LISTED = 5  # Names that are listed before the rest is counted


def text(report: EvaluationReport) -> str:
    """Scores by protocol, comparisons, and cut, skipped and missing files."""
    mesh = "mesh of " if report.points == "vertices" else ""
    lines = [
        f"truth {report.truth}" + (f", every {report.truth_stride}. frame" if report.truth_stride > 1 else ""),
        f"{mesh}{report.n_vertices} {report.points}; conditions: {report.identity}",
    ]
    for part, region in report.regions().items():
        again = f", {region['duplicates']} repeated in the source" if region["duplicates"] else ""
        size = f"{region['count']} {report.points}, hash {region['hash']}{again}"
        lines.append(f"{part.replace('_', ' ')} {region['name']}: {size}")
    lines += report.remarks
    for name in report.protocols:
        title = "further metrics" if name == METRICS else f"protocol {name}"
        lines += ["", title, *_scores(report, name), *_comparisons(report, name), *_groups(report, name)]
    if any(score.interval for method in report.methods for score in method.scores):
        lines += [
            "",
            f"[…]: {report.level:.0%} intervals, {report.resamples} bootstrap resamples of the sequences, "
            f"seed {report.seed}",
            "they show the chance between sentences, not the chance between training runs",
        ]
    lines += ["", *(_left_out(report) or ["every clip was scored; no frame was cut"])]
    lines = [printable(line) for line in lines]
    for definition in report.protocols.values():
        lines += ["", definition]
    return "\n".join(lines)


MOST_COLUMNS = 5
"""Scores of a protocol that stand side by side."""


Rows = dict[str, dict[str, str]]
"""Cells by row and column."""


def _table(rows: Rows, counts: Sequence[str]) -> list[str]:
    """A table with counts in the last columns."""
    columns = dict.fromkeys(column for cells in rows.values() for column in cells if column not in counts)
    body = [[row, *(cells.get(column) for column in (*columns, *counts))] for row, cells in rows.items()]
    return format_table(["", *columns, *counts], body).splitlines()


def _scores(report: EvaluationReport, protocol: str) -> list[str]:
    rows: Rows = {}
    scored = [[score for score in method.scores if score.protocol == protocol] for method in report.methods]
    # Names of metrics with their options are long, and some protocols have many scores: one row for each.
    if protocol == METRICS or len(scored[0]) > MOST_COLUMNS:
        for same in zip(*scored, strict=True):
            cells = {
                method.name: _cell(score.value, score.interval)
                for method, score in zip(report.methods, same, strict=True)
            }
            counts = dict.fromkeys(str(score.sequences) for score in same)
            rows[same[0].metric] = cells | {"sequences": "/".join(counts)}
        return _table(rows, ["sequences"])
    for method, scores in zip(report.methods, scored, strict=True):
        totals = {"frames": str(scores[0].frames), "sequences": str(scores[0].sequences)}
        rows[method.name] = {score.metric: _cell(score.value, score.interval) for score in scores} | totals
    return _table(rows, ["frames", "sequences"])


def _groups(report: EvaluationReport, protocol: str) -> list[str]:
    """Scores by attributes of clips, group by group and method by method."""
    by = list(report.groups[0].attributes) if report.groups else []
    names = [name for name in (report.groups[0].scores if by else ()) if name.partition("/")[0] == protocol]
    if not names:
        return []
    rows = [
        [
            *(group.attributes[name] or "-" for name in by),
            group.method,
            *(None if group.scores[name] is None else f"{group.scores[name]:.4e}" for name in names),
            str(group.sequences),
        ]
        for group in sorted(report.groups, key=lambda group: tuple(group.attributes.values()))
    ]
    head = [*by, "", *(name.partition("/")[2] for name in names), "sequences"]
    return [f"by {', '.join(by)}", *format_table(head, rows, left=len(by) + 1).splitlines()]


def _comparisons(report: EvaluationReport, protocol: str) -> list[str]:
    """Differences from the first method; a star where the interval does not contain zero."""
    comparisons = [comparison for comparison in report.comparisons if comparison.protocol == protocol]
    if not comparisons:
        return []
    rows: Rows = {}
    for comparison in comparisons:
        row = f"{comparison.method} − {comparison.baseline}" + (f": {comparison.metric}" if protocol == METRICS else "")
        column = "difference" if protocol == METRICS else comparison.metric
        cell = _cell(comparison.difference, comparison.interval, "+") + ("*" if comparison.starred else "")
        rows.setdefault(row, {}).update({column: cell, "sequences": str(comparison.sequences)})
    head = "difference, over the sequences that both have (*: the interval over sentences does not contain 0)"
    same = dict.fromkeys(f"{one.method} and {one.baseline}" for one in comparisons if one.same_method)
    notes = [f"{pair} are training runs of one method: their difference is chance, and has no star" for pair in same]
    return [head, *_table(rows, ["sequences"]), *notes]


def _cell(value: float, interval: Interval | None, sign: str = "") -> str:
    return f"{value:{sign}.4e}" + (f" [{interval.low:{sign}.3e}, {interval.high:{sign}.3e}]" if interval else "")


def _left_out(report: EvaluationReport) -> list[str]:
    """Cut, skipped and missing files."""
    lines = []
    if report.unnamed_truths:
        lines.append(f"truths whose names do not fit: {_names(report.unnamed_truths)}")
    for method in report.methods:
        lines += [f"{method.name}: {line}" for line in _table_method(method)]
    if len({tuple(sequence.clip for sequence in method.sequences) for method in report.methods}) > 1:
        lines.append("the methods were not scored on the same sequences: compare the differences, not the scores")
    return lines


def _table_method(method: MethodResult) -> list[str]:
    unscored = method.missing
    cut = [
        f"{sequence.clip} (prediction {sequence.cut_prediction}, truth {sequence.cut_truth})"
        for sequence in method.sequences
        if sequence.cut_prediction or sequence.cut_truth
    ]
    names_of = {
        "frames cut": cut,
        "clips without a prediction": unscored.without_prediction,
        "predictions without a truth": unscored.without_truth,
        "predictions under other conditions": unscored.unused,
        "files whose names do not fit": unscored.unnamed,
    }
    lines = [f"{title}: {_names(names)}" for title, names in names_of.items() if names]
    unusable = [f"{clip} is left out: {reason}" for clip, reason in unscored.unusable.items()]
    more = [f"{len(unusable) - LISTED} more are left out (--json lists all)"] if len(unusable) > LISTED else []
    return lines + unusable[:LISTED] + more


def _names(names: Sequence[str]) -> str:
    """How many, and the first few."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f"{len(names)}: {', '.join(names[:LISTED])}{more}"
