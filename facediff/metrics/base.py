"""What every metric over sequences shares: states, pooling, counts and exact reduction over processes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.formulas import pool
from facediff.metrics.options import LENGTH_RULES, POOLINGS, LengthRule, Pooling, check_option


@dataclass(frozen=True)
class Coverage:
    """What a score was taken over, and what the length rule left out.

    Args:
        frames: Frames scored.
        sequences: Sequences scored.
        cut_prediction: Frames cut from predictions.
        cut_truth: Frames cut from truths.
    """

    frames: int
    sequences: int
    cut_prediction: int
    cut_truth: int


class SequenceMetric(Metric):
    """Base of metrics that give each sequence one number and pool these.

    The states are sums (float64) and counts (int64) of fixed size, so that memory does not grow and processes
    that saw different numbers of sequences, or none, reduce to what one process gets. They stay in these
    types when the module that holds the metric is converted to another precision.

    Under several processes `compute` and `coverage` are collective: call them on every rank, also on one that
    had no sequence (in Lightning from an ``on_…_epoch_end`` hook, not by logging from a step).

    Args:
        definition: The metric in plain words, with all its options.
        pooling: All frames alike, or the mean of sequence means.
        length_rule: What to do where prediction and truth differ in length.
        check_finite: Whether `update` refuses NaN and infinity; off only where the caller has looked already.
        **kwargs: Passed on to `torchmetrics.Metric` (``process_group``, ``sync_on_compute`` …).
    """

    full_state_update = False
    is_differentiable = False
    total: Tensor
    counts: Tensor

    def __init__(
        self,
        *,
        definition: str,
        pooling: Pooling,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(**kwargs)
        check_option("pooling", pooling, POOLINGS)
        check_option("length rule", length_rule, LENGTH_RULES)
        self.definition = definition
        self.pooling: Pooling = pooling
        self.length_rule: LengthRule = length_rule
        self.check_finite = check_finite
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(4, dtype=torch.int64), dist_reduce_fx="sum")
        # A MetricCollection merges metrics whose states have the same names and were nearly equal after the
        # first batch; a signed and an absolute deviation would be taken for one. A name of its own prevents
        # this.
        mark = hashlib.sha256(f"{definition}; {length_rule}".encode()).hexdigest()[:16]
        self.add_state(f"definition_{mark}", torch.zeros(1, dtype=torch.int64), dist_reduce_fx="sum")

    def describe(self) -> str:
        """The metric's definition in plain words."""
        return self.definition

    def clip_value(self, clip: Clip, template: Tensor | None) -> Tensor:
        """The metric of one sequence, a float64 scalar."""
        raise NotImplementedError

    def check_vertices(self, n_vertices: int) -> None:
        """Refuse motion of a mesh that the metric's region cannot belong to."""

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
        self._add(clips, [None] * len(clips.clips))

    def _add(self, clips: Clips, templates: Sequence[Tensor | None]) -> None:
        self.check_vertices(clips.n_vertices)
        if self.check_finite:
            clips.check_finite()
        if not clips.clips:
            return
        values = [self.clip_value(clip, still) for clip, still in zip(clips.clips, templates, strict=True)]
        # Not in place: a state made under inference_mode may not be changed in place outside of it.
        self.total = self.total + pool(values, clips, self.pooling)
        self.counts = self.counts + torch.tensor(clips.counts, device=self.counts.device)

    def compute(self) -> Tensor:
        """The score over all sequences so far, a float64 scalar.

        Raises:
            ValueError: If no process had any sequence.
        """
        frames, sequences = self.counts[0], self.counts[1]
        if int(sequences) == 0:
            if self._is_synced:
                self.unsync()  # torchmetrics would leave the metric in the synchronised state behind an error
            raise ValueError(f"{type(self).__name__} has no sequence to score; call update before compute")
        return self.total / (frames if self.pooling == "frames" else sequences)

    def coverage(self) -> Coverage:
        """How much was scored and cut, over all processes."""
        if self._is_synced:
            return Coverage(*self.counts.tolist())
        with self.sync_context(dist_sync_fn=self.dist_sync_fn, should_sync=self.sync_on_compute):
            return Coverage(*self.counts.tolist())

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> Self:
        """Follow moves to another device but keep float64: ``.to(torch.bfloat16)`` would ruin the sums."""

        def move_only(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return moved if moved.dtype == tensor.dtype else tensor.to(moved.device)

        super()._apply(move_only, exclude_state)
        return self
