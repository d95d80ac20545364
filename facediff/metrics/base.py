"""What metrics over sequences share: states, pooling, counts and exact reduction over processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.exact import ExactMetric
from facediff.metrics.options import LENGTH_RULES, POOLINGS, LengthRule, Pooling, check_option
from facediff.metrics.regions import Region


@dataclass(frozen=True)
class Coverage:
    """What a score was taken over, and what the length rule left out.

    Args:
        frames: Frames scored. A metric that looks at some frames only counts those, see there.
        sequences: Sequences scored.
        cut_prediction: Frames cut from predictions.
        cut_truth: Frames cut from truths.
        left_out: Sequences that have no value under the metric's definition and do not enter the score.
    """

    frames: int
    sequences: int
    cut_prediction: int
    cut_truth: int
    left_out: int = 0


class SequenceMetric(ExactMetric):
    """Base of metrics that give each sequence one number and pool these.

    The states are sums (float64) and counts (int64) of fixed size, so that memory does not grow and processes
    that saw different numbers of sequences, or none, reduce to what one process gets. They stay in these
    types when the module that holds the metric is converted to another precision.

    Under several processes `compute` and `coverage` are collective: call them on every rank, also on one that
    had no sequence (in Lightning from an ``on_…_epoch_end`` hook, not by logging from a step).

    Args:
        definition: The metric in plain words, with all its options.
        pooling: All frames alike, or the mean of sequence means.
        region: Vertices that are looked at, None for all; motion of another mesh is refused.
        length_rule: What to do where prediction and truth differ in length.
        check_finite: Whether `update` refuses NaN and infinity; off only where the caller has looked already.
        **kwargs: Passed on to `torchmetrics.Metric` (``process_group``, ``sync_on_compute`` …).
    """

    leaves_out = ""
    """Which sequences have no value, in words; empty if every sequence has one. `clip_value` gives NaN there."""

    latest: Tensor | None
    """What `clip_value` gave for each sequence of the last update, (batch,) float64; None before the first."""
    indices: Tensor | None
    total: Tensor
    counts: Tensor

    def __init__(
        self,
        *,
        definition: str,
        pooling: Pooling,
        region: Region | None = None,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("pooling", pooling, POOLINGS)
        check_option("length rule", length_rule, LENGTH_RULES)
        super().__init__(definition=definition, settings=length_rule, **kwargs)
        self.pooling: Pooling = pooling
        self.length_rule: LengthRule = length_rule
        self.check_finite = check_finite
        self.region = region
        self.latest: Tensor | None = None
        self.register_buffer("indices", None if region is None else region.tensor(), persistent=False)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(5, dtype=torch.int64), dist_reduce_fx="sum")

    def clip_value(self, clip: Clip) -> Tensor:
        """The metric of one sequence, a float64 scalar; NaN only if it `leaves_out` the sequence."""
        raise NotImplementedError

    def clip_weight(self, clip: Clip) -> int:
        """How many frames the value of a sequence is a mean over: its weight when pooling by frames."""
        return clip.frames

    def check_vertices(self, n_vertices: int) -> None:
        """Refuse motion of a mesh that the metric's region cannot belong to."""
        if self.region is not None:
            self.region.check(n_vertices)

    def _add(self, clips: Clips) -> None:
        self.check_vertices(clips.n_vertices)
        if self.check_finite:
            clips.check_finite()
        if not clips.clips:
            self.latest = self.total.new_empty(0)
            return
        values = torch.stack([self.clip_value(clip) for clip in clips.clips])
        self.latest = values
        weights = torch.tensor([self.clip_weight(clip) for clip in clips.clips], device=values.device)
        # A NaN that comes out of a metric that has a value everywhere must stay visible.
        scored = ~values.isnan() if self.leaves_out else torch.ones_like(weights, dtype=torch.bool)
        frames = torch.where(scored, weights, 0)
        values = torch.where(scored, values, 0) * (frames if self.pooling == "frames" else 1)
        cut = torch.tensor((clips.cut_prediction, clips.cut_truth), device=values.device)
        counts = torch.cat([torch.stack([frames.sum(), scored.sum()]), cut, (~scored).sum()[None]])
        # Not in place: a state made under inference_mode may not be changed in place outside of it.
        self.total = self.total + values.sum()
        self.counts = self.counts + counts.to(self.counts.device)

    def compute(self) -> Tensor:
        """The score over all sequences so far, a float64 scalar.

        Raises:
            ValueError: If no process had any sequence, or none that has a value.
        """
        frames, sequences = self.counts[0], self.counts[1]
        if int(sequences) == 0:
            self.refuse_to_compute(int(self.counts[4]))
        return self.total / (frames if self.pooling == "frames" else sequences)

    def refuse_to_compute(self, left_out: int) -> None:
        """Say that there is nothing to score.

        Raises:
            ValueError: Always; the message depends on whether sequences were left out.
        """
        self.leave_synchronised_state()
        name = type(self).__name__
        if left_out:
            raise ValueError(f"{name} has no value on any of its {left_out} sequences: {self.leaves_out}")
        raise ValueError(f"{name} has no sequence to score; call update before compute")

    def coverage(self) -> Coverage:
        """How much was scored, cut and left out, over all processes."""
        if self._is_synced:
            return self.covered()
        with self.sync_context(dist_sync_fn=self.dist_sync_fn, should_sync=self.sync_on_compute):
            return self.covered()

    def covered(self) -> Coverage:
        """What the states say was scored, cut and left out."""
        return Coverage(*self.counts.tolist())


class ComparisonMetric(SequenceMetric):
    """Base of metrics that compare a prediction with its truth and need nothing beside."""

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: Likewise.
            lengths: Valid frames (batch,) or a mask (batch, frames), of the truth and, unless
                ``prediction_lengths`` is given, of the prediction. Padding is never read.
            prediction_lengths: Valid frames of the prediction.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: If shapes or lengths do not fit or the length rule refuses them, or a valid frame
                holds NaN or infinity. Nothing is added then.
        """
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips)
