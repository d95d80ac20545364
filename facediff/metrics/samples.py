"""Metrics of a stochastic model that predicts several samples of each sequence, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from facediff.metrics.base import SequenceMetric
from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.formulas import vertex_error
from facediff.metrics.options import POOLING_WORDS, POOLINGS, LengthRule, Pooling, check_option
from facediff.metrics.regions import RegionLike, as_region


def align_samples(
    samples: Tensor,
    truth: Tensor | None,
    *,
    n_samples: int | None,
    lengths: Lengths | None,
    prediction_lengths: Lengths | None,
    clip_names: Sequence[str] | None,
    rule: LengthRule,
) -> Clips:
    """As `align`, for several predictions of each sequence.

    Args:
        samples: (batch, samples, frames, vertices, 3), or (samples, frames, vertices, 3) of one sequence.
        truth: (batch, frames, vertices, 3) or (frames, vertices, 3); None if there is none.
        n_samples: How many samples there must be; None for any number.
        lengths: As for `align`.
        prediction_lengths: As for `align`; the samples of a sequence are equally long.
        clip_names: One name a sequence, for messages.
        rule: What to do where the lengths differ.

    Returns:
        Sequences whose predictions are (frames, samples, vertices, 3).

    Raises:
        ValueError: As `align`, and if there is another number of samples.
    """
    if samples.ndim not in (4, 5) or samples.shape[-4] == 0:
        raise ValueError(
            f"samples have shape {tuple(samples.shape)}; expected (batch, samples, frames, vertices, 3) or "
            "(samples, frames, vertices, 3)"
        )
    if n_samples is not None and samples.shape[-4] != n_samples:
        raise ValueError(
            f"{samples.shape[-4]} samples of each sequence; this metric is over {n_samples}, and over another "
            "number it is another metric: set n_samples"
        )
    first = samples.select(-4, 0)
    clips = align(
        first,
        first if truth is None else truth,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
        rule=rule,
    )
    each = [samples] if samples.ndim == 4 else list(samples)
    found = []
    for clip, several in zip(clips.clips, each, strict=True):
        prediction = several.detach()[:, : clip.frames].transpose(0, 1)
        found.append(replace(clip, prediction=prediction, truth=prediction if truth is None else clip.truth))
    return replace(clips, clips=tuple(found))


class SamplesMetric(SequenceMetric):
    """Base of lip errors over several samples of each sequence.

    Args:
        lips: Lip vertices, a `Region` or indices.
        definition: The metric in words; ``{lips}`` and ``{samples}`` are filled in.
        n_samples: How many samples there are of each sequence.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    higher_is_better = False
    indices: Tensor

    def __init__(
        self,
        lips: RegionLike,
        *,
        definition: str,
        n_samples: int,
        squared: bool,
        pooling: Pooling,
        length_rule: LengthRule,
        check_finite: bool,
        **kwargs: object,
    ) -> None:
        check_option("pooling", pooling, POOLINGS)
        if n_samples < 1:
            raise ValueError(f"n_samples is {n_samples}; expected at least 1")
        region = as_region(lips, "lips")
        distance, unit = ("squared distance", "unit²") if squared else ("distance", "unit")
        told = definition.format(lips=region, samples=n_samples, distance=distance)
        super().__init__(
            definition=f"{told}; {POOLING_WORDS[pooling]} [{unit}]",
            pooling=pooling,
            region=region,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.n_samples = n_samples
        self.squared = squared

    def update(
        self,
        samples: Tensor,
        truth: Tensor,
        *,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            samples: Predictions (batch, samples, frames, vertices, 3), or of one sequence (samples, frames,
                vertices, 3), floating point.
            truth: (batch, frames, vertices, 3) or (frames, vertices, 3), floating point.
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: Valid frames of the predictions, the same for all samples of a sequence.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `ComparisonMetric.update`, and if there are not ``n_samples`` samples. Nothing
                is added then.
        """
        clips = align_samples(
            samples,
            truth,
            n_samples=self.n_samples,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips)


class MeanEstimateError(SamplesMetric):
    """Mean estimate error (MEE): the lip vertex error of the mean of several samples.

    The vertex-wise mean of the N samples is scored as one prediction: in each frame the largest (squared)
    distance over the lip vertices, pooled over frames. Source: ProbTalk3D's script (N = 10, squared, pooled by
    frames). The number depends on N.

    Args:
        lips: Lip vertices, a `Region` or indices.
        n_samples: N; other numbers of samples are refused.
        squared: Whether distances are squared; the score is then in the vertices' unit squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    def __init__(
        self,
        lips: RegionLike,
        *,
        n_samples: int = 10,
        squared: bool = True,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            lips,
            definition="of the mean of {samples} samples, in each frame the largest {distance} over {lips}",
            n_samples=n_samples,
            squared=squared,
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of the mean of one sequence's samples."""
        truth = clip.truth.index_select(1, self.indices)
        lips = torch.zeros_like(truth, dtype=torch.float64)
        for sample in clip.prediction.unbind(1):
            lips += sample.index_select(1, self.indices)
        return vertex_error(lips / self.n_samples, truth, None, reduction="max", squared=self.squared)


class CoverageError(SamplesMetric):
    """Coverage error (CE): the lip vertex error of the best of several samples of each sequence.

    Of the N samples of a sequence the one with the smallest sum over frames of the largest (squared) distance
    over the lip vertices is taken, and its frames are pooled. Source: ProbTalk3D's script (N = 10, squared,
    pooled by frames). The number falls with N, so errors over different N cannot be compared.

    Args:
        lips: Lip vertices, a `Region` or indices.
        n_samples: N; other numbers of samples are refused.
        squared: Whether distances are squared; the score is then in the vertices' unit squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    def __init__(
        self,
        lips: RegionLike,
        *,
        n_samples: int = 10,
        squared: bool = True,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            lips,
            definition="of the best of {samples} samples of each sequence, in each frame the largest {distance} over "
            "{lips}",
            n_samples=n_samples,
            squared=squared,
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of the best of one sequence's samples."""
        errors = [
            vertex_error(sample, clip.truth, self.indices, reduction="max", squared=self.squared)
            for sample in clip.prediction.unbind(1)
        ]
        return torch.stack(errors).amin()


def mean_estimate_error(
    samples: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    squared: bool = True,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Mean estimate error (MEE): lip vertex error of the mean of the samples, see `MeanEstimateError`.

    Args:
        samples: Predictions (batch, samples, frames, vertices, 3) or (samples, frames, vertices, 3).
        truth: (batch, frames, vertices, 3) or (frames, vertices, 3).
        lips: Lip vertices, a `Region` or indices.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the predictions.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit squared, or in the unit if not ``squared``.

    Raises:
        ValueError: As `SamplesMetric.update`.

    >>> import torch
    >>> samples = torch.stack([torch.ones(4, 2, 3), -torch.ones(4, 2, 3)])
    >>> mean_estimate_error(samples, torch.zeros(4, 2, 3), [0]).item()
    0.0
    """
    metric = MeanEstimateError(
        lips,
        n_samples=_count(samples),
        squared=squared,
        pooling=pooling,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(samples, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def coverage_error(
    samples: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    squared: bool = True,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Coverage error (CE): lip vertex error of the best sample of each sequence, see `CoverageError`.

    Args:
        samples: Predictions (batch, samples, frames, vertices, 3) or (samples, frames, vertices, 3).
        truth: (batch, frames, vertices, 3) or (frames, vertices, 3).
        lips: Lip vertices, a `Region` or indices.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the predictions.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit squared, or in the unit if not ``squared``.

    Raises:
        ValueError: As `SamplesMetric.update`.

    >>> import torch
    >>> samples = torch.stack([torch.ones(4, 2, 3), 2 * torch.ones(4, 2, 3)])
    >>> coverage_error(samples, torch.zeros(4, 2, 3), [0]).item()
    3.0
    """
    metric = CoverageError(
        lips,
        n_samples=_count(samples),
        squared=squared,
        pooling=pooling,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(samples, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def _count(samples: Tensor) -> int:
    return samples.shape[-4] if samples.ndim > 3 else 1
