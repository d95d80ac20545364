"""Do the lips move much when the voice is loud? Correlation of the intensities of speech and lips (SLCC).

The intensity of speech s[t] is the root mean square of the samples of frame t; the lips' intensity is
their mean speed m[t] = mean_{v∈M} ‖x[t, v] − x[t − 1, v]‖₂, t from the second frame on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    SIDE_WORDS,
    Clip,
    Coverage,
    Inferred,
    SequenceOptions,
    Side,
    SumsMetric,
    UpdateOptions,
    check_option,
    check_range,
    functional,
    whole_numbers,
)
from facediff.metrics.mouth import speed
from facediff.metrics.regions import RegionLike, as_region
from facediff.registry import metric


def speech_intensity(waveform: Tensor, frames: int, sample_rate: int, frames_per_second: float) -> Tensor:
    """Root mean square of the samples of each frame.

    Frame t holds the samples from ⌊t · sample_rate / frames_per_second + ½⌋ up to where frame t + 1 begins.

    Returns:
        (frames,), float64, in the waveform's unit.

    >>> speech_intensity(torch.tensor([3.0, 3.0, 0.0, 4.0]), 2, 50, 25)
    tensor([3.0000, 2.8284], dtype=torch.float64)
    """
    bounds = [int(frame * sample_rate / frames_per_second + 0.5) for frame in range(frames + 1)]
    if len(waveform) <= bounds[-2]:
        raise ValueError(
            f"the speech has {len(waveform)} samples, {frames} frames reach to sample {bounds[-1]}; cut the "
            "motion, or fill up with silence"
        )
    bounds[-1] = min(bounds[-1], len(waveform))
    power = waveform[: bounds[-1]].double().square()
    lengths = torch.tensor(bounds, device=waveform.device).diff()
    frame_of_sample = torch.repeat_interleave(torch.arange(frames, device=waveform.device), lengths)
    return (torch.zeros_like(lengths, dtype=torch.float64).index_add_(0, frame_of_sample, power) / lengths).sqrt()


# Columns of the sums that are kept for each identity; for the lips the sum, sum of squares, and sum of products with
# the speech.
_CLIPS, _FRAMES, _SPEECH, _SPEECH_SQUARED = range(4)
_LIPS = {"prediction": (4, 5, 6), "truth": (7, 8, 9)}


def _identity_count(arguments: Mapping[str, Any]) -> int:
    identities = arguments.get("identities")
    return 1 if identities is None else int(torch.as_tensor(identities).max()) + 1


@metric.register("clip_speech_lip_correlation")
class ClipSpeechLipCorrelation(SumsMetric):
    """Speech–lip intensity correlation coefficient (SLCC) over clips.

    Each clip gives one intensity of its speech, S = √(mean_t s[t]²), and one of its lips,
    L = √(mean_t m[t]²) (s and m as in :mod:`facediff.metrics.speech`). Both are standardised within each identity,
    and SLCC is Pearson's correlation over all clips, which is Σ_k (n_k − 1) r_k / Σ_k (n_k − 1) with n_k clips
    and the correlation r_k of identity k. From −1 to 1, without unit.

    Definition and name are from "Perceptually Accurate 3D Talking Head Generation" (Chae-Yeon et al., CVPR 2025)
    and its released scripts, which take S over the whole sound; that is the same where every frame
    holds the same number of samples. The paper reports it next to the truth's: ``of="truth"``, and
    ``of="gap"`` for the prediction's minus the truth's.

    Choices where the scripts are silent: an identity with one clip, or with speech as loud in every
    clip, does not enter, and one with lips that do not vary counts 0 (the scripts drop it). A clip of one frame has
    no motion and is left out. :meth:`coverage` counts all these.

    Memory grows with ``n_identities``, not with clips or frames.

    Args:
        lips: lip vertices, a :class:`Region` or indices.
        n_identities: how many identities there are; 1 standardises over all clips together.
        of: the lips of the ``"prediction"``, ``"truth"`` or ``"gap"``, the prediction's minus the truth's.
        sample_rate: samples of the speech per second; needed for waveforms, not for intensities.
        frames_per_second: of the motion; needed with ``sample_rate``.

    >>> import torch
    >>> loudness = torch.tensor([[1.0], [2.0], [4.0]]).expand(3, 5)
    >>> motion = (loudness.cumsum(1))[..., None, None].expand(3, 5, 2, 3)
    >>> round(clip_speech_lip_correlation(motion, -motion, [0, 1], intensity=loudness).item(), 6)
    1.0
    """

    leaves_out = "no identity has two clips of two frames that are not equally loud"
    needs: ClassVar[tuple[str, ...]] = ("lips", "speech", "identities")
    inferred: ClassVar[Inferred] = {"n_identities": _identity_count}
    indices: Tensor

    def __init__(
        self,
        lips: RegionLike,
        *,
        n_identities: int = 1,
        of: Side = "prediction",
        sample_rate: int | None = None,
        frames_per_second: float | None = None,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("of", of, Side)
        check_range("n_identities", n_identities, 1)
        if sample_rate is not None:
            check_range("frames_per_second", frames_per_second or 0.0, 1e-9, sample_rate)
        definition = (
            "Pearson correlation over clips between the intensity of the speech and the root mean square "
            f"over frames of the mean speed of {{region}}, each standardised within {n_identities} identities, "
            f"{SIDE_WORDS[of]} [1]"
        )
        region = as_region(lips, "lips")
        super().__init__(shape=(n_identities, 10), definition=definition, region=region, **options)
        self.n_identities = n_identities
        self.of: Side = of
        self.sample_rate = sample_rate
        self.frames_per_second = frames_per_second

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        identities: Tensor | Sequence[int] | None = None,
        waveform: Tensor | None = None,
        intensity: Tensor | None = None,
        **batch: Unpack[UpdateOptions],
    ) -> None:
        """Add a batch of sequences with their speech; see :meth:`SequenceMetric.update`.

        ``waveform`` is the sound (batch, samples), or (samples,) of one sequence, at the metric's ``sample_rate``,
        beginning with the first frame; samples beyond the scored frames are not read. ``intensity`` is given instead of
        it: the intensity of each frame, (batch, frames) or (frames,). ``identities`` has the number of each sequence's
        identity, below ``n_identities``; needed unless there is one.
        """
        if waveform is not None and (intensity is not None or self.sample_rate is None):
            raise ValueError("give intensity=, or waveform= to a metric made with sample_rate= and frames_per_second=")
        clips, single = self.align(prediction, truth, **batch), truth.ndim == 3
        if waveform is not None:
            rows = clips.rows("waveform", waveform, single=single, ndim=2)
            rates = int(self.sample_rate or 0), float(self.frames_per_second or 0)
            speech = [speech_intensity(row, clip.frames, *rates) for clip, row in zip(clips.clips, rows, strict=True)]
        else:
            rows = clips.rows("intensity", intensity, single=single, ndim=2)
            speech = [row[: clip.frames].double() for clip, row in zip(clips.clips, rows, strict=True)]
            if any(len(frames) < clip.frames for clip, frames in zip(clips.clips, speech, strict=True)):
                raise ValueError("an intensity has fewer frames than its motion; cut the motion, or fill up with zeros")
        clips = clips.attach("speech", [row.to(self.counts.device) for row in clips.finite("speech", speech)])
        count = len(clips.clips)
        if identities is None:
            identities = [0] * count if self.n_identities == 1 else []
        self.add(clips.attach("identity", whole_numbers("identities", identities, count, self.n_identities - 1)))

    def clip_value(self, clip: Clip) -> Tensor:
        """NaN for a clip of one frame, which has no motion."""
        return super().clip_value(clip) if clip.frames > 1 else torch.full_like(self.sums[0, 0], torch.nan)

    def clip_sums(self, clip: Clip) -> Tensor:
        """The clip's intensities in the row of its identity."""
        speech = clip.speech.square().mean().sqrt()
        row = [torch.ones_like(speech), torch.full_like(speech, clip.frames), speech, speech**2]
        for motion in (clip.prediction, clip.truth):
            lips = speed(motion, self.indices).square().mean().sqrt()
            row += [lips, lips**2, lips * speech]
        sums = torch.zeros_like(self.sums)
        sums[clip.identity] = torch.stack(row)
        return sums

    def score(self, sums: Tensor) -> Tensor:
        """The correlation over the clips of identities that enter."""
        moments = sums[_enters(sums)]
        if not len(moments):
            self.refuse_to_compute(self.covered().left_out)
        if self.of == "gap":
            return _standardised_correlation(moments, "prediction") - _standardised_correlation(moments, "truth")
        return _standardised_correlation(moments, self.of)

    def covered(self) -> Coverage:
        """Sequences of this process that were scored, cut and left out."""
        sequences, frames = (int(self.sums[_enters(self.sums), column].sum()) for column in (_CLIPS, _FRAMES))
        cut_prediction, cut_truth, left_out = self.counts[2:].tolist()
        left_out += int(self.sums[:, _CLIPS].sum()) - sequences
        return Coverage(frames, sequences, cut_prediction, cut_truth, left_out)


clip_speech_lip_correlation = functional(ClipSpeechLipCorrelation)


def _enters(moments: Tensor) -> Tensor:
    """Which identities have clips that differ in loudness, (n_identities,) bool."""
    return (moments[:, _CLIPS] > 1) & (_deviation(moments, _SPEECH, _SPEECH_SQUARED) > 0)


def _standardised_correlation(moments: Tensor, side: str) -> Tensor:
    """Σ_k (n_k − 1) r_k / Σ_k (n_k − 1), with r_k = 0 for lips that do not vary."""
    total, squared, product = _LIPS[side]
    covariance = moments[:, product] - moments[:, _SPEECH] * moments[:, total] / moments[:, _CLIPS]
    lips = _deviation(moments, total, squared)
    scale = (_deviation(moments, _SPEECH, _SPEECH_SQUARED) * lips).sqrt()
    correlations = torch.where(lips > 0, (covariance / scale).clamp(-1, 1), 0.0)
    weights = moments[:, _CLIPS] - 1
    return (weights * correlations).sum() / weights.sum()


def _deviation(moments: Tensor, total: int, squared: int) -> Tensor:
    """Sum of squared deviations from the mean; 0 where they are no more than rounding."""
    deviation = moments[:, squared] - moments[:, total].square() / moments[:, _CLIPS].clamp(min=1)
    return torch.where(deviation > 1e-12 * moments[:, squared], deviation, 0.0)
