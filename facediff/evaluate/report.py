"""What an evaluation found, as plain data."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from facediff.metrics import Region


@dataclass(frozen=True)
class Interval:
    """A bootstrap confidence interval over sequences.

    Attributes:
        low: its lower end.
        high: its upper end.
    """

    low: float
    high: float


@dataclass(frozen=True)
class Score:
    """One number of one method.

    Attributes:
        protocol: whose definition.
        metric: ``mve``, ``lve``, ``fdd``, ``fdd_absolute`` or ``fdd_signed``.
        value: the number, in the vertices' unit or that squared, as the definition says.
        interval: None with a single sequence or without resamples.
        frames: frames behind it.
        sequences: sequences behind it.
    """

    protocol: str
    metric: str
    value: float
    interval: Interval | None
    frames: int
    sequences: int


@dataclass(frozen=True)
class SequenceScores:
    """The numbers of one clip under one method.

    Attributes:
        method: the method.
        clip: ``<subject>_<sentence>``.
        subject: who speaks.
        sentence: what is said.
        conditions: identities that the predictions were given; empty where the names do not say.
        frames: frames scored, all conditions together.
        cut_prediction: frames cut from predictions.
        cut_truth: frames cut from the truth.
        scores: ``<protocol>/<metric>`` to value; the mean over conditions where there are several.
    """

    method: str
    clip: str
    subject: str
    sentence: str
    conditions: tuple[str, ...]
    frames: int
    cut_prediction: int
    cut_truth: int
    scores: dict[str, float]

    def row(self) -> dict[str, Any]:
        """The same in one flat row for a table."""
        found = asdict(self)
        scores = found.pop("scores")
        return {**found, "conditions": " ".join(self.conditions), **scores}


@dataclass(frozen=True)
class Missing:
    """What of one method was not scored.

    Attributes:
        without_truth: files of clips that have no truth.
        without_prediction: clips that have no prediction of the conditions asked for.
        unused: files under conditions that were not asked for.
        unnamed: files whose names no pattern fits.
        unusable: clip to reason: unreadable files, other meshes, subjects without a template.
    """

    without_truth: list[str] = field(default_factory=list)
    without_prediction: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    unnamed: list[str] = field(default_factory=list)
    unusable: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class MethodResult:
    """Everything about one method.

    Attributes:
        name: what it is called.
        folder: where its files lie.
        scores: its numbers, protocol by protocol.
        sequences: the numbers of each clip, sorted by clip.
        missing: what was not scored.
    """

    name: str
    folder: str
    scores: list[Score]
    sequences: list[SequenceScores]
    missing: Missing


@dataclass(frozen=True)
class Comparison:
    """A method against the first, over the sequences that both have.

    Attributes:
        method: the method.
        baseline: the first.
        protocol: whose definition.
        metric: which number.
        difference: the method's score minus the baseline's.
        interval: of the difference, over the same resamples; None as in :class:`Score`.
        sequences: how many sequences both have.
    """

    method: str
    baseline: str
    protocol: str
    metric: str
    difference: float
    interval: Interval | None
    sequences: int


@dataclass(frozen=True)
class Report:
    """What an evaluation found.

    Attributes:
        truth: the folder of truths.
        lips: lip vertices.
        upper_face: upper-face vertices; None if no protocol uses them.
        n_vertices: vertices of the mesh.
        protocols: the definition of each protocol, by name.
        identity: which conditions were scored.
        truth_stride: 2 if every second frame of the truth was taken, and so on.
        resamples: bootstrap resamples; 0 for none.
        level: of the intervals, e.g. 0.95.
        seed: of the resamples.
        methods: the results, in the order asked for.
        comparisons: every further method against the first.
        unnamed_truths: files among the truths whose names do not fit the pattern.
        remarks: whether the regions are those in use on the topology, if one was named.
    """

    truth: str
    lips: Region
    upper_face: Region | None
    n_vertices: int
    protocols: dict[str, str]
    identity: str
    truth_stride: int
    resamples: int
    level: float
    seed: int
    methods: list[MethodResult]
    comparisons: list[Comparison]
    unnamed_truths: list[str]
    remarks: list[str]

    def regions(self) -> dict[str, dict[str, Any]]:
        """Name, vertex count, hash and repeated indices of each region."""
        parts = {"lips": self.lips, "upper_face": self.upper_face}
        return {
            part: {
                "name": region.name,
                "count": region.count,
                "hash": region.hash,
                "duplicates": region.duplicates,
            }
            for part, region in parts.items()
            if region is not None
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; every score carries its protocol, regions, frames and sequences."""
        regions = self.regions()
        return {
            "truth": self.truth,
            "n_vertices": self.n_vertices,
            "regions": regions,
            "remarks": self.remarks,
            "protocols": self.protocols,
            "identity": self.identity,
            "truth_stride": self.truth_stride,
            "bootstrap": {"resamples": self.resamples, "level": self.level, "seed": self.seed},
            "methods": [_method(method, regions) for method in self.methods],
            "comparisons": [asdict(comparison) for comparison in self.comparisons],
            "unnamed_truths": self.unnamed_truths,
        }

    def rows(self) -> list[dict[str, Any]]:
        """One flat row for each sequence and method."""
        return [sequence.row() for method in self.methods for sequence in method.sequences]


def _method(method: MethodResult, regions: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """A method as plain data, each score with the region that it was taken over."""
    found = asdict(method)
    for score in found["scores"]:
        part = {"lve": "lips", "mve": ""}.get(score["metric"], "upper_face")
        score["region"] = regions[part] if part else "all vertices"
    return found
