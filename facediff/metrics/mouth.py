"""The opening of the mouth and the speed of the lips: how far they are from the truth, and whether they follow it.

The opening of a frame is o[t] = mean over named pairs (a, b) of inner-lip vertices of ‖x[t, a] − x[t, b]‖₂. It needs
absolute vertices: of offsets alone the distance means nothing. So motion is taken as absolute unless ``offsets_from=``
gives the neutral vertices that it is offset from. (FDD's ``template=`` is the other way round; the two have different
names so that a :class:`torchmetrics.MetricCollection` can pass both.)
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    SIDE_WORDS,
    Clip,
    Clips,
    LipMetric,
    Pooling,
    SequenceMetric,
    SequenceOptions,
    Side,
    UpdateOptions,
    check_option,
    check_range,
    functional,
)
from facediff.metrics.one_pass import frames_per_step, squared_norm
from facediff.metrics.regions import LipPairs, LipPairsLike
from facediff.registry import metric


def opening(motion: Tensor, offsets_from: Tensor | None, pairs: Tensor) -> Tensor:
    """How far the mouth is open in each frame: the mean distance of the lip pairs, (frames,) float64.

    ``motion`` (frames, vertices, 3) is absolute vertices, or offsets from ``offsets_from`` (vertices, 3); ``pairs`` are
    (pairs, 2) int64.
    """
    gap = motion.index_select(1, pairs[:, 0]).double() - motion.index_select(1, pairs[:, 1]).double()
    if offsets_from is not None:
        gap = gap + (offsets_from.index_select(0, pairs[:, 0]).double() - offsets_from.index_select(0, pairs[:, 1]))
    return squared_norm(gap).sqrt().mean(1)


def speed(motion: Tensor, indices: Tensor) -> Tensor:
    """How far the vertices move from each frame to the next: m[t] = mean_v ‖x[t, v] − x[t − 1, v]‖₂, (frames − 1,).

    ``motion`` is (frames, vertices, 3), where a template would cancel; ``indices`` belong to a region.
    """
    frames = len(motion)
    out = torch.zeros(frames - 1, dtype=torch.float64, device=motion.device)
    step = frames_per_step(motion, len(indices))
    for start in range(0, frames - 1, step):
        some = motion[start : start + step + 1].index_select(1, indices).double()
        out[start : start + step] = squared_norm(some[1:] - some[:-1]).sqrt().mean(1)
    return out


def correlation(reference: Tensor, values: Tensor) -> Tensor:
    """Pearson's correlation coefficient of two series of equal length.

    0 where ``values`` does not vary, NaN where ``reference``, which it should follow, does not. A series varies if its
    range exceeds 1e-12 of its largest absolute value, which rounding alone does not reach.
    """
    if len(reference) < 2:
        return torch.full((), torch.nan, dtype=torch.float64, device=reference.device)
    first, second = reference - reference.mean(), values - values.mean()
    scale = (first.square().sum() * second.square().sum()).sqrt()
    coefficient = ((first * second).sum() / scale).clamp(-1, 1)
    return torch.where(_steady(reference), torch.nan, torch.where(_steady(values), 0.0, coefficient))


def _steady(series: Tensor) -> Tensor:
    low, high = series.aminmax()
    return high - low <= 1e-12 * torch.maximum(high.abs(), low.abs())


# The opening against the truth's.


class OpeningMetric(SequenceMetric):
    """Base of metrics that read the opening of the mouth.

    Args:
        pairs: inner-lip vertex pairs, :class:`LipPairs` or pairs of indices.
        definition: the metric in words, ``words`` if None; ``{pairs}`` becomes the pairs' name, number and hash.
    """

    needs: ClassVar[tuple[str, ...]] = ("lip_pairs",)
    pairs_name: ClassVar[str] = "lip pairs"

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        definition: str | None = None,
        pooling: Pooling = "sequences",
        **options: Unpack[SequenceOptions],
    ) -> None:
        lip_pairs = pairs if isinstance(pairs, LipPairs) else LipPairs.from_pairs(self.pairs_name, pairs)
        definition = (definition or self.words).replace("{pairs}", str(lip_pairs))
        super().__init__(definition=definition, pooling=pooling, **options)
        self.pairs = lip_pairs
        self.pair_indices: Tensor
        self.register_buffer("pair_indices", lip_pairs.tensor(), persistent=False)

    @property
    def over(self) -> LipPairs:
        """The pairs of vertices that the metric reads."""
        return self.pairs

    def openings(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """The mouth's opening in each frame of prediction and truth, (frames,) float64 each."""
        predicted, true = (
            opening(motion, clip.template, self.pair_indices) for motion in (clip.prediction, clip.truth)
        )
        return predicted, true

    def update(
        self, prediction: Tensor, truth: Tensor, *, offsets_from: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences; see :meth:`SequenceMetric.update`.

        Prediction and truth are offsets from the neutral vertices ``offsets_from``, (batch, vertices, 3) or (vertices,
        3) for all sequences. **None means that they are absolute vertices**; offsets without it give a meaningless
        number.
        """
        self.add(self.align(prediction, truth, **batch).attach_templates(offsets_from, "offsets_from"))


@metric.register("mouth_opening_difference")
class MouthOpeningDifference(OpeningMetric):
    r"""Mouth-opening difference (MOD): how far the openings of prediction and truth are apart.

    The mean over frames of \|o_g[t] − o_p[t]\|, in the vertices' unit.

    The definition is a choice. DiffPoseTalk's paper brought the name up and released no formula; other
    projects of that name compute the root mean square over frames of the difference between two landmarks
    (MSMD, by its authors' account), or the mean instead of the maximum of the lip vertex error (ARTalk, by its
    author's account). The numbers cannot be compared.

    >>> import torch
    >>> metric = MouthOpeningDifference([(0, 1)])
    >>> closed, ajar = torch.zeros(5, 2, 3), torch.zeros(5, 2, 3)
    >>> ajar[:, 0, 1] = 0.25
    >>> metric.update(closed, ajar)
    >>> metric.compute().item()
    0.25
    """

    higher_is_better = False

    def __init__(self, pairs: LipPairsLike, *, pooling: Pooling = "frames", **options: Unpack[SequenceOptions]) -> None:
        definition = (
            "in each frame the difference between the openings of the mouth, an opening being the mean "
            "distance of {pairs}; {pooling} [unit]"
        )
        super().__init__(pairs, definition=definition, pooling=pooling, **options)

    def clip_value(self, clip: Clip) -> Tensor:
        """The difference of one sequence, mean over its frames."""
        predicted, true = self.openings(clip)
        return (predicted - true).abs().mean()


mouth_opening_difference = functional(MouthOpeningDifference)


_RULE = "a prediction that does not vary counts 0, a sequence whose truth does not vary is left out"


@metric.register("lip_opening_correlation")
class LipOpeningCorrelation(OpeningMetric):
    """Lip PCC of the opening: does the mouth open when the truth's does, by any amount?

    Per sequence Pearson's correlation over frames between o_g and o_p, the openings of the mouth (see
    :class:`MouthOpeningDifference`); then the mean over sequences. From −1 to 1, without unit; blind to the
    size of the movement and to a constant gap.

    A prediction that does not vary counts 0. A truth that does not vary, as in a clip of one frame, cannot be
    followed: the sequence is left out and counted by :meth:`coverage`. Both are choices, as is the mean over sequences.

    >>> import torch
    >>> truth = torch.tensor([0.0, 1.0, 0.0, 2.0])[:, None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    >>> lip_opening_correlation(0.5 * truth, truth, [(0, 1)]).item()
    1.0
    """

    higher_is_better = True
    leaves_out = "the opening of the truth does not vary"
    words = (
        "in each sequence the Pearson correlation over frames between the openings of the mouth, an opening being the "
        f"mean distance of {{pairs}}; mean over sequences; {_RULE} [1]"
    )

    def __init__(self, pairs: LipPairsLike, **options: Unpack[SequenceOptions]) -> None:
        super().__init__(pairs, **options)

    def clip_value(self, clip: Clip) -> Tensor:
        """The correlation of one sequence, NaN if the truth does not vary."""
        predicted, true = self.openings(clip)
        return correlation(true, predicted)


lip_opening_correlation = functional(LipOpeningCorrelation)


@metric.register("lip_speed_correlation")
class LipSpeedCorrelation(LipMetric):
    """Lip PCC of the speed: do the lips move fast when the truth's do?

    With m[t] = mean_{v∈M} ‖x[t, v] − x[t − 1, v]‖₂, t from the second frame on, Pearson's correlation
    over frames between m_g and m_p in each sequence; then the mean over sequences. From −1 to 1, without unit.
    A template cancels. A prediction that does not vary counts 0; where the truth does not vary, or has fewer
    than three frames, the sequence is left out and counted by :meth:`coverage`. The definition is ours.
    """

    higher_is_better = True
    in_order = True
    leaves_out = "the speed of the truth's lips does not vary"
    words = (
        "in each sequence the Pearson correlation over frames between the mean speeds of {region}; mean over "
        f"sequences; {_RULE} [1]"
    )

    def clip_value(self, clip: Clip) -> Tensor:
        """The correlation of one sequence, NaN if the truth's speed does not vary."""
        return correlation(speed(clip.truth, self.indices), speed(clip.prediction, self.indices))


lip_speed_correlation = functional(LipSpeedCorrelation)


# Whether the mouth closes where speech has it closed.

Interval = tuple[int, int]
Closures = Tensor | Sequence[Sequence[Interval]] | Sequence[Interval]
"""Known closures: a boolean mask (batch, frames), or for each sequence a list of intervals (first frame, frame
after the last). For one sequence without batch axis a mask (frames,) or its list of intervals."""

Counted = Literal["frames", "closures"]
"""The unit that a closure rate counts."""

COUNTED_WORDS: dict[Counted, str] = {
    "frames": "the frames of known closures in which the mouth is closed",
    "closures": "the known closures in which the mouth is closed in at least one frame",
}


@metric.register("bilabial_closure_rate")
class BilabialClosureRate(OpeningMetric):
    """Bilabial-closure rate: how often the mouth is closed where speech has it closed (p, b, m).

    The known closures come with each clip, usually from aligned phonemes. With o[t] the opening of the mouth
    (see :class:`MouthOpeningDifference`) and o_g the truth's, a frame is closed if

        o[t] ≤ min_t o_g + threshold · (max_t o_g − min_t o_g).

    The limit is thus a share of the range of the *truth's* opening in the same clip: it does not depend on
    the unit or on the gap that a mesh keeps between closed lips, and the truth is always closed somewhere.
    Definition and default threshold are choices; there is no usual formula. Captured truth may miss
    closures too: give ``of="truth"`` next to the prediction's rate, or ``of="gap"``. From 0 to 1, a gap from −1 to 1.

    A clip without a closure in its scored frames is left out; :meth:`coverage` counts its closures or
    frames as ``frames``.

    Args:
        threshold: share of the truth's range up to which a mouth counts as closed, 0 to 1.
        count: ``"frames"``: the share of all frames of closures in which the mouth is closed; ``"closures"``:
            the share of closures in which it is closed in at least one frame.
        of: ``"prediction"``, ``"truth"``, or ``"gap"``: prediction minus truth, negative where the prediction
            closes less.
        pooling: ``"frames"``: the frames (or closures) of all sequences alike; ``"sequences"``: the mean of
            the sequences' rates.

    >>> import torch
    >>> motion = torch.zeros(4, 2, 3)
    >>> motion[:, 0, 1] = torch.tensor([1.0, 0.0, 0.1, 0.5])
    >>> bilabial_closure_rate(motion, motion, [(0, 1)], [(1, 4)]).item()  # closed in 2 of the 3 frames
    0.6666666666666666
    """

    leaves_out = "no closure lies in the frames that are scored"
    needs: ClassVar[tuple[str, ...]] = ("lip_pairs", "closures")

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        threshold: float = 0.2,
        count: Counted = "frames",
        of: Side = "prediction",
        pooling: Pooling = "frames",
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("count", count, Counted)
        check_option("of", of, Side)
        check_range("threshold", threshold, 0, 1)
        over = "all sequences" if pooling == "frames" else "each sequence, then mean over sequences"
        definition = (
            f"share of {COUNTED_WORDS[count]}, {SIDE_WORDS[of]}; closed is an opening (mean distance of {{pairs}}) up "
            f"to the truth's smallest of the sequence plus {threshold:g} of its range; over {over} [1]"
        )
        super().__init__(pairs, definition=definition, pooling=pooling, **options)
        self.threshold = threshold
        self.count: Counted = count
        self.of: Side = of

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
            closed = hits.sum() if self.count == "frames" else (hits > 0).sum()
            return closed.double() / self.clip_weight(clip)

        rates = {"prediction": rate(predicted), "truth": rate(true)}
        return rates["prediction"] - rates["truth"] if self.of == "gap" else rates[self.of]

    def clip_weight(self, clip: Clip) -> int:
        """Frames in closures or closures, by the unit."""
        return len(clip.closures) if self.count == "closures" else sum(end - start for start, end in clip.closures)

    def update(  # type: ignore[override]  # closures must be given
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        closures: Closures,
        offsets_from: Tensor | None = None,
        **batch: Unpack[UpdateOptions],
    ) -> None:
        """Add a batch of sequences; see :meth:`OpeningMetric.update`.

        ``closures`` are the frames of the truth in which the mouth is known to close: a boolean mask (batch, frames), a
        run of true frames being one closure, or for each sequence a list of intervals (first frame, frame after the
        last) in order and without overlap. Frames that are not scored do not count.
        """
        clips = self.align(prediction, truth, **batch).attach_templates(offsets_from, "offsets_from")
        self.add(_attach_closures(clips, closures, padded=truth.shape[-3], single=truth.ndim == 3))


bilabial_closure_rate = functional(BilabialClosureRate, positional=["closures"])


def _attach_closures(clips: Clips, closures: Closures, *, padded: int, single: bool) -> Clips:
    """The sequences with their closures, as far as these lie in scored frames; a mask has as many as are padded."""
    if isinstance(closures, Tensor):
        by_clip: list[Any] = [_runs(row) for row in closures.reshape(-1, closures.shape[-1]).tolist()]
        fits = closures.dtype == torch.bool and closures.shape[-1] == padded
    else:
        by_clip, fits = [closures] if single else list(closures), True
    if not fits or len(by_clip) != len(clips.clips):
        raise ValueError(
            f"closures of {len(by_clip)} sequences; expected, for each of {len(clips.clips)}, {padded} booleans or a "
            "list of intervals"
        )
    scored = []
    for clip, intervals in zip(clips.clips, by_clip, strict=True):
        ends = [0, *(operator.index(frame) for pair in intervals for frame in pair)]
        bounds = zip(ends[:-1:2], ends[1::2], ends[2::2], strict=True)
        if any(start < before or end <= start for before, start, end in bounds):
            raise ValueError(
                f"the closures of {clip.name} are {list(intervals)}; expected intervals that are not empty, in order "
                "and without overlap, each a first frame from 0 and the frame after the last"
            )
        scored.append(tuple((start, min(end, clip.frames)) for start, end in intervals if start < clip.frames))
    return clips.attach("closures", scored)


def _runs(row: Sequence[bool]) -> list[Interval]:
    """Runs of true values as intervals."""
    framed = [False, *row, False]
    edges = [frame for frame in range(len(row) + 1) if framed[frame] != framed[frame + 1]]
    return list(zip(edges[::2], edges[1::2], strict=True))
