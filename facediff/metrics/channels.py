"""Metrics of motion in parameters: of expression, jaw and head as channels, and of people in a conversation.

Motion is (frames, channels, 1). A metric flattens the channels of its region, so that it takes vertices too; x and y
are prediction and truth in the formulas, both (frames, D).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Unpack, cast

import torch
from torch import Tensor

from facediff.metrics.base import (
    SIDE_WORDS,
    Clip,
    Clips,
    SequenceMetric,
    SequenceOptions,
    Side,
    SumsMetric,
    UpdateOptions,
    check_option,
    check_range,
    functional,
)
from facediff.metrics.mouth import correlation
from facediff.metrics.regions import RegionLike, as_region
from facediff.registry import metric


class ChannelMetric(SequenceMetric):
    """Base of metrics of channels.

    Args:
        region: channels that are looked at, a :class:`Region` or indices; None for all. By name, ``expression``,
            ``jaw``, ``head`` and ``eyes`` are groups of every space.
    """

    needs: ClassVar[tuple[str, ...]] = ("channels",)
    of_channels: ClassVar[bool] = True
    """Whether the metric reads channels where motion has a rig that decodes them."""
    option_needs: ClassVar[Mapping[str, str]] = {}
    """Further needs where an option is on."""

    def __init__(
        self, region: RegionLike | None = None, *, definition: str | None = None, **options: Unpack[SequenceOptions]
    ) -> None:
        super().__init__(region=region, definition=definition, **options)
        if self.region is None:  # "vertices" would be the wrong word
            self.definition = self.definition.replace("all vertices", "all channels")

    def flat(self, motion: Tensor) -> Tensor:
        """The region of a motion (frames, channels, dims) as (frames, D), float64."""
        channels = motion if self.indices is None else motion.index_select(1, self.indices)
        return channels.flatten(1).double()


class OneSideMetric(ChannelMetric):
    """Base of metrics of one side alone, or of its difference from the truth's; a subclass defines :meth:`of_motion`.

    Args:
        of: ``"prediction"``, ``"truth"`` or ``"gap"``, the prediction's minus the truth's.
    """

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        definition: str | None = None,
        of: Side = "prediction",
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("of", of, Side)
        words = (definition or self.words).replace("{side}", SIDE_WORDS[of])
        super().__init__(region, definition=words, **options)
        self.of: Side = of

    def of_motion(self, motion: Tensor) -> Tensor:
        """The score of one side (frames, D), a float64 scalar."""
        raise NotImplementedError

    def clip_value(self, clip: Clip) -> Tensor:
        """The score of one sequence."""
        sides = {"prediction": clip.prediction, "truth": clip.truth}
        scores = [self.of_motion(self.flat(sides[side])) for side in sides if self.of in (side, "gap")]
        return scores[0] - scores[1] if self.of == "gap" else scores[0]


@metric.register("channel_variance")
class ChannelVariance(OneSideMetric):
    """Var: how much channels vary over time, mean over channels of the population variance; DualTalk's table.

    Per sequence mean_d var_t x[t, d]; then the mean over sequences. In squares of the channels' unit; a good prediction
    has the truth's.

    >>> import torch
    >>> channel_variance(torch.tensor([0.0, 2.0])[:, None, None], torch.zeros(2, 1, 1)).item()
    1.0
    """

    words = "in each sequence the mean over {region} of the variance over time, {side}; mean over sequences [unit²]"

    def of_motion(self, motion: Tensor) -> Tensor:
        """The variance of one side."""
        return motion.var(0, correction=0).mean()


channel_variance = functional(ChannelVariance)


@metric.register("frame_pair_distance")
class FramePairDistance(OneSideMetric):
    """Div: how different frames are, mean distance of 100 random pairs of them; DualTalk's table.

    Per sequence mean over pairs of ‖x[a] − x[b]‖₂ with a and b drawn independently and evenly from its frames; then the
    mean over sequences. The same frames are drawn of every sequence of one length.

    >>> import torch
    >>> frame_pair_distance(torch.ones(9, 2, 1), torch.zeros(9, 2, 1)).item()
    0.0
    """

    words = (
        "in each sequence the mean distance over {region} of 100 pairs of frames drawn with the seed 0, {side}; mean "
        "over sequences [unit]"
    )

    def of_motion(self, motion: Tensor) -> Tensor:
        """The mean distance of one side."""
        random = torch.Generator().manual_seed(0)
        first, second = torch.randint(len(motion), (2, 100), generator=random).to(motion.device)
        return (motion[first] - motion[second]).norm(dim=1).mean()


frame_pair_distance = functional(FramePairDistance)


@metric.register("channel_dynamics_deviation")
class ChannelDynamicsDeviation(ChannelMetric):
    r"""PDD and JDD: by how much the spread of channels over time is off, 100 · mean_d \|std x_d − std y_d\|.

    With ``region=head`` it is UniLS's pose dynamics deviation, with ``region=jaw`` its jaw dynamics deviation (its
    inferencer's formula). The standard deviation is the population's, a choice; mean over sequences.

    >>> import torch
    >>> still, nodding = torch.zeros(2, 1, 1), torch.tensor([0.0, 0.5])[:, None, None]
    >>> channel_dynamics_deviation(still, nodding).item()
    25.0
    """

    higher_is_better = False
    words = (
        "in each sequence the mean over {region} of the difference between the standard deviations over time of "
        "prediction and truth, without sign, times 100; mean over sequences [unit]"
    )

    def clip_value(self, clip: Clip) -> Tensor:
        """The deviation of one sequence."""
        spread, true_spread = (self.flat(side).std(0, correction=0) for side in (clip.prediction, clip.truth))
        return 100 * (spread - true_spread).abs().mean()


channel_dynamics_deviation = functional(ChannelDynamicsDeviation)


@metric.register("step_distance")
class StepDistance(ChannelMetric):
    """STS: how different the steps from frame to frame are from the truth's, √(Σ (Δx − Δy)² / 0.1); DualTalk's table.

    The sum is over channels and steps, so that long sequences count more than short ones; mean over sequences.

    >>> import torch
    >>> round(step_distance(torch.zeros(2, 1, 1), torch.tensor([0.0, 1.0])[:, None, None]).item(), 6)
    3.162278
    """

    higher_is_better = False
    in_order = True
    words = (
        "in each sequence the root of the sum over steps and {region} of the squared difference of steps from frame to "
        "frame, over 0.1; mean over sequences [unit]"
    )

    def clip_value(self, clip: Clip) -> Tensor:
        """The distance of one sequence."""
        return ((self.flat(clip.prediction) - self.flat(clip.truth)).diff(dim=0).square().sum() / 0.1).sqrt()


step_distance = functional(StepDistance)


# Conversations: the motion of the partner is read too.


def attach_partners(clips: Clips, partner: Tensor | None, *, single: bool) -> Clips:
    """The sequences with their partners' motion, cut to the frames that are scored."""
    motions = clips.rows("partner", partner, single=single, ndim=4)
    for clip, motion in zip(clips.clips, motions, strict=True):
        if len(motion) < clip.frames or motion.shape[1:] != clip.truth.shape[1:]:
            raise ValueError(
                f"{clip.name}: the partner has the shape {tuple(motion.shape)}; expected that of the motion, "
                f"{tuple(clip.truth.shape)}"
            )
    scored = [motion[: clip.frames] for clip, motion in zip(clips.clips, motions, strict=True)]
    return clips.attach("partner", clips.finite("partner", scored))


@metric.register("residual_partner_correlation")
class ResidualPartnerCorrelation(ChannelMetric):
    r"""rPCC: how far the correlation with the partner's motion is from the truth's, \|r(y, q) − r(x, q)\|; DualTalk.

    r is Pearson's correlation of all frames and channels of one sequence, flattened, q the partner's motion; the mean
    over sequences is a choice. A prediction that does not vary has r = 0; a sequence is left out where the partner does
    not move.
    """

    higher_is_better = False
    needs = ("channels", "partner")
    leaves_out = "the partner does not move"
    words = (
        "in each sequence the difference, without sign, between the Pearson correlations of truth and prediction with "
        "the partner's motion, over all frames of {region}; mean over sequences; a sequence whose partner does not "
        "vary is left out [1]"
    )

    def clip_value(self, clip: Clip) -> Tensor:
        """The difference of one sequence, NaN where the partner does not vary."""
        partner = self.flat(cast(Tensor, clip.partner)).flatten()
        of_truth, of_prediction = (
            correlation(partner, self.flat(side).flatten()) for side in (clip.truth, clip.prediction)
        )
        return (of_truth - of_prediction).abs()

    def update(
        self, prediction: Tensor, truth: Tensor, *, partner: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences (batch, frames, channels, 1); ``partner`` is the other person's motion, as large."""
        self.add(attach_partners(self.align(prediction, truth, **batch), partner, single=truth.ndim == 3))


residual_partner_correlation = functional(ResidualPartnerCorrelation)


# Distances of distributions over all frames of all sequences.


@metric.register("frechet_distance")
class FrechetDistance(SumsMetric, ChannelMetric):
    r"""FD: Fréchet distance between the distributions of frames of prediction and truth, as Gaussians.

    \|μ_x − μ_y\|² + tr(Σ_x + Σ_y − 2 (Σ_x Σ_y)^½) over all frames of all sequences, Σ with n − 1 as NumPy's ``cov``; of
    expression, jaw and head apart in DualTalk's and the UniLS family's tables. With ``with_partner`` it is DualTalk's
    P-FD: a frame is the partner's followed by the person's own. Blind to time: motion in any order has the same score.

    Args:
        region: channels, a :class:`Region` or indices; the covariance is a state of known size.
        with_partner: look at both people of a conversation.
        dims: numbers of each point: 1 of channels, 3 of vertices.

    >>> import torch
    >>> metric = FrechetDistance([0])
    >>> truth = torch.tensor([0.0, 2.0])[:, None, None]
    >>> metric.update(truth + 3, truth)
    >>> metric.compute().item()
    9.0
    """

    higher_is_better = False
    option_needs: ClassVar[Mapping[str, str]] = {"with_partner": "partner"}

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        with_partner: bool = False,
        dims: int = 1,
        **options: Unpack[SequenceOptions],
    ) -> None:
        if region is None:
            raise ValueError("the Fréchet distance needs its channels; give a region, such as region=expression")
        frame = "the partner's frame followed by the person's own" if with_partner else "frames"
        definition = f"Fréchet distance between Gaussians of {frame}, over {{region}}, all sequences together [unit²]"
        region = as_region(region, "channels")
        size = region.count * dims * (2 if with_partner else 1)
        super().__init__(shape=(2, 1 + size, size), region=region, definition=definition, **options)
        self.with_partner = with_partner
        self.dims = dims

    def clip_weight(self, clip: Clip) -> int:
        """Its frames; the score is no mean over sequences."""
        return clip.frames

    def clip_sums(self, clip: Clip) -> Tensor:
        """Of either side, the sum of the frames and of their products."""
        sides = torch.stack([self.flat(side) for side in (clip.prediction, clip.truth)])
        if clip.partner is not None:
            sides = torch.cat([self.flat(clip.partner).expand(2, -1, -1), sides], 2)
        return torch.cat([sides.sum(1, keepdim=True), sides.mT @ sides], 1)

    def update(
        self, prediction: Tensor, truth: Tensor, *, partner: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences (batch, frames, channels, 1).

        With ``with_partner``, ``partner`` is the other person's motion, as large.
        """
        clips = self.align(prediction, truth, **batch)
        if clips.dims != self.dims:
            raise ValueError(f"a point of the motion has {clips.dims} numbers, the metric's have {self.dims}; set dims")
        if self.with_partner:
            clips = attach_partners(clips, partner, single=truth.ndim == 3)
        self.add(clips)

    def score(self, sums: Tensor) -> Tensor:
        """The distance; NaN of a single frame, which has no covariance."""
        frames = int(self.counts[0])
        if frames < 2:
            return torch.full_like(sums[0, 0, 0], torch.nan)
        means = sums[:, 0] / frames
        covariances = (sums[:, 1:] - frames * means[:, :, None] * means[:, None, :]) / (frames - 1)
        # tr (A B)^½ is the sum of the roots of the eigenvalues of A^½ B A^½, which is symmetric.
        values, vectors = torch.linalg.eigh(covariances[0])
        root = vectors * values.clamp_min(0).sqrt() @ vectors.T
        shared = torch.linalg.eigvalsh(root @ covariances[1] @ root).clamp_min(0).sqrt().sum()
        traces = covariances.diagonal(dim1=1, dim2=2).sum()
        distance = (means[0] - means[1]).square().sum() + traces - 2 * shared
        return distance.clamp_min(0)


frechet_distance = functional(FrechetDistance)


def cluster_centres(frames: Tensor, count: int, seed: int) -> Tensor:
    """k-means: at most ``count`` centres (k, D) of frames (frames, D), in any order.

    Our own, so that the metrics need no further library: k-means++ chooses the first centres with the seed, then
    Lloyd's two steps are repeated until no frame changes its centre, 300 times at most. Equal frames count as often as
    they occur; an empty cluster keeps its centre. There are fewer centres than asked for where there are fewer
    different frames.
    """
    points, weights = torch.unique(frames.cpu(), dim=0, return_counts=True)
    weights = weights.double()
    random = torch.Generator().manual_seed(seed)
    seeds = torch.multinomial(weights, 1, generator=random)
    while len(seeds) < min(count, len(points)):
        distances = (points[:, None] - points[seeds]).square().sum(-1).amin(1) * weights
        if not bool(distances.any()):
            break
        seeds = torch.cat([seeds, torch.multinomial(distances, 1, generator=random)])
    centres = points[seeds]
    labels = torch.full((len(points),), -1)
    for _ in range(300):
        nearest = nearest_centres(points, centres)
        if torch.equal(nearest, labels):
            break
        labels = nearest
        sums = torch.zeros_like(centres).index_add(0, labels, points * weights[:, None])
        sizes = torch.zeros(len(centres), dtype=torch.float64).index_add(0, labels, weights)
        centres = torch.where(sizes[:, None] > 0, sums / sizes.clamp_min(1)[:, None], centres)
    return centres


def nearest_centres(frames: Tensor, centres: Tensor) -> Tensor:
    """The number of the centre (k, D) that is nearest to each frame (frames, D); the first of equals."""
    rows = [torch.cdist(some, centres).argmin(1) for some in torch.split(frames, 4096)]
    return torch.cat(rows) if rows else torch.zeros(0, dtype=torch.int64)


@metric.register("shannon_index")
class ShannonIndex(ChannelMetric):
    """SID: how evenly a prediction visits the clusters of the truth's frames, entropy of their histogram in bits.

    k-means finds ``clusters`` centres of all the truth's frames, each predicted frame gets the label of the nearest,
    and the score is −Σ p log₂ p over the labels' shares p: 0 for a frozen face, log₂ k at most. Learning2Listen and
    DualTalk take k 40 for the expression, 10 for jaw and 10 for head, seed 0, and scikit-learn's k-means; ours is
    :func:`cluster_centres`, with other centres of the same kind. Compare with ``of="truth"``.

    **Memory grows with the number of frames**, which are kept in float64: 100 000 of 50 channels take 80 MB.

    Args:
        clusters: k.
        of: ``"prediction"`` or ``"truth"``, the side of the counted labels.

    >>> import torch
    >>> truth = torch.tensor([0.0, 1.0, 8.0, 9.0])[:, None, None]
    >>> shannon_index(truth, truth, clusters=2).item(), shannon_index(truth[:1].expand(4, 1, 1), truth).item()
    (1.0, 0.0)
    """

    predicted: list[Tensor]
    true: list[Tensor]
    width: Tensor

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        clusters: int = 40,
        of: Literal["prediction", "truth"] = "prediction",
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("of", of, Literal["prediction", "truth"])
        check_range("clusters", clusters, 1)
        definition = (
            f"entropy of the shares of {clusters} clusters of the truth's frames (k-means, seed 0) among the "
            f"frames {SIDE_WORDS[of]}, over {{region}}, all sequences together [bit]"
        )
        super().__init__(region, definition=definition, **options)
        self.clusters = clusters
        self.of = of
        # Flat, and never an empty list: torchmetrics gathers a process without data as one flat float32 tensor.
        self.add_state("predicted", [], dist_reduce_fx="cat")
        self.add_state("true", [], dist_reduce_fx="cat")
        self.add_state("width", torch.zeros((), dtype=torch.int64), dist_reduce_fx="max")
        self._begin()

    def _begin(self) -> None:
        for state in (self.predicted, self.true):
            state.append(torch.empty(0, dtype=torch.float64, device=self.width.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._begin()

    def clip_weight(self, clip: Clip) -> int:
        """Its frames; the score is no mean over sequences."""
        return clip.frames

    def clip_value(self, clip: Clip) -> Tensor:
        """Zero, which does not enter the score."""
        return torch.zeros((), dtype=torch.float64, device=clip.truth.device)

    def add(self, clips: Clips) -> None:
        """Check aligned sequences and keep their frames; nothing is kept where one is refused."""
        width = clips.dims * (clips.n_vertices if self.region is None else self.region.count)
        if int(self.width) not in (0, width):
            raise ValueError(f"frames of {width} numbers after others of {int(self.width)} cannot be compared")
        super().add(clips)
        for clip in clips.clips:
            self.width = torch.full_like(self.width, width)
            self.predicted.append(self.flat(clip.prediction).flatten())
            self.true.append(self.flat(clip.truth).flatten())
        self.latest = None

    def compute(self) -> Tensor:
        """The entropy over all frames so far, a float64 scalar."""
        if int(self.counts[1]) == 0:
            self.refuse_to_compute(0)
        predicted, true = (
            (torch.cat(state) if isinstance(state, list) else state).view(-1, int(self.width)).cpu()
            for state in (self.predicted, self.true)
        )
        centres = cluster_centres(true, self.clusters, seed=0)
        labels = nearest_centres(predicted if self.of == "prediction" else true, centres)
        shares = labels.bincount(minlength=len(centres)).double() / len(labels)
        return -torch.special.xlogy(shares, shares).sum() / torch.log(torch.tensor(2.0, dtype=torch.float64)) + 0.0


shannon_index = functional(ShannonIndex)


# Speaking and listening: the same metric on some frames of each sequence.

Moment = Literal["all", "speaking", "listening"]
"""The frames of a sequence that are scored."""


def split_frames(inputs: dict[str, Any], speaking: Sequence[Tensor] | Tensor, moment: Moment) -> dict[str, Any]:
    """A batch's inputs with only those frames of each sequence in which the person speaks, or listens.

    Args:
        inputs: ``prediction`` and ``truth`` (batch, frames, points, dims), with ``lengths``, and other inputs of a
            metric for each sequence; sequences that have no such frame are left out of all of them.
        speaking: for each sequence a mask (frames,), true where the person speaks.
        moment: ``"speaking"`` or ``"listening"``.

    Returns:
        The inputs, and under ``kept`` the numbers of the sequences that are left.
    """
    check_option("moment", moment, Literal["speaking", "listening"])
    prediction, truth = inputs["prediction"], inputs["truth"]
    if truth.ndim == 3:
        prediction, truth = prediction[None], truth[None]
    lengths = inputs.get("lengths")
    counts = [truth.shape[1]] * len(truth) if lengths is None else torch.as_tensor(lengths).reshape(-1).tolist()
    masks = []
    for clip, (mask, count) in enumerate(zip(speaking, counts, strict=True)):
        if mask.dtype != torch.bool or mask.ndim != 1 or len(mask) < count:
            raise ValueError(
                f"the mask of speaking frames of sequence {clip} has type {mask.dtype} and shape {tuple(mask.shape)}; "
                f"expected {count} booleans"
            )
        frame_mask = mask if moment == "speaking" else ~mask
        # Predictions may be shorter than the truth; a metric's own rule no longer applies to frames that are picked.
        masks.append(frame_mask[: min(count, prediction.shape[1])].to(truth.device))
    numbers = [clip for clip, mask in enumerate(masks) if bool(mask.any())]
    width = max((int(masks[clip].sum()) for clip in numbers), default=1)

    def picked(motion: Tensor) -> Tensor:
        rows = motion.new_zeros(len(numbers), width, *motion.shape[2:])
        for row, clip in zip(rows, numbers, strict=True):
            frames = motion[clip, : len(masks[clip])][masks[clip]]
            row[: len(frames)] = frames
        return rows

    result = {**inputs, "prediction": picked(prediction), "truth": picked(truth), "kept": numbers}
    result["lengths"] = [int(masks[clip].sum()) for clip in numbers]
    for name, value in inputs.items():
        per_sequence = name in ("template", "offsets_from") and isinstance(value, Tensor) and value.ndim == 3
        if per_sequence or name in ("clip_names", "identities"):
            result[name] = value[numbers] if isinstance(value, Tensor) else [value[clip] for clip in numbers]
        elif name == "partner":
            result[name] = picked(value if value.ndim == 4 else value[None])
    return result
