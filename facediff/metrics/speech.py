"""Do the lips move much when the voice is loud? Correlation of the intensities of speech and lips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from facediff.metrics.base import SequenceMetric
from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.formulas import correlation, speed
from facediff.metrics.options import SUBJECT_WORDS, SUBJECTS, LengthRule, Subject, check_option
from facediff.metrics.regions import Region, RegionLike, as_region


class SpeechLipMetric(SequenceMetric):
    """Base of metrics that hold the lips' motion against the intensity of the speech.

    The intensity of speech s[t] is the root mean square of the samples of frame t; that of the lips
    m[t] = mean_{v∈M} ‖x[t, v] − x[t − 1, v]‖₂ is their mean speed, t from the second frame on.

    Args:
        lips: Lip vertices.
        of: Whose lips.
        definition: The metric in words.
        sample_rate: Samples of the speech a second, if sound is given rather than intensities.
        frames_per_second: Of the motion, likewise.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    indices: Tensor

    def __init__(
        self,
        lips: Region,
        *,
        of: Subject,
        definition: str,
        sample_rate: int | None,
        frames_per_second: float | None,
        length_rule: LengthRule,
        check_finite: bool,
        **kwargs: object,
    ) -> None:
        check_option("of", of, SUBJECTS)
        if (sample_rate is None) != (frames_per_second is None):
            raise ValueError("sample_rate and frames_per_second belong together; give both, or none with intensities")
        if sample_rate is not None and frames_per_second is not None and not 0 < frames_per_second <= sample_rate:
            raise ValueError(f"{frames_per_second} frames a second do not fit {sample_rate} samples a second")
        super().__init__(
            definition=definition,
            pooling="sequences",
            region=lips,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.of: Subject = of
        self.sample_rate = sample_rate
        self.frames_per_second = frames_per_second

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
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
            waveform: The sound (batch, samples), or (samples,) of one sequence, at the metric's
                ``sample_rate``, beginning with the first frame. Samples beyond the scored frames are not read.
            intensity: Instead of a waveform: its intensity in each frame, (batch, frames) or (frames,).
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: As for `ComparisonMetric.update`.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `ComparisonMetric.update`, and if the speech is missing, given twice, too short
                or not finite. Nothing is added then.
        """
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(self.with_speech(clips, waveform, intensity, single=truth.ndim == 3))

    def with_speech(self, clips: Clips, waveform: Tensor | None, intensity: Tensor | None, *, single: bool) -> Clips:
        """The sequences with the intensity of their speech.

        Args:
            clips: The sequences.
            waveform: As for `update`.
            intensity: As for `update`.
            single: Whether the caller gave one sequence without batch axis.

        Raises:
            ValueError: As `update`.
        """
        if waveform is not None and intensity is None:
            name, given = "waveform", waveform
        elif intensity is not None and waveform is None:
            name, given = "intensity", intensity
        else:
            raise ValueError("give the speech once: as waveform= or as intensity=")
        count = len(clips.clips)
        fits = given.ndim == 1 if single else given.ndim == 2 and len(given) == count
        if not fits or not given.is_floating_point():
            raise ValueError(
                f"{name} has shape {tuple(given.shape)} and type {given.dtype}; expected floating-point numbers, one "
                f"row for each of {count} sequences"
            )
        read = self._intensity if name == "waveform" else self._cut
        given = given.detach()
        rows = [given] if single else list(given)
        spoken = (
            replace(clip, speech=read(clip, row).to(clip.truth.device))
            for clip, row in zip(clips.clips, rows, strict=True)
        )
        return replace(clips, clips=tuple(spoken))

    def _intensity(self, clip: Clip, waveform: Tensor) -> Tensor:
        if self.sample_rate is None or self.frames_per_second is None:
            raise ValueError("speech as a waveform needs sample_rate= and frames_per_second= of the metric")
        try:
            return speech_intensity(waveform, clip.frames, self.sample_rate, self.frames_per_second)
        except ValueError as error:
            raise ValueError(f"{clip.name}: {error}") from error

    def _cut(self, clip: Clip, intensity: Tensor) -> Tensor:
        if len(intensity) < clip.frames:
            raise ValueError(f"{clip.name}: intensity of {len(intensity)} frames for {clip.frames} frames of motion")
        found = intensity[: clip.frames].double()
        if not bool(found.isfinite().all()):
            raise ValueError(f"the intensity of {clip.name} holds NaN or infinity; repair or leave out this clip")
        return found


def speech_intensity(waveform: Tensor, frames: int, sample_rate: int, frames_per_second: float) -> Tensor:
    """Root mean square of the samples of each frame.

    Frame t holds the samples from ⌊t · sample_rate / frames_per_second + ½⌋ up to where frame t + 1 begins.

    Args:
        waveform: (samples,), floating point; samples beyond the last frame are not read.
        frames: How many frames.
        sample_rate: Samples a second.
        frames_per_second: Frames a second.

    Returns:
        (frames,), float64, in the waveform's unit.

    Raises:
        ValueError: If the last frame has no sample, or a sample is NaN or infinite.

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
    if not bool(power.isfinite().all()):
        raise ValueError("the speech holds NaN or infinity; repair or leave out this clip")
    lengths = torch.tensor(bounds, device=waveform.device).diff()
    frame_of_sample = torch.repeat_interleave(torch.arange(frames, device=waveform.device), lengths)
    return (torch.zeros_like(lengths, dtype=torch.float64).index_add_(0, frame_of_sample, power) / lengths).sqrt()


class FrameSpeechLipCorrelation(SpeechLipMetric):
    """Speech–lip intensity correlation (SLCC) over the frames of each sequence.

    Per sequence Pearson's correlation over frames, from the second on, between the speech's intensity s[t] and
    the lips' m[t] (see `SpeechLipMetric`); then the mean over sequences. From −1 to 1, without unit; the
    scale of sound and mesh does not matter, nor does a template.

    ``of="gap"`` is the prediction's minus the truth's: negative where the lips follow loudness less
    than the truth's. Lips that do not vary count 0; a sequence whose speech does not vary, or with fewer
    than three frames, is left out, and `coverage` says so.

    The SLCC of "Perceptually Accurate 3D Talking Head Generation" (Chae-Yeon et al., CVPR 2025) is taken
    over clips instead: `ClipSpeechLipCorrelation`. This one asks the same within a sentence; the definition is ours.

    Args:
        lips: Lip vertices, a `Region` or indices.
        of: ``"prediction"``, ``"truth"`` or ``"gap"``.
        sample_rate: Samples of the speech a second; needed for waveforms, not for intensities.
        frames_per_second: Of the motion; likewise.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity in the motion are refused; in the speech they always are.
        **kwargs: For `torchmetrics.Metric`.
    """

    leaves_out = "the intensity of the speech does not vary"

    def __init__(
        self,
        lips: RegionLike,
        *,
        of: Subject = "prediction",
        sample_rate: int | None = None,
        frames_per_second: float | None = None,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("of", of, SUBJECTS)
        region = as_region(lips, "lips")
        super().__init__(
            region,
            of=of,
            definition="in each sequence the Pearson correlation over frames between the intensity of the speech (root "
            f"mean square of a frame) and the mean speed of {region}, {SUBJECT_WORDS[of]}; mean over sequences; lips "
            "that do not vary count 0, a sequence whose speech does not vary is left out [1]",
            sample_rate=sample_rate,
            frames_per_second=frames_per_second,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The correlation of one sequence, NaN if its speech does not vary."""

        def follow(motion: Tensor) -> Tensor:
            return correlation(clip.speech[1:], speed(motion, self.indices))

        if self.of == "gap":
            return follow(clip.prediction) - follow(clip.truth)
        return follow(clip.prediction if self.of == "prediction" else clip.truth)


def frame_speech_lip_correlation(
    prediction: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    waveform: Tensor | None = None,
    intensity: Tensor | None = None,
    of: Subject = "prediction",
    sample_rate: int | None = None,
    frames_per_second: float | None = None,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Speech–lip intensity correlation over frames, see `FrameSpeechLipCorrelation`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        lips: Lip vertices, a `Region` or indices.
        waveform: The sound (batch, samples) or (samples,); needs the two rates.
        intensity: Instead: intensity of the speech in each frame, (batch, frames) or (frames,).
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
        ValueError: As `SpeechLipMetric.update`, and if no speech varies.

    >>> import torch
    >>> loudness = torch.tensor([0.0, 1.0, 3.0, 2.0])
    >>> motion = loudness.cumsum(0)[:, None, None].expand(4, 5, 3)
    >>> round(frame_speech_lip_correlation(motion, motion, [0, 1], intensity=loudness).item(), 6)
    1.0
    """
    metric = FrameSpeechLipCorrelation(
        lips,
        of=of,
        sample_rate=sample_rate,
        frames_per_second=frames_per_second,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(
        prediction,
        truth,
        waveform=waveform,
        intensity=intensity,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
