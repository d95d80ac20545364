"""Does the head move with the beat of the speech? Onsets of sound against moments in which the head turns slowest."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor

from facediff.metrics.base import Clip, SequenceOptions, Side, UpdateOptions, check_range, functional, of_side
from facediff.metrics.channels import OneSideMetric
from facediff.metrics.regions import RegionLike
from facediff.metrics.timing import extrema, smooth
from facediff.registry import metric

WINDOW_SECONDS = 0.032
HOP_SECONDS = 0.01
COMPRESSION = 100.0
THRESHOLD = 0.07
BEFORE_SECONDS, AFTER_SECONDS = 0.1, 0.1
APART_SECONDS = 0.03
"""Parameters of :func:`onsets`."""


def onsets(waveform: Tensor, sample_rate: int) -> Tensor:
    """Moments at which sounds begin, in seconds (onsets,), float64, by spectral flux.

    Magnitudes |X[n, f]| of windows of 32 ms (Hann), 10 ms apart, of the sound divided by its largest absolute
    value, are compressed as log(1 + 100 |X|), with the window's sum as unit. The flux is the mean rise over f
    from a window to the next, divided by its largest value. An onset is a window with the largest flux within 30 ms,
    by 0.07 above the mean of the flux from 100 ms before to 100 ms after it. The time is the window's centre. Silence
    has none. Our own detector, so that the metrics need no further library; others find others.

    Args:
        waveform: (samples,), floating point.
        sample_rate: samples a second.

    >>> sound = torch.zeros(16000)
    >>> sound[8000:8400] = torch.randn(400, generator=torch.Generator().manual_seed(0))
    >>> [round(seconds, 2) for seconds in onsets(sound, 16000).tolist()]
    [0.5]
    """
    loudest = waveform.abs().max() if len(waveform) else waveform.new_zeros(())
    if not bool(loudest > 0):
        return torch.empty(0, dtype=torch.float64)
    size, hop = max(2, round(WINDOW_SECONDS * sample_rate)), max(1, round(HOP_SECONDS * sample_rate))
    window = torch.hann_window(size, dtype=torch.float64)
    sound = torch.nn.functional.pad(waveform.double().cpu() / loudest.double().cpu(), (size // 2, size // 2))
    spectra = torch.fft.rfft(sound.unfold(0, size, hop) * window, dim=1).abs() / window.sum()
    flux = torch.log1p(COMPRESSION * spectra).diff(dim=0).clamp_min(0).mean(1)
    flux = torch.cat([flux.new_zeros(1), flux])  # the first window has none before it
    if not bool(flux.max() > 0):
        return torch.empty(0, dtype=torch.float64)
    flux = flux / flux.max()
    before, after, apart = (round(seconds / HOP_SECONDS) for seconds in (BEFORE_SECONDS, AFTER_SECONDS, APART_SECONDS))
    padded = torch.nn.functional.pad(flux, (before, after), value=float("nan"))
    mean = padded.unfold(0, before + after + 1, 1).nanmean(1)
    nearby = torch.nn.functional.pad(flux, (apart, apart)).unfold(0, 2 * apart + 1, 1).amax(1)
    peaks = ((flux == nearby) & (flux > mean + THRESHOLD)).nonzero().flatten()
    return peaks.double() * hop / sample_rate


@metric.register("head_beat_alignment")
class HeadBeatAlignment(OneSideMetric):
    """BA: are there slow moments of the head near the onsets of the speech? Mean over onsets of exp(−d² / (2v)).

    d is the distance in frames from an onset to the nearest minimum of the head's speed, which is ‖x[t + 1] − x[t]‖₂
    over the head's channels, at t + ½, under a Gaussian of standard deviation σ frames. From 0 to 1; a prediction
    without a minimum of speed counts 0, a sequence without onsets is left out. Then the mean over sequences.

    **Numbers of different σ, v and frame rates cannot be compared**, and every paper has its own: σ 5 and v 9 are the
    defaults of the scripts that stem from Bailando, 3/7 and 2/8 occur too. The onsets come from :func:`onsets`;
    others take librosa's onsets or beats.

    Args:
        region: channels of the head, a :class:`Region` or indices; None for all.
        smoothing: σ, in frames.
        variance: v, in squared frames.
        sample_rate: samples of the speech per second.
        frames_per_second: of the motion.
        of: ``"prediction"``, ``"truth"`` or ``"gap"``, the prediction's minus the truth's.
    """

    needs = ("channels", "speech")
    usual_channels = "head"
    leaves_out = "the speech has no onset"

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        smoothing: float = 5.0,
        variance: float = 9.0,
        sample_rate: int = 16_000,
        frames_per_second: float | None = None,
        of: Side = "prediction",
        **options: Unpack[SequenceOptions],
    ) -> None:
        frames_per_second = frames_per_second or 0.0
        check_range("frames_per_second", frames_per_second, 1e-9, sample_rate)
        check_range("smoothing", smoothing, 0)
        check_range("variance", variance, 1e-9)
        definition = (
            f"in each sequence the mean over onsets of the speech of exp(−d² / {2 * variance:g}), d being the frames "
            f"to the nearest minimum of the speed of {{region}} smoothed over {smoothing:g} frames, at "
            f"{frames_per_second:g} frames a second, {{side}}; mean over sequences "
            "[1]"
        )
        super().__init__(region, definition=definition, of=of, **options)
        self.smoothing = smoothing
        self.variance = variance
        self.sample_rate = sample_rate
        self.frames_per_second = frames_per_second

    def clip_value(self, clip: Clip) -> Tensor:
        """The alignment of one sequence, NaN where its speech has no onset."""
        beats = clip.beats
        if beats is None or not len(beats):
            return torch.full((), torch.nan, dtype=torch.float64, device=clip.truth.device)

        def alignment(motion: Tensor) -> Tensor:
            speed = self.flat(motion).diff(dim=0).norm(dim=1).cpu()
            speed = smooth(speed, self.smoothing) if len(speed) else speed
            slow = [frame + 0.5 for frame, turn in extrema(speed.tolist()).items() if turn < 0]
            if not slow:
                return torch.zeros((), dtype=torch.float64)
            gaps = (beats[:, None] - torch.tensor(slow, dtype=torch.float64)).abs().amin(1)
            return torch.exp(-gaps.square() / (2 * self.variance)).mean()

        return of_side(self.of, clip, alignment).to(clip.truth.device)

    def update(
        self, prediction: Tensor, truth: Tensor, *, waveform: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences (batch, frames, channels, 1) with their speech.

        ``waveform`` is the sound (batch, samples), or (samples,) of one sequence, beginning with the first frame.
        Samples beyond the scored frames are not read.
        """
        clips = self.align(prediction, truth, **batch)
        sounds = clips.rows("waveform", waveform, single=truth.ndim == 3, ndim=2)
        samples = [int(clip.frames * self.sample_rate / self.frames_per_second) for clip in clips.clips]
        scored = clips.finite("speech", [sound[:count] for sound, count in zip(sounds, samples, strict=True)])
        self.add(clips.attach("beats", [onsets(sound, self.sample_rate) * self.frames_per_second for sound in scored]))


head_beat_alignment = functional(HeadBeatAlignment)
