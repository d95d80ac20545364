"""How much predictions of one sequence differ: over samples of a stochastic model, and over identities."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Literal, get_args

import torch
from torch import Tensor

from facediff.metrics.base import SequenceMetric
from facediff.metrics.clips import Clip, Lengths
from facediff.metrics.formulas import vertex_error
from facediff.metrics.options import POOLING_WORDS, POOLINGS, Pooling, check_option
from facediff.metrics.regions import RegionLike, as_region
from facediff.metrics.samples import align_samples

Pairing = Literal["shuffled", "all"]
"""Which samples are compared: a random half with the other half, or each with each."""

PAIRINGS: tuple[Pairing, ...] = get_args(Pairing)


class Diversity(SequenceMetric):
    """Base of diversities: mean over pairs of predictions of one sequence of mean_t mean_v ‖a − b‖₂.

    Args:
        region: Vertices to look at; None for all.
        definition: The metric in words; ``{where}`` is filled in.
        pooling: ``"frames"`` or ``"sequences"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    # No higher_is_better: noise is diverse too.

    def __init__(
        self,
        region: RegionLike | None,
        *,
        definition: str,
        pooling: Pooling,
        check_finite: bool,
        **kwargs: object,
    ) -> None:
        check_option("pooling", pooling, POOLINGS)
        named = None if region is None else as_region(region, "vertices")
        told = definition.format(where="all vertices" if named is None else str(named))
        super().__init__(
            definition=f"{told}; {POOLING_WORDS[pooling]} [unit]",
            pooling=pooling,
            region=named,
            length_rule="min",
            check_finite=check_finite,
            **kwargs,
        )

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Which of ``count`` predictions are compared."""
        return list(combinations(range(count), 2))

    def clip_value(self, clip: Clip) -> Tensor:
        """The diversity of one sequence's predictions."""
        several = clip.prediction
        distances = [
            vertex_error(several[:, one], several[:, other], self.indices, reduction="mean", squared=False)
            for one, other in self.pairs(several.shape[1])
        ]
        if not distances:
            return torch.full((), torch.nan, dtype=torch.float64, device=several.device)
        return torch.stack(distances).mean()


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
        region: Vertices to look at, a `Region` or indices; None for all.
        pairing: ``"shuffled"`` or ``"all"``.
        n_samples: N; other numbers of samples are refused. Even for ``"shuffled"``.
        seed: Of the order; not used with ``"all"``.
        pooling: ``"sequences"`` as in the script, or ``"frames"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: If an option is unknown, or ``n_samples`` cannot be paired.
    """

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        pairing: Pairing = "shuffled",
        n_samples: int = 10,
        seed: int = 1234,
        pooling: Pooling = "sequences",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("pairing", pairing, PAIRINGS)
        if n_samples < 2 or (pairing == "shuffled" and n_samples % 2):
            raise ValueError(
                f"n_samples is {n_samples}; expected at least 2, and an even number to compare halves of them"
            )
        how = f"a random half with the other (seed {seed})" if pairing == "shuffled" else "all pairs"
        super().__init__(
            region,
            definition=f"of {n_samples} samples, {how}, the mean distance over {{where}}",
            pooling=pooling,
            check_finite=check_finite,
            **kwargs,
        )
        self.pairing: Pairing = pairing
        self.n_samples = n_samples
        self.seed = seed

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Which of ``count`` samples are compared."""
        if self.pairing == "all":
            return super().pairs(count)
        order = torch.randperm(count, generator=torch.Generator().manual_seed(self.seed)).tolist()
        return list(zip(order[: count // 2], order[count // 2 :], strict=True))

    def update(
        self,
        samples: Tensor,
        *,
        lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            samples: (batch, samples, frames, vertices, 3), or of one sequence (samples, frames, vertices, 3),
                floating point.
            lengths: Valid frames of each sequence (batch,), or a mask (batch, frames).
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: If shapes or lengths do not fit, there are not ``n_samples`` samples, or a valid frame
                holds NaN or infinity. Nothing is added then.
        """
        clips = align_samples(
            samples,
            None,
            n_samples=self.n_samples,
            lengths=lengths,
            prediction_lengths=None,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips)


class IdentityDiversity(Diversity):
    """Diversity over identities: how much the predictions of one sequence differ from one style to another.

    The same speech is predicted in the style of several identities; the score is the mean over all unordered
    pairs of identities of mean_t mean_v ‖a − b‖₂ (not squared), mean over sequences, in the vertices' unit.
    Source: FaceDiffuser's script. All predictions must be on the same template, or be offsets from their
    own. A sequence with a single identity is left out, as there; the number of identities may differ between
    sequences.

    Args:
        region: Vertices to look at, a `Region` or indices; None for all.
        pooling: ``"sequences"`` as in the script, or ``"frames"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    leaves_out = "each was predicted for one identity only"

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        pooling: Pooling = "sequences",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            region,
            definition="of predictions for several identities, all pairs, the mean distance over {where}",
            pooling=pooling,
            check_finite=check_finite,
            **kwargs,
        )

    def update(
        self,
        predictions: Tensor,
        *,
        lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            predictions: (batch, identities, frames, vertices, 3), or of one sequence (identities, frames,
                vertices, 3), floating point.
            lengths: Valid frames of each sequence (batch,), or a mask (batch, frames).
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: If shapes or lengths do not fit, or a valid frame holds NaN or infinity. Nothing is
                added then.
        """
        clips = align_samples(
            predictions,
            None,
            n_samples=None,
            lengths=lengths,
            prediction_lengths=None,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips)


def sample_diversity(
    samples: Tensor,
    region: RegionLike | None = None,
    *,
    pairing: Pairing = "shuffled",
    seed: int = 1234,
    pooling: Pooling = "sequences",
    lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Diversity over samples: mean distance between samples of one sequence, see `SampleDiversity`.

    Args:
        samples: (batch, samples, frames, vertices, 3) or (samples, frames, vertices, 3).
        region: Vertices to look at, a `Region` or indices; None for all.
        pairing: ``"shuffled"`` as in ProbTalk3D's script, or ``"all"``.
        seed: Of the order, for ``"shuffled"``.
        pooling: ``"sequences"`` or ``"frames"``.
        lengths: Valid frames (batch,) or mask (batch, frames).
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit.

    Raises:
        ValueError: As `SampleDiversity` and its ``update``.

    >>> samples = torch.stack([torch.zeros(4, 2, 3), torch.ones(4, 2, 3)])
    >>> round(sample_diversity(samples).item(), 4)
    1.7321
    """
    count = samples.shape[-4] if samples.ndim > 3 else 2
    metric = SampleDiversity(
        region, pairing=pairing, n_samples=count, seed=seed, pooling=pooling, sync_on_compute=False
    ).to(samples.device)
    metric.update(samples, lengths=lengths, clip_names=clip_names)
    return metric.compute()


def identity_diversity(
    predictions: Tensor,
    region: RegionLike | None = None,
    *,
    pooling: Pooling = "sequences",
    lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Diversity over identities: mean distance between all pairs of identities, see `IdentityDiversity`.

    Args:
        predictions: (batch, identities, frames, vertices, 3) or (identities, frames, vertices, 3).
        region: Vertices to look at, a `Region` or indices; None for all.
        pooling: ``"sequences"`` or ``"frames"``.
        lengths: Valid frames (batch,) or mask (batch, frames).
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit.

    Raises:
        ValueError: As `IdentityDiversity.update`, and if no sequence has two identities.
    """
    metric = IdentityDiversity(region, pooling=pooling, sync_on_compute=False).to(predictions.device)
    metric.update(predictions, lengths=lengths, clip_names=clip_names)
    return metric.compute()
