"""Whether the mouth closes where speech has it closed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import torch
from torch import Tensor

from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.face_dynamics import split_template
from facediff.metrics.lip_pairs import LipPairsLike
from facediff.metrics.mouth import OpeningMetric
from facediff.metrics.options import SUBJECT_WORDS, SUBJECTS, LengthRule, Pooling, Subject, check_option

Interval = tuple[int, int]
Closures = Tensor | Sequence[Sequence[Interval]] | Sequence[Interval]
"""Known closures: a boolean mask (batch, frames), or for each sequence a list of intervals (first frame, frame
after the last). For one sequence without batch axis a mask (frames,) or its list of intervals."""

Counted = Literal["frames", "closures"]
"""What a closure rate is a share of."""

COUNTS: tuple[Counted, ...] = get_args(Counted)
COUNTED_WORDS: dict[Counted, str] = {
    "frames": "the frames of known closures in which the mouth is closed",
    "closures": "the known closures in which the mouth is closed in at least one frame",
}


class BilabialClosureRate(OpeningMetric):
    """Bilabial-closure rate: how often the mouth is closed where speech has it closed (p, b, m).

    The known closures come with each clip, usually from aligned phonemes. With o[t] the opening of the mouth
    (see `MouthOpeningDifference`) and o_g the truth's, a frame is closed if

        o[t] ≤ min_t o_g + threshold · (max_t o_g − min_t o_g).

    The limit is thus a share of the range of the *truth's* opening in the same clip: it does not depend on
    the unit or on the gap that a mesh keeps between closed lips, and the truth is always closed somewhere.
    Definition and default threshold are choices; there is no usual formula. Captured truth may miss
    closures too: give ``of="truth"`` beside the prediction's rate, or ``of="gap"``.

    A clip without a closure in its scored frames is left out; `coverage` counts, as ``frames``, what the rate
    is a share of.

    Args:
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        threshold: Share of the truth's range, 0 to 1.
        count: ``"frames"``: the share of all frames of closures in which the mouth is closed; ``"closures"``:
            the share of closures in which it is closed in at least one frame.
        of: ``"prediction"``, ``"truth"``, or ``"gap"``: prediction minus truth, negative where the prediction
            closes less.
        pooling: ``"frames"``: the frames (or closures) of all sequences alike; ``"sequences"``: the mean of
            the sequences' rates.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    >>> import torch
    >>> motion = torch.zeros(4, 2, 3)
    >>> motion[:, 0, 1] = torch.tensor([1.0, 0.0, 0.1, 0.5])
    >>> bilabial_closure_rate(motion, motion, [(0, 1)], [(1, 4)]).item()  # closed in 2 of the 3 frames
    0.6666666666666666
    """

    leaves_out = "no closure lies in the frames that are scored"

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        threshold: float = 0.2,
        count: Counted = "frames",
        of: Subject = "prediction",
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("count", count, COUNTS)
        check_option("of", of, SUBJECTS)
        if not 0 <= threshold <= 1:
            raise ValueError(f"threshold is {threshold:g}; expected a share of the truth's opening range, 0 to 1")
        over = "all sequences" if pooling == "frames" else "each sequence, then mean over sequences"
        super().__init__(
            pairs,
            definition=f"share of {COUNTED_WORDS[count]}, {SUBJECT_WORDS[of]}; closed is an opening (mean distance "
            f"of {{pairs}}) up to the truth's smallest of the sequence plus {threshold:g} of its range; over {over} "
            "[1]",
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.threshold = threshold
        self.count: Counted = count
        self.of: Subject = of

    def clip_value(self, clip: Clip) -> Tensor:
        """The rate of one sequence, NaN if it has no closure."""
        predicted, true = self.openings(clip)
        if not clip.closures:
            return torch.full_like(true[0], torch.nan)
        low, high = true.aminmax()
        limit = low.lerp(high, self.threshold)  # exactly the widest opening at threshold 1
        bounds = torch.tensor(clip.closures, device=true.device)

        def rate(series: Tensor) -> Tensor:
            before = torch.cat([bounds.new_zeros(1), (series <= limit).cumsum(0)])
            hits = before[bounds[:, 1]] - before[bounds[:, 0]]  # closed frames of each closure
            found = hits.sum() if self.count == "frames" else (hits > 0).sum()
            return found.double() / self.clip_weight(clip)

        if self.of == "gap":
            return rate(predicted) - rate(true)
        return rate(predicted if self.of == "prediction" else true)

    def clip_weight(self, clip: Clip) -> int:
        """Frames in closures, or closures, whichever are counted."""
        return len(clip.closures) if self.count == "closures" else sum(end - start for start, end in clip.closures)

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        closures: Closures | None = None,
        offsets_from: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: Likewise.
            closures: Frames of the truth in which the mouth is known to close: a boolean mask (batch, frames),
                a run of true frames being one closure, or for each sequence a list of intervals (first frame,
                frame after the last) in order and without overlap. They must be given; frames that are not scored
                do not count.
            offsets_from: Neutral vertices that prediction and truth are offsets from; **None means that they
                are absolute vertices**.
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: As for `ComparisonMetric.update`.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `OpeningMetric.update`, and if the closures are missing or do not fit. Nothing is
                added then.
        """
        if closures is None:
            raise ValueError("closures= is missing; say in which frames the mouth is known to close")
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        clips = clips.with_templates(split_template(offsets_from, clips, "offsets_from"))
        self._add(with_closures(clips, closures, padded=truth.shape[-3], single=truth.ndim == 3))


def with_closures(clips: Clips, closures: Closures, *, padded: int, single: bool) -> Clips:
    """The sequences with their closures, as far as these lie in scored frames.

    Args:
        clips: The sequences.
        closures: Masks or intervals.
        padded: Frames of the truth with padding, which a mask must have too.
        single: Whether the caller gave one sequence without batch axis.

    Raises:
        ValueError: If a mask has another shape, or intervals are no pairs of whole numbers, empty, negative,
            out of order or overlapping; the message names the clip.
    """
    count = len(clips.clips)
    if isinstance(closures, Tensor):
        shape = (padded,) if single else (count, padded)
        if closures.dtype != torch.bool or closures.shape != shape:
            raise ValueError(
                f"closures must be a boolean mask of shape {shape} or lists of intervals, not "
                f"{closures.dtype} of shape {tuple(closures.shape)}"
            )
        given: list[object] = [_runs(row) for row in closures.reshape(count, padded).tolist()]
    else:
        given = [closures] if single else list(closures)
    if len(given) != count:
        raise ValueError(f"closures of {len(given)} sequences for {count}; give a list of intervals for each")
    found = (
        replace(clip, closures=_within(_checked(clip.name, some), clip.frames))
        for clip, some in zip(clips.clips, given, strict=True)
    )
    return replace(clips, clips=tuple(found))


def _checked(name: str, intervals: object) -> list[Interval]:
    """The intervals of one clip, after looking at each."""
    found: list[Interval] = []
    for pair in intervals if isinstance(intervals, Sequence) else [intervals]:
        if not isinstance(pair, Sequence) or [type(frame) for frame in pair] != [int, int]:
            raise ValueError(f"the closures of {name} must be a list of pairs of whole numbers (first frame, end)")
        found.append((pair[0], pair[1]))
    earlier = 0
    for start, end in found:
        if start < earlier or end <= start:
            raise ValueError(
                f"the closures of {name} hold the interval {(start, end)}; expected intervals that are not empty, in "
                "order and without overlap, each a first frame from 0 and the frame after the last"
            )
        earlier = end
    return found


def _within(intervals: list[Interval], frames: int) -> tuple[Interval, ...]:
    return tuple((start, min(end, frames)) for start, end in intervals if start < frames)


def _runs(mask: list[bool]) -> list[Interval]:
    """Runs of true values as intervals."""
    framed = [False, *mask, False]
    edges = [place for place in range(len(mask) + 1) if framed[place] != framed[place + 1]]
    return list(zip(edges[::2], edges[1::2], strict=True))


def bilabial_closure_rate(
    prediction: Tensor,
    truth: Tensor,
    pairs: LipPairsLike,
    closures: Closures,
    *,
    offsets_from: Tensor | None = None,
    threshold: float = 0.2,
    count: Counted = "frames",
    of: Subject = "prediction",
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Bilabial-closure rate: share of known closures in which the mouth is closed, see `BilabialClosureRate`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        closures: Boolean mask (batch, frames) or a list of intervals (first frame, end) for each sequence.
        offsets_from: Neutral vertices that prediction and truth are offsets from; None if they are absolute.
        threshold: Up to which share of the range of the truth's opening a mouth counts as closed.
        count: ``"frames"`` or ``"closures"``.
        of: ``"prediction"``, ``"truth"`` or ``"gap"``.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar, 0 to 1; a gap −1 to 1.

    Raises:
        ValueError: As `BilabialClosureRate.update`, and if no sequence has a closure.
    """
    metric = BilabialClosureRate(
        pairs,
        threshold=threshold,
        count=count,
        of=of,
        pooling=pooling,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(
        prediction,
        truth,
        closures=closures,
        offsets_from=offsets_from,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
