"""Several predictions of each sequence: error of their mean and of the best, and how much they differ.

Predictions are the samples of a stochastic model, which differ by their noise, or predictions in the styles of several
identities.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, ClassVar, Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    Clip,
    Clips,
    FiniteOptions,
    Inferred,
    LengthRule,
    Lengths,
    Pooling,
    SequenceMetric,
    SequenceOptions,
    UpdateOptions,
    align,
    check_option,
    check_range,
    functional,
)
from facediff.metrics.one_pass import ErrorOf, one_pass
from facediff.metrics.regions import RegionLike, as_region
from facediff.registry import metric


def align_samples(
    samples: Tensor,
    truth: Tensor | None,
    *,
    n_samples: int | None,
    rule: LengthRule = "min",
    **batch: Unpack[UpdateOptions],
) -> Clips:
    """As :func:`align`, for equally long predictions of each sequence, which become (frames, samples, vertices, 3).

    ``samples`` are (batch, samples, frames, vertices, 3), or of one sequence (samples, frames, vertices, 3); without
    ``truth`` only their number of frames counts, and ``n_samples`` is None where there may be any number.
    """
    if samples.ndim not in (4, 5) or samples.shape[-4] != (n_samples or samples.shape[-4] or 1):
        raise ValueError(
            f"samples have shape {tuple(samples.shape)}; expected (batch, samples, frames, vertices, 3) or (samples, "
            f"frames, vertices, 3) with {n_samples or 'some'} samples: over another number it is another metric, set "
            f"n_samples"
        )
    first = samples.select(-4, 0)
    clips = align(first, first if truth is None else truth, rule=rule, **batch)
    by_clip = [samples] if samples.ndim == 4 else list(samples)
    predictions = [
        clip_samples.detach()[:, : clip.frames].transpose(0, 1)
        for clip, clip_samples in zip(clips.clips, by_clip, strict=True)
    ]
    clips = clips.attach("prediction", predictions)
    return clips if truth is not None else clips.attach("truth", predictions)


SAMPLES_GIVEN: Inferred = {
    "n_samples": lambda arguments: arguments["samples"].shape[-4] if arguments["samples"].ndim > 3 else 2
}
"""How a function reads the number of samples from its input."""


class OfSamples(SequenceMetric):
    """Base of metrics that compare several samples of each sequence with its truth.

    Args:
        n_samples: how many samples there are of each sequence; other numbers are refused.
        **options: of the next base class.
    """

    fewest: ClassVar[int] = 2
    """The smallest number of samples that have a value."""

    inferred: ClassVar[Inferred] = SAMPLES_GIVEN

    def __init__(self, *, n_samples: int, **options: Any) -> None:  # noqa: ANN401 - whatever that takes
        check_range("n_samples", n_samples, self.fewest)
        super().__init__(**options)
        self.n_samples = n_samples

    def update(self, samples: Tensor, truth: Tensor, **batch: Unpack[UpdateOptions]) -> None:
        """Add a batch of sequences; ``prediction_lengths`` is the same for all samples of a sequence.

        ``samples`` are (batch, samples, frames, vertices, 3), or of one sequence (samples, frames, vertices, 3).
        """
        self.add(align_samples(samples, truth, n_samples=self.n_samples, rule=self.length_rule, **batch))


class SamplesMetric(OfSamples):
    """Base of lip errors over several samples of each sequence.

    Args:
        lips: lip vertices, a :class:`Region` or indices.
        n_samples: N, how many samples there are of each sequence; other numbers are refused.
        squared: whether distances are squared; the score is then in the vertices' unit squared.
    """

    higher_is_better = False
    needs = ("lips", "samples")
    fewest = 1
    indices: Tensor

    def __init__(
        self,
        lips: RegionLike,
        *,
        n_samples: int = 10,
        squared: bool = True,
        pooling: Pooling = "frames",
        **options: Unpack[SequenceOptions],
    ) -> None:
        distance, unit = ("squared distance", "unit²") if squared else ("distance", "unit")
        definition = f"{self.words}, in each frame the largest {distance} over {{region}}; {{pooling}} [{unit}]"
        definition = definition.replace("{samples}", f"{n_samples} samples")
        lip_region = as_region(lips, "lips")
        super().__init__(n_samples=n_samples, definition=definition, pooling=pooling, region=lip_region, **options)
        self.squared = squared


@metric.register("mean_estimate_error")
class MeanEstimateError(SamplesMetric):
    """Mean estimate error (MEE): the lip vertex error of the mean of several samples.

    The vertex-wise mean of the N samples is scored as one prediction: in each frame the largest (squared)
    distance over the lip vertices, pooled over frames. Source: ProbTalk3D's script (N = 10, squared, pooled by
    frames). The number depends on N. In the vertices' unit squared, or in the unit if not ``squared``.

    >>> import torch
    >>> samples = torch.stack([torch.ones(4, 2, 3), -torch.ones(4, 2, 3)])
    >>> mean_estimate_error(samples, torch.zeros(4, 2, 3), [0]).item()
    0.0
    """

    words = "of the mean of {samples}"

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of the mean of one sequence's samples."""
        truth = clip.truth.index_select(1, self.indices)
        lips = torch.zeros_like(truth, dtype=torch.float64)
        for sample in clip.prediction.unbind(1):
            lips += sample.index_select(1, self.indices)
        return one_pass(lips / self.n_samples, truth, errors=[ErrorOf(None, "max", self.squared)])[0][0]


mean_estimate_error = functional(MeanEstimateError)


@metric.register("coverage_error")
class CoverageError(SamplesMetric):
    """Coverage error (CE): the lip vertex error of the best of several samples of each sequence.

    Of the N samples of a sequence the one with the smallest sum over frames of the largest (squared) distance
    over the lip vertices is taken, and its frames are pooled. Source: ProbTalk3D's script (N = 10, squared,
    pooled by frames). The number falls with N, so errors over different N cannot be compared. In the vertices' unit
    squared, or in the unit if not ``squared``.

    >>> import torch
    >>> samples = torch.stack([torch.ones(4, 2, 3), 2 * torch.ones(4, 2, 3)])
    >>> coverage_error(samples, torch.zeros(4, 2, 3), [0]).item()
    3.0
    """

    words = "of the best of {samples} of each sequence"

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of the best of one sequence's samples."""
        lips = ErrorOf(self.indices, "max", self.squared)
        errors = [one_pass(sample, clip.truth, errors=[lips])[0][0] for sample in clip.prediction.unbind(1)]
        return torch.stack(errors).amin()


coverage_error = functional(CoverageError)


# How much predictions of one sequence differ.

Pairing = Literal["shuffled", "all"]
"""Which samples are compared: a random half with the other half, or each with each."""


class Diversity(SequenceMetric):
    """Base of diversities: mean over pairs of predictions of one sequence of mean_t mean_v ‖a − b‖₂ (not squared).

    In the vertices' unit; a template cancels. There is no best value: noise is diverse too.

    Args:
        region: vertices to look at, a :class:`Region` or indices; None for all.
        definition: which predictions are compared, in words.
    """

    def __init__(
        self,
        region: RegionLike | None,
        *,
        definition: str,
        pooling: Pooling,
        **options: Unpack[FiniteOptions],
    ) -> None:
        definition = f"{definition}, the mean distance over {{region}}; {{pooling}} [unit]"
        super().__init__(definition=definition, pooling=pooling, region=region, **options)

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Which of ``count`` predictions are compared."""
        return list(combinations(range(count), 2))

    def clip_value(self, clip: Clip) -> Tensor:
        """The diversity of one sequence's predictions."""
        samples, error = clip.prediction, ErrorOf(self.indices, "mean", squared=False)
        distances = [
            one_pass(samples[:, first], samples[:, second], errors=[error])[0][0]
            for first, second in self.pairs(samples.shape[1])
        ]
        if not distances:
            return torch.full((), torch.nan, dtype=torch.float64, device=samples.device)
        return torch.stack(distances).mean()


@metric.register("sample_diversity")
class SampleDiversity(Diversity):
    """Diversity over samples: how much the predictions of one sequence differ from one noise to another.

    ``pairing="shuffled"`` is ProbTalk3D's: the N samples are put in random order and the first half is compared
    with the second, N / 2 pairs. Here the order is drawn from ``seed`` alone and is the same for every
    sequence, so that the score does not depend on the order of sequences, batches or processes; the script
    goes on drawing from one sequence to the next. ``pairing="all"`` compares all N (N − 1) / 2 pairs and
    has the same expectation with less chance in it.

    The score is the mean over pairs of mean_t mean_v ‖a − b‖₂ (not squared), mean over sequences, in the
    vertices' unit. A template cancels. The pairs' expectation does not depend on N.

    Args:
        pairing: ``"shuffled"`` as in ProbTalk3D's script, or ``"all"``.
        n_samples: N; other numbers of samples are refused. Even for ``"shuffled"``.
        seed: of the order; not used with ``"all"``.
        pooling: ``"sequences"`` as in the script, or ``"frames"``.

    >>> samples = torch.stack([torch.zeros(4, 2, 3), torch.ones(4, 2, 3)])
    >>> round(sample_diversity(samples).item(), 4)
    1.7321
    """

    needs = ("samples",)
    inferred: ClassVar[Inferred] = SAMPLES_GIVEN

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        pairing: Pairing = "shuffled",
        n_samples: int = 10,
        seed: int = 1234,
        pooling: Pooling = "sequences",
        **options: Unpack[FiniteOptions],
    ) -> None:
        check_option("pairing", pairing, Pairing)
        check_range("n_samples", n_samples, 2)
        if pairing == "shuffled" and n_samples % 2:
            raise ValueError(f"n_samples is {n_samples}; expected an even number, to compare halves")
        how = f"a random half with the other (seed {seed})" if pairing == "shuffled" else "all pairs"
        definition = f"of {n_samples} samples, {how}"
        super().__init__(region, definition=definition, pooling=pooling, **options)
        self.pairing: Pairing = pairing
        self.n_samples = n_samples
        self.seed = seed

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Which of ``count`` samples are compared."""
        if self.pairing == "all":
            return super().pairs(count)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(self.seed)).tolist()
        return list(zip(order[: count // 2], order[count // 2 :], strict=True))

    def update(  # type: ignore[override]  # there is no truth
        self, samples: Tensor, *, lengths: Lengths | None = None, clip_names: Sequence[str] | None = None
    ) -> None:
        """Add samples (batch, samples, frames, vertices, 3), or of one sequence (samples, frames, vertices, 3)."""
        self.add(align_samples(samples, None, n_samples=self.n_samples, lengths=lengths, clip_names=clip_names))


sample_diversity = functional(SampleDiversity)


@metric.register("identity_diversity")
class IdentityDiversity(Diversity):
    """Diversity over identities: how much the predictions of one sequence differ from one style to another.

    The same speech is predicted in the style of several identities; the score is the mean over all unordered
    pairs of identities of mean_t mean_v ‖a − b‖₂ (not squared), mean over sequences, in the vertices' unit.
    Source: FaceDiffuser's script. All predictions must be on the same template, or be offsets from their
    own. A sequence with a single identity is left out, as there; the number of identities may differ between
    sequences.

    Args:
        pooling: ``"sequences"`` as in the script, or ``"frames"``.
    """

    leaves_out = "each was predicted for one identity only"
    needs = ("conditions",)

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        pooling: Pooling = "sequences",
        **options: Unpack[FiniteOptions],
    ) -> None:
        definition = "of predictions for several identities, all pairs"
        super().__init__(region, definition=definition, pooling=pooling, **options)

    def update(  # type: ignore[override]  # there is no truth
        self, predictions: Tensor, *, lengths: Lengths | None = None, clip_names: Sequence[str] | None = None
    ) -> None:
        """Add predictions (batch, identities, frames, vertices, 3), or of one sequence without the batch axis."""
        self.add(align_samples(predictions, None, n_samples=None, lengths=lengths, clip_names=clip_names))


identity_diversity = functional(IdentityDiversity)
