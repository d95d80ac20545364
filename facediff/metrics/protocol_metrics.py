"""All metrics of one protocol, updated together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, cast

from torch import Tensor
from torchmetrics import Metric, MetricCollection

from facediff.metrics.base import Coverage, SequenceMetric
from facediff.metrics.clips import Lengths, align
from facediff.metrics.face_dynamics import FaceDynamicsDeviation, split_template
from facediff.metrics.regions import Region
from facediff.metrics.topologies import find_topology
from facediff.metrics.vertex_errors import LipVertexError, MeanVertexError

if TYPE_CHECKING:
    from facediff.metrics.protocols import Protocol


@dataclass(frozen=True)
class Summary:
    """What to print beside the scores.

    Args:
        protocol: The protocol's name.
        lips: Lip region.
        upper: Upper-face region, None if the protocol does not use one.
        coverage: Frames and sequences scored, frames cut.
        topology: The mesh's name, if the protocol was given one.
    """

    protocol: str
    lips: Region
    upper: Region | None
    coverage: Coverage
    topology: str | None = None

    @property
    def remarks(self) -> list[str]:
        """Whether each region is one in use on the topology; empty where that is not known."""
        if self.topology is None:
            return []
        found = [find_topology(self.topology).remark("lips", self.lips)]
        return found if self.upper is None else [*found, find_topology(self.topology).remark("upper", self.upper)]

    def __str__(self) -> str:
        """One line for people."""
        regions = f"lips {self.lips}" + (f", upper {self.upper}" if self.upper else "")
        covered = self.coverage
        text = f"protocol {self.protocol}: {regions}; frames {covered.frames}, sequences {covered.sequences}"
        if covered.cut_prediction or covered.cut_truth:
            text += f"; frames cut: prediction {covered.cut_prediction}, truth {covered.cut_truth}"
        return "; ".join([text, *self.remarks])

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON: protocol, regions (name, count, hash, duplicates), coverage, topology."""
        found: dict[str, Any] = {"protocol": self.protocol, "regions": {}}
        for part, region in (("lips", self.lips), ("upper", self.upper)):
            if region is not None:
                found["regions"][part] = {
                    "name": region.name,
                    "count": region.count,
                    "hash": region.hash,
                    "duplicates": region.duplicates,
                }
        covered = asdict(self.coverage)
        del covered["left_out"]  # the metrics of protocols have a value on every sequence
        return found | covered | ({} if self.topology is None else {"topology": self.topology, "remarks": self.remarks})


class ProtocolMetrics(MetricCollection):
    """The metrics of one protocol as a `torchmetrics.MetricCollection`.

    `compute` gives a flat dictionary: ``mve``, ``lve``, ``fdd`` as far as the protocol has them; a second
    sign of FDD is called ``fdd_absolute`` or ``fdd_signed``. Under several processes `compute` and `summary`
    are collective: call them on every rank, also on one that had no sequence.

    Args:
        protocol: The setting; usually made by `Protocol.build`.
        lips: Lip vertices.
        upper: Upper-face vertices; may be None if the protocol has no FDD.

    Raises:
        ValueError: If the protocol needs an upper face and none is given.
    """

    def __init__(self, protocol: Protocol, lips: Region, upper: Region | None = None) -> None:
        if protocol.fdd and upper is None:
            raise ValueError(f"protocol {protocol.name!r} includes FDD; give the upper-face region")
        # Metrics with equal states must not be merged, and the inputs are checked here once for all of them.
        super().__init__({}, compute_groups=False)
        self.protocol = protocol
        self.lips = lips
        self.upper = upper if protocol.fdd else None
        rule = protocol.length_rule
        if protocol.mve is not None:
            mean_error = MeanVertexError(
                reduction=protocol.mve,
                squared=protocol.mve_squared,
                pooling=protocol.pooling,
                length_rule=rule,
                check_finite=False,
            )
            self.add_metrics({"mve": mean_error})
        lip_error = LipVertexError(
            lips, squared=protocol.lve_squared, pooling=protocol.pooling, length_rule=rule, check_finite=False
        )
        self.add_metrics({"lve": lip_error})
        for place, sign in enumerate(protocol.fdd):
            if upper is not None:
                deviation = FaceDynamicsDeviation(upper, sign=sign, length_rule=rule, check_finite=False)
                self.add_metrics({f"fdd_{sign}" if place else "fdd": deviation})

    def update(  # type: ignore[override]  # it is ModuleDict.update that torchmetrics has redefined
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        template: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences to every metric.

        Args:
            prediction: (batch, frames, vertices, 3) or (frames, vertices, 3), floating point.
            truth: Likewise.
            template: Neutral vertices (batch, vertices, 3) or (vertices, 3) if the motion is absolute; None
                if prediction and truth are offsets from the template already.
            lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
            prediction_lengths: Valid frames of the prediction.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As `ComparisonMetric.update`; no metric has changed then.
        """
        self._check(prediction, truth, template, lengths, prediction_lengths, clip_names)
        super().update(
            prediction,
            truth,
            template=template,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
        )

    def forward(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        template: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> dict[str, Tensor]:
        """Add a batch like `update` and return the scores of this batch alone."""
        self._check(prediction, truth, template, lengths, prediction_lengths, clip_names)
        batch_scores = super().forward(
            prediction,
            truth,
            template=template,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
        )
        return cast(dict[str, Tensor], batch_scores)

    def compute(self) -> dict[str, Tensor]:
        """The scores over all sequences so far, by name.

        Raises:
            ValueError: If no process had any sequence.
        """
        return cast(dict[str, Tensor], super().compute())

    def summary(self) -> Summary:
        """Regions, frames, sequences and cut frames behind the scores, over all processes."""
        topology = self.protocol.topology
        first: Metric = next(iter(self.values(copy_state=False)))
        return Summary(self.protocol.name, self.lips, self.upper, cast(SequenceMetric, first).coverage(), topology)

    def describe(self) -> str:
        """The definition of every number, with the regions."""
        scores = cast(Sequence[tuple[str, SequenceMetric]], self.items(copy_state=False))
        return "\n".join(f"{name}: {metric.describe()}" for name, metric in scores)

    def _check(
        self,
        prediction: Tensor,
        truth: Tensor,
        template: Tensor | None,
        lengths: Lengths | None,
        prediction_lengths: Lengths | None,
        clip_names: Sequence[str] | None,
    ) -> None:
        """Find every fault of a batch before the first metric has taken it."""
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.protocol.length_rule,
        )
        for region in (self.lips, self.upper):
            if region is not None:
                region.check(clips.n_vertices)
        if self.upper is not None:
            split_template(template, clips)
        clips.check_finite()
