"""Does a model generate? How lively motion is, whether samples scatter as much as they err, and a proper score of both.

A model that predicts the mean of all that speech leaves open scores well in every distance from the truth, and moves
the upper face hardly at all. These metrics see that. Metrics of
calibration compare several samples of each sequence with the one recorded truth.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from itertools import combinations
from typing import ClassVar, Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    Clip,
    Pooling,
    SequenceOptions,
    SumsMetric,
    check_option,
    functional,
)
from facediff.metrics.one_pass import ErrorOf, one_pass
from facediff.metrics.regions import RegionLike
from facediff.metrics.samples import OfSamples
from facediff.registry import metric


class RatioMetric(SumsMetric):
    """Base of metrics that divide one sum over all sequences by another; a subclass defines :meth:`clip_parts`.

    The mean of each sequence's own ratio would be ruled by the sequences in which hardly anything happens.
    """

    unit: ClassVar[str] = "1"
    shape: ClassVar[tuple[int, ...]] = (2,)

    def __init__(
        self, region: RegionLike | None = None, *, definition: str | None = None, **options: Unpack[SequenceOptions]
    ) -> None:
        definition = f"{definition or self.words}; ratio of sums over all sequences [{self.unit}]"
        super().__init__(shape=self.shape, definition=definition, region=region, **options)

    @abstractmethod
    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Numerator and denominator of one sequence, float64 scalars, or of several ratios."""

    def clip_sums(self, clip: Clip) -> Tensor:
        """Numerator and denominator."""
        return torch.stack(self.clip_parts(clip))

    def score(self, sums: Tensor) -> Tensor:
        """The ratio."""
        self.check_denominator(sums[1])
        return sums[0] / sums[1]


class RootRatioMetric(RatioMetric):
    """Base of ratios of sums of squares, from which the score takes the root."""

    divides_by = "the truth does not move in any sequence"

    def score(self, sums: Tensor) -> Tensor:
        """The root of the ratio, or of the product of several."""
        return super().score(sums).prod().sqrt()


@metric.register("motion_liveliness")
class MotionLiveliness(RootRatioMetric):
    r"""Liveliness: how much a region moves over time, as a share of how much the truth's does.

    With the variance over the frames t of a sequence, σ²(x) = Σ_v ‖x_v[t] − mean_t x_v‖² averaged over t:
    √(Σ σ²(prediction) / Σ σ²(truth)), sums over sequences weighted by their frames. 1 is as lively as the truth, 0 a
    face that never moves. Unlike FDD it cannot be met by moving too much in one place and too little in another.

    >>> import torch
    >>> truth = torch.randn(9, 4, 3, generator=torch.Generator().manual_seed(0))
    >>> round(motion_liveliness(0.5 * truth, truth).item(), 6)
    0.5
    """

    words = "root of the prediction's variance over time, over that of the truth, over {region}"

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Summed squared distance of each side from its own mean over time."""
        regions = [_of(side, self.indices) for side in (clip.prediction, clip.truth)]
        above, below = (region.sub_(region.mean(0)).square_().sum() for region in regions)
        return above, below


motion_liveliness = functional(MotionLiveliness)


def _differences(motion: Tensor) -> Tensor:
    """Summed squares of the first and the second differences over time of one sequence, (2,)."""
    return torch.stack([torch.diff(motion, n, dim=0).square().sum() for n in (1, 2)])


@metric.register("frame_step")
class FrameStep(RootRatioMetric):
    r"""Frame step: how far a region moves from a frame to the next, as a share of how far the truth's does.

    √(Σ ‖x[t+1] − x[t]‖² / Σ ‖y[t+1] − y[t]‖²), over frames, vertices and sequences. 1 is as quick as the truth.

    >>> import torch
    >>> truth = torch.randn(9, 4, 3, generator=torch.Generator().manual_seed(0))
    >>> round(frame_step(0.5 * truth, truth).item(), 6)
    0.5
    """

    in_order = True
    words = "root mean square of the prediction's steps from frame to frame, over that of the truth, {region}"

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Summed squared steps of each side."""
        prediction, truth = (_differences(_of(side, self.indices))[0] for side in (clip.prediction, clip.truth))
        return prediction, truth


frame_step = functional(FrameStep)


@metric.register("difference_ratio")
class DifferenceRatio(RootRatioMetric):
    r"""Difference ratio: how much a region shivers, the size of its second differences in time over its first.

    √(Σ ‖x[t+1] − 2x[t] + x[t−1]‖² / Σ ‖x[t+1] − x[t]‖²), over frames, vertices and sequences: √3 for noise that is
    independent from frame to frame, near 0 for slow movement. 0.7 is usual for an upper face that blinks.

    Args:
        of: ``"share"``, the prediction's as a share of the truth's; or the ``"prediction"`` or ``"truth"`` alone.

    >>> import torch
    >>> noise = torch.randn(4000, 4, 3, generator=torch.Generator().manual_seed(0))
    >>> round(difference_ratio(noise, noise, of="prediction").item(), 2)
    1.73
    """

    divides_by = "the prediction or the truth does not move in any sequence"
    in_order = True
    shape = (2, 2)

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        of: Literal["share", "prediction", "truth"] = "share",
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("of", of, Literal["share", "prediction", "truth"])
        definition = f"size of second over first differences in time, {of}, over {{region}}"
        super().__init__(region, definition=definition, **options)
        self.of = of

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Numerators and denominators of the prediction's ratio, and of one over the truth's."""
        prediction, truth = (_differences(_of(side, self.indices)) for side in (clip.prediction, clip.truth))
        one = torch.ones_like(truth)
        first, second = one if self.of == "truth" else prediction
        true_first, true_second = truth if self.of != "prediction" else one
        if self.of == "truth":
            true_first, true_second = true_second, true_first
        return torch.stack([second, true_first]), torch.stack([first, true_second])


difference_ratio = functional(DifferenceRatio)


OCTAVES = 5
"""Of a spectrum distance."""


@metric.register("spectrum_distance")
class SpectrumDistance(SumsMetric):
    r"""Spectrum distance: by how many decibels the power of a region's motion is off, mean over octaves.

    Of every sequence, offsets are taken from their mean over time, multiplied by the window w[t] = sin(π(t + ½)/T) and
    transformed over time. Their power |X(f)|² / Σ_t w[t]², summed over coordinates, is added up over octaves below the
    Nyquist frequency (with 25 frames per second: 6.25–12.5 Hz, 3.1–6.25 Hz …; the last holds all that is slower) and
    over sequences. The score is the mean over octaves of |10 log₁₀(P(prediction) / P(truth))|, in dB: 0 for motion that
    is as quick and as slow as the truth, whenever it happens. Powers below a millionth of the truth's total count as
    that much, so that a still face has a finite score.

    >>> import torch
    >>> truth = torch.randn(50, 4, 3, generator=torch.Generator().manual_seed(0))
    >>> round(spectrum_distance(0.1 * truth, truth).item(), 6)
    20.0
    """

    divides_by = "the truth does not move in any sequence"
    in_order = True

    words = f"mean over {OCTAVES} octaves of the decibels by which the power over time is off, over {{region}} [dB]"

    def __init__(self, region: RegionLike | None = None, **options: Unpack[SequenceOptions]) -> None:
        super().__init__(shape=(2, OCTAVES), region=region, **options)

    def clip_sums(self, clip: Clip) -> Tensor:
        """Power of prediction and truth in each octave, the quickest first, of one sequence (2, octaves), float64."""
        powers = []
        for side in (clip.prediction, clip.truth):
            motion = _of(side, self.indices).flatten(1)
            frames = len(motion)
            time = torch.arange(frames, dtype=torch.float64, device=motion.device)
            window = torch.sin(torch.pi * (time + 0.5) / frames)
            transformed = torch.fft.fft((motion - motion.mean(0)) * window[:, None], dim=0)
            power = transformed.abs().square().sum(1) / window.square().sum()
            # Frequencies as shares of Nyquist's; the octave k holds those in (2^-(k+1), 2^-k].
            share = 2 * torch.fft.fftfreq(frames, dtype=torch.float64, device=motion.device).abs()
            octave = (-share.clamp_min(1e-9).log2()).floor().clamp_max(OCTAVES - 1).long()
            power[0] = 0.0  # what windowing leaves of the mean
            powers.append(power.new_zeros(OCTAVES).index_add(0, octave, power))
        return torch.stack(powers)

    def score(self, sums: Tensor) -> Tensor:
        """Mean over octaves of the distance in dB."""
        self.check_denominator(sums[1].sum())
        prediction, truth = sums.clamp_min(1e-6 * float(sums[1].sum()))
        return (10 * (prediction / truth).log10()).abs().mean()


spectrum_distance = functional(SpectrumDistance)


@metric.register("spread_error_ratio")
class SpreadErrorRatio(OfSamples, RatioMetric):
    """Spread over error: how far two samples are apart, as a share of how far a sample is from the truth.

    Σ mean_{i<j} d(x_i, x_j) / Σ mean_i d(x_i, y), with d(a, b) = Σ_t mean_v ‖a_v[t] − b_v[t]‖₂ and sums over sequences.
    If samples are drawn from the distribution that the truth was drawn from, the truth is one more sample, and the
    ratio is 1: the model is calibrated. 0 is a model without any choice, below 1 one that is too sure, above 1 one that
    scatters more than it knows. Frames in which little happens rule it, since there are many; with ``squared`` it is
    (1 + 1/N) Σ σ²(x) / Σ d²(mean x, y), the variance of N samples over the squared error of their mean, which is ruled
    by large movements such as blinks.

    Args:
        n_samples: how many samples there are of each sequence; other numbers are refused.
        squared: compare variances and not distances.

    >>> import torch
    >>> random = torch.Generator().manual_seed(0)
    >>> samples, truth = torch.randn(8, 50, 30, 3, generator=random), torch.randn(50, 30, 3, generator=random)
    >>> round(spread_error_ratio(samples, truth).item(), 1)
    1.0
    """

    needs: ClassVar[tuple[str, ...]] = ("samples",)
    divides_by = "every sample equals the truth"

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        n_samples: int = 4,
        squared: bool = False,
        **options: Unpack[SequenceOptions],
    ) -> None:
        compared = "mean distance between two of them, over that between one and the truth"
        if squared:
            compared = "their variance, over the squared error of their mean, times (1 + 1/n)"
        definition = f"of {n_samples} samples, {compared}, over {{region}}"
        super().__init__(n_samples=n_samples, region=region, definition=definition, **options)
        self.squared = squared

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Distances between samples, and between samples and truth, summed over frames."""
        samples, error = clip.prediction, ErrorOf(self.indices, "mean", squared=self.squared)

        def apart(first: Tensor, second: Tensor) -> Tensor:
            return one_pass(first, second, errors=[error])[0][0] * clip.frames

        between = [apart(samples[:, i], samples[:, j]) for i, j in combinations(range(samples.shape[1]), 2)]
        if self.squared:
            # Half of the mean squared distance of two samples is their variance, without bias.
            share = (1 + 1 / samples.shape[1]) / 2
            return share * torch.stack(between).mean(), apart(samples.double().mean(1), clip.truth)
        off = [apart(sample, clip.truth) for sample in samples.unbind(1)]
        return torch.stack(between).mean(), torch.stack(off).mean()


spread_error_ratio = functional(SpreadErrorRatio)


@metric.register("energy_score")
class EnergyScore(OfSamples):
    """Energy score: a proper score of samples against the truth; no collapsed or over-dispersed model can win it.

    ES = mean_i ‖x_i − y‖ − ½ mean_{i≠j} ‖x_i − x_j‖, the multivariate form of the continuous ranked probability score
    (Gneiting and Raftery 2007, eq. 22), unbiased in the number of samples. Vectors are all coordinates of a region in
    one frame, divided by the square root of the number of vertices so that regions compare. In the vertices' unit;
    lower is better. With a single sample of a deterministic model it is the distance itself.

    Args:
        n_samples: how many samples there are of each sequence; other numbers are refused.
        pooling: ``"frames"`` or ``"sequences"``.

    >>> import torch
    >>> samples = torch.stack([torch.ones(4, 1, 3), -torch.ones(4, 1, 3)])
    >>> round(energy_score(samples, torch.zeros(4, 1, 3)).item(), 6)  # √3 − ½ · 2√3
    0.0
    """

    higher_is_better = False
    needs: ClassVar[tuple[str, ...]] = ("samples",)

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        n_samples: int = 4,
        pooling: Pooling = "frames",
        **options: Unpack[SequenceOptions],
    ) -> None:
        definition = f"energy score of {n_samples} samples, vectors being frames of {{region}}; {{pooling}} [unit]"
        super().__init__(n_samples=n_samples, definition=definition, pooling=pooling, region=region, **options)

    def clip_value(self, clip: Clip) -> Tensor:
        """The score of one sequence, mean over its frames."""
        samples, truth = _of(clip.prediction, self.indices), _of(clip.truth, self.indices)
        count = samples.shape[1]

        def distance(first: Tensor, second: Tensor) -> Tensor:
            return ((first - second).square().sum((-2, -1)) / first.shape[-2]).sqrt().mean()

        off = torch.stack([distance(sample, truth) for sample in samples.unbind(1)]).mean()
        between = [distance(samples[:, i], samples[:, j]) for i, j in combinations(range(count), 2)]
        return off - 0.5 * torch.stack(between).mean()


energy_score = functional(EnergyScore)


def _of(motion: Tensor, indices: Tensor | None) -> Tensor:
    """A region of motion (frames, …, vertices, 3) in float64, in memory of its own."""
    return motion.to(torch.float64, copy=True) if indices is None else motion.index_select(-2, indices).double()


SMOOTHNESS: Mapping[str, tuple[Callable[[RegionLike], RatioMetric], str]] = {
    f"{name}_{region}": (implementation, region)
    for name, implementation in (("difference_ratio", DifferenceRatio), ("frame_step", FrameStep))
    for region in ("lips", "upper_face")
}
"""What every test scores besides its protocol: metric and region by the score's name, such as ``frame_step_lips``."""
