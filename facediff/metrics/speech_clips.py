"""Do the lips move more in the clips that are spoken louder? The published speech–lip intensity correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from facediff.metrics.base import Coverage
from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.formulas import speed
from facediff.metrics.options import SUBJECT_WORDS, SUBJECTS, LengthRule, Subject, check_option
from facediff.metrics.regions import RegionLike, as_region
from facediff.metrics.speech import SpeechLipMetric

# Columns of the sums kept for each identity.
_CLIPS, _FRAMES, _SPEECH, _SPEECH_SQUARED = range(4)
_LIPS = {"prediction": (4, 5, 6), "truth": (7, 8, 9)}  # sum, sum of squares, sum of products with the speech


class ClipSpeechLipCorrelation(SpeechLipMetric):
    """Speech–lip intensity correlation coefficient (SLCC) over clips.

    Each clip gives one intensity of its speech, S = √(mean_t s[t]²), and one of its lips,
    L = √(mean_t m[t]²) (s and m as for `SpeechLipMetric`). Both are standardised within each identity,
    and SLCC is Pearson's correlation over all clips, which is Σ_k (n_k − 1) r_k / Σ_k (n_k − 1) with n_k clips
    and the correlation r_k of identity k. From −1 to 1, without unit.

    Definition and name are those of "Perceptually Accurate 3D Talking Head Generation" (Chae-Yeon et al., CVPR 2025)
    and its released scripts, which take S over the whole sound; that is the same where every frame
    holds the same number of samples. The paper reports it beside the truth's: ``of="truth"``, and
    ``of="gap"`` for the prediction's minus the truth's.

    Choices where the scripts are silent: an identity with one clip, or whose speech is as loud in every
    clip, does not enter, and one whose lips do not vary counts 0 (the scripts drop it). A clip of one frame has
    no motion and is left out. `coverage` counts all these.

    Memory grows with ``n_identities``, not with clips or frames.

    Args:
        lips: Lip vertices, a `Region` or indices.
        n_identities: How many identities there are; 1 standardises over all clips together.
        of: ``"prediction"``, ``"truth"`` or ``"gap"``.
        sample_rate: Samples of the speech a second; needed for waveforms, not for intensities.
        frames_per_second: Of the motion; likewise.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity in the motion are refused; in the speech they always are.
        **kwargs: For `torchmetrics.Metric`.
    """

    leaves_out = "no identity has two clips of two frames that are not equally loud"
    moments: Tensor

    def __init__(
        self,
        lips: RegionLike,
        *,
        n_identities: int = 1,
        of: Subject = "prediction",
        sample_rate: int | None = None,
        frames_per_second: float | None = None,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("of", of, SUBJECTS)
        if n_identities < 1:
            raise ValueError(f"n_identities is {n_identities}; expected at least 1")
        region = as_region(lips, "lips")
        super().__init__(
            region,
            of=of,
            definition="Pearson correlation over clips between the intensity of the speech and the root mean square "
            f"over frames of the mean speed of {region}, each standardised within {n_identities} identities, "
            f"{SUBJECT_WORDS[of]} [1]",
            sample_rate=sample_rate,
            frames_per_second=frames_per_second,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.n_identities = n_identities
        self.add_state("moments", torch.zeros(n_identities, 10, dtype=torch.float64), dist_reduce_fx="sum")

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        identities: Tensor | Sequence[int] | None = None,
        waveform: Tensor | None = None,
        intensity: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences with their speech.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: Likewise.
            identities: Number of each sequence's identity, below ``n_identities``; needed unless there is one.
            waveform: As for `SpeechLipMetric.update`.
            intensity: As for `SpeechLipMetric.update`.
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: As for `ComparisonMetric.update`.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `SpeechLipMetric.update`, and if the identities are missing or do not fit.
                Nothing is added then.
        """
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        clips = self.with_speech(clips, waveform, intensity, single=truth.ndim == 3)
        numbers = self._numbers(identities, len(clips.clips))
        numbered = (replace(clip, identity=number) for clip, number in zip(clips.clips, numbers, strict=True))
        self._add(replace(clips, clips=tuple(numbered)))

    def _numbers(self, identities: Tensor | Sequence[int] | None, count: int) -> list[int]:
        if identities is None:
            if self.n_identities > 1:
                raise ValueError(f"identities= is missing; the metric tells {self.n_identities} apart")
            return [0] * count
        values = torch.as_tensor(identities).reshape(-1)
        if len(values) != count or values.is_floating_point() or values.dtype == torch.bool:
            raise ValueError(f"identities must be {count} whole numbers, one a sequence")
        numbers = [int(value) for value in values.tolist()]
        if any(not 0 <= number < self.n_identities for number in numbers):
            raise ValueError(f"identities hold {max(numbers)}; the metric was made for 0 to {self.n_identities - 1}")
        return numbers

    def clip_value(self, clip: Clip) -> Tensor:
        """Intensities of speech, predicted lips and true lips, (3,) float64; NaN for a clip of one frame."""
        lips = [speed(motion, self.indices).square().mean().sqrt() for motion in (clip.prediction, clip.truth)]
        return torch.stack([clip.speech.square().mean().sqrt(), *lips])

    def _add(self, clips: Clips) -> None:
        self.check_vertices(clips.n_vertices)
        if self.check_finite:
            clips.check_finite()
        sums = torch.zeros(self.moments.shape, dtype=torch.float64)
        left_out = 0
        for clip in clips.clips:
            if clip.frames < 2:
                left_out += 1
                continue
            speech, predicted, true = self.clip_value(clip).tolist()
            row = [1, clip.frames, speech, speech**2]
            row += [power for lips in (predicted, true) for power in (lips, lips**2, lips * speech)]
            sums[clip.identity] += torch.tensor(row, dtype=torch.float64)
        cut = torch.tensor([0, 0, clips.cut_prediction, clips.cut_truth, left_out])
        self.moments = self.moments + sums.to(self.moments.device)
        self.counts = self.counts + cut.to(self.counts.device)

    def _enter(self) -> Tensor:
        """Which identities have clips that differ in loudness, (n_identities,) bool."""
        return (self.moments[:, _CLIPS] > 1) & (_deviation(self.moments, _SPEECH, _SPEECH_SQUARED) > 0)

    def compute(self) -> Tensor:
        """The correlation over all clips so far, a float64 scalar.

        Raises:
            ValueError: If no process had any sequence, or no identity enters.
        """
        moments = self.moments[self._enter()]
        if not len(moments):
            self.refuse_to_compute(self.covered().left_out)
        if self.of == "gap":
            return _standardised_correlation(moments, "prediction") - _standardised_correlation(moments, "truth")
        return _standardised_correlation(moments, self.of)

    def covered(self) -> Coverage:
        """What the states say was scored, cut and left out."""
        moments, all_clips = self.moments[self._enter()], int(self.moments[:, _CLIPS].sum())
        sequences = int(moments[:, _CLIPS].sum())
        cut_prediction, cut_truth, left_out = self.counts[2:].tolist()
        frames = int(moments[:, _FRAMES].sum())
        return Coverage(frames, sequences, cut_prediction, cut_truth, left_out + all_clips - sequences)


def _standardised_correlation(moments: Tensor, side: str) -> Tensor:
    """Σ_k (n_k − 1) r_k / Σ_k (n_k − 1), with r_k = 0 for lips that do not vary."""
    total, squared, product = _LIPS[side]
    covariance = moments[:, product] - moments[:, _SPEECH] * moments[:, total] / moments[:, _CLIPS]
    lips = _deviation(moments, total, squared)
    scale = (_deviation(moments, _SPEECH, _SPEECH_SQUARED) * lips).sqrt()
    each = torch.where(lips > 0, (covariance / scale).clamp(-1, 1), 0.0)
    weights = moments[:, _CLIPS] - 1
    return (weights * each).sum() / weights.sum()


def _deviation(moments: Tensor, total: int, squared: int) -> Tensor:
    """Sum of squared deviations from the mean; 0 where they are no more than rounding."""
    found = moments[:, squared] - moments[:, total].square() / moments[:, _CLIPS].clamp(min=1)
    return torch.where(found > 1e-12 * moments[:, squared], found, 0.0)


def clip_speech_lip_correlation(
    prediction: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    waveform: Tensor | None = None,
    intensity: Tensor | None = None,
    identities: Tensor | Sequence[int] | None = None,
    of: Subject = "prediction",
    sample_rate: int | None = None,
    frames_per_second: float | None = None,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Speech–lip intensity correlation coefficient (SLCC) over clips, see `ClipSpeechLipCorrelation`.

    Args:
        prediction: (batch, frames, vertices, 3).
        truth: Likewise.
        lips: Lip vertices, a `Region` or indices.
        waveform: The sound (batch, samples); needs the two rates.
        intensity: Instead: intensity of the speech in each frame, (batch, frames).
        identities: Number of each sequence's identity from 0; None for one.
        of: ``"prediction"``, ``"truth"`` or ``"gap"``.
        sample_rate: Samples of the waveform a second.
        frames_per_second: Of the motion.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar, −1 to 1; a gap −2 to 2.

    Raises:
        ValueError: As `ClipSpeechLipCorrelation.update`, and if no identity enters.

    >>> import torch
    >>> loudness = torch.tensor([[1.0], [2.0], [4.0]]).expand(3, 5)
    >>> motion = (loudness.cumsum(1))[..., None, None].expand(3, 5, 2, 3)
    >>> round(clip_speech_lip_correlation(motion, -motion, [0, 1], intensity=loudness).item(), 6)
    1.0
    """
    n_identities = 1 if identities is None else int(torch.as_tensor(identities).max()) + 1
    metric = ClipSpeechLipCorrelation(
        lips,
        n_identities=n_identities,
        of=of,
        sample_rate=sample_rate,
        frames_per_second=frames_per_second,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(
        prediction,
        truth,
        identities=identities,
        waveform=waveform,
        intensity=intensity,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
