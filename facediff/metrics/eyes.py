"""Eyelids: how often they shut, a minute or as a share of the truth's, and whether they rest between blinks.

The opening of the eyes is read off pairs of an upper and a lower eyelid vertex, as the mouth's is off pairs of
lip vertices. How far they are shut is a share of the sequence's own usual opening, so that heavy lids or a squint do
not count as half a blink.
"""

from __future__ import annotations

from typing import ClassVar, Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import Clip, SequenceOptions, check_option, check_range, functional
from facediff.metrics.generation import RatioMetric
from facediff.metrics.mouth import OpeningMetric
from facediff.metrics.regions import LipPairsLike
from facediff.registry import metric

CLOSED, REOPENED = 0.5, 0.3
"""Shares of the usual opening: a blink begins where the lids are shut by more than the first, and the next one may only
begin after they were shut by less than the second. Puppet's blinks are the same for 0.4 to 0.6 and 0.2 to 0.4."""


def count_blinks(opening: Tensor, *, closed: float = CLOSED, reopened: float = REOPENED) -> Tensor:
    """How often the eyes shut in a series of their openings (frames,): a whole number, as a float64 scalar.

    The lids are shut by c[t] = 1 − o[t] / median(o). A blink is counted where c rises above ``closed`` for the first
    time since it was below ``reopened``; two limits, so that lids which tremble at one of them do not count again and
    again. Eyes that are shut in the first frame are a blink; eyes that are never open have none.

    >>> import torch
    >>> count_blinks(torch.tensor([1.0, 1.0, 0.2, 0.6, 0.3, 1.0, 1.0, 0.1, 1.0, 1.0])).item()
    2.0
    """
    shut = 1.0 - opening.double() / opening.double().quantile(0.5)
    marks = (shut > closed).long() - (shut < reopened).long()
    marks = marks[marks != 0]  # what lies between the limits changes nothing
    return ((marks[1:] > 0) & (marks[:-1] < 0)).sum().double() + (marks[:1] > 0).sum()


class LidMetric(OpeningMetric, RatioMetric):
    """Base of metrics of the eyelids, by upper and lower eyelid vertices, :class:`EyelidPairs` or pairs of indices."""

    needs: ClassVar[tuple[str, ...]] = ("lid_pairs",)
    pairs_name = "eyelid pairs"


class BlinkMetric(LidMetric):
    """Base of metrics that count blinks.

    Args:
        pairs: upper and lower eyelid vertices, :class:`EyelidPairs` or pairs of indices.
        closed: share of the usual opening by which the lids must be shut for a blink to begin.
        reopened: share by which they may still be shut for another blink to be possible.
    """

    in_order = True

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        definition: str | None = None,
        closed: float = CLOSED,
        reopened: float = REOPENED,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_range("closed", closed, 0, 1)
        check_range("reopened", reopened, 0, closed)
        definition = (
            f"{definition or self.words}, a blink being a rise of 1 − opening / median opening of the sequence above "
            f"{closed:g} after it was below {reopened:g}, an opening the mean distance of {{pairs}}"
        )
        super().__init__(pairs, definition=definition, **options)
        self.closed = closed
        self.reopened = reopened

    def blinks(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Blinks of prediction and truth."""
        predicted, true = (
            count_blinks(series, closed=self.closed, reopened=self.reopened) for series in self.openings(clip)
        )
        return predicted, true


@metric.register("blink_rate_ratio")
class BlinkRateRatio(BlinkMetric):
    """Blink rate ratio: blinks of the prediction over blinks of the truth, summed over all sequences.

    1 is as often as the truth, 0 a face that never blinks. It does not ask for blinks at the same moments: speech does
    not say when. Definition and limits are ours.

    >>> import torch
    >>> opening = torch.ones(2, 50)
    >>> opening[0, 20:24] = opening[1, 10:13] = opening[1, 30:33] = 0.1
    >>> once, twice = opening[:, :, None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    >>> blink_rate_ratio(once, twice, [(0, 1)]).item()
    0.5
    """

    divides_by = "nobody blinks in the truth"
    words = "blinks of the prediction over blinks of the truth"

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Blinks of either side of one sequence."""
        return self.blinks(clip)


blink_rate_ratio = functional(BlinkRateRatio)


@metric.register("blink_rate")
class BlinkRate(BlinkMetric):
    """Blink rate: blinks a minute, over all sequences. People who talk blink about 15 to 20 times.

    Args:
        frames_per_second: of the motion.
        of: ``"prediction"`` or ``"truth"``.

    >>> import torch
    >>> opening = torch.ones(150)
    >>> opening[20:25] = opening[90:95] = 0.0
    >>> motion = opening[:, None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    >>> round(blink_rate(motion, motion, [(0, 1)], frames_per_second=25).item(), 9)  # 2 in 6 seconds
    20.0
    """

    unit = "a minute"

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        frames_per_second: float | None = None,
        of: Literal["prediction", "truth"] = "prediction",
        closed: float = CLOSED,
        reopened: float = REOPENED,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("of", of, Literal["prediction", "truth"])
        frames_per_second = frames_per_second or 0.0
        check_range("frames_per_second", frames_per_second, 1e-9)
        definition = f"blinks of the {of} over minutes at {frames_per_second:g} frames a second"
        super().__init__(pairs, definition=definition, closed=closed, reopened=reopened, **options)
        self.frames_per_second = frames_per_second
        self.of = of

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Blinks of one side of one sequence, and how many minutes it lasts."""
        predicted, true = self.blinks(clip)
        minutes = torch.full_like(true, clip.frames / (60 * self.frames_per_second))
        return (predicted if self.of == "prediction" else true), minutes


blink_rate = functional(BlinkRate)


@metric.register("eyelid_drift")
class EyelidDrift(LidMetric):
    """Eyelid drift: how far lids stray from their usual opening between blinks, as a share of how far the truth's do.

    Σ_t |c[t]| over the frames with c[t] = 1 − o[t] / median(o) below ``reopened``, divided by how many they are; sums
    over sequences are weighted by their frames. Lids that wander by chance may have the variance and the spectrum of
    lids that rest and blink, and look tired or startled. Definition and limit are ours.

    Args:
        pairs: upper and lower eyelid vertices.
        reopened: share of the usual opening by which lids are shut in a blink only.

    >>> import torch
    >>> opening = torch.ones(2, 60)
    >>> opening[:, 20:24], opening[0, 40:], opening[1, 40:] = 0.0, 0.875, 0.75
    >>> truth, wandering = opening[:, :, None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    >>> round(eyelid_drift(wandering, truth, [(0, 1)]).item(), 6)
    2.0
    """

    divides_by = "the truth's lids do not move between blinks"

    def __init__(self, pairs: LipPairsLike, *, reopened: float = REOPENED, **options: Unpack[SequenceOptions]) -> None:
        check_range("reopened", reopened, 0, 1)
        definition = (
            f"mean |1 − opening / median opening| over frames in which it is below {reopened:g}, an opening the mean "
            f"distance of {{pairs}}, over that of the truth"
        )
        super().__init__(pairs, definition=definition, **options)
        self.reopened = reopened

    def clip_parts(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """Both sides' drift, times the frames."""
        predicted, true = (self._drift(opening) * clip.frames for opening in self.openings(clip))
        return predicted, true

    def _drift(self, opening: Tensor) -> Tensor:
        shut = 1.0 - opening / opening.quantile(0.5).clamp_min(1e-12)
        between = shut < self.reopened  # none where the eyes are never open
        return shut.abs().where(between, 0.0).sum() / between.sum().clamp_min(1)


eyelid_drift = functional(EyelidDrift)
