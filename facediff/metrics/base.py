"""The base of all metrics: options, aligned sequences, summed states, and the functional form of a class."""

from __future__ import annotations

import hashlib
import inspect
import math
import os
import re
import sys
import typing
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Literal, NoReturn, Self, TypedDict, Unpack, get_args

import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.errors import NotFiniteError, choices
from facediff.metrics.regions import LipPairs, Region, RegionLike, as_region

# Options: the words that distinguish one definition of a metric from another.

Reduction = Literal["mean", "max"]
"""How the vertices of one frame become one number."""

Pooling = Literal["frames", "sequences"]
"""All frames of all sequences alike, or the mean of the sequences' means."""

LengthRule = Literal["min", "error", "prediction"]
"""What to do where prediction and truth differ in length: cut both to the shorter; refuse; or cut the
prediction only and refuse a prediction that is shorter than the truth."""

Sign = Literal["signed", "absolute"]
"""Whether a deviation keeps its sign, so that sequences can cancel, or is made positive in each sequence."""

Side = Literal["prediction", "truth", "gap"]
"""The prediction's score, the truth's for comparison, or the prediction's minus the truth's."""

POOLING_WORDS: dict[Pooling, str] = {
    "frames": "mean over the frames of all sequences",
    "sequences": "mean over the frames of each sequence, then mean over sequences",
}
LENGTH_WORDS: dict[LengthRule, str] = {
    "min": "prediction and truth are both cut to the shorter of the two",
    "error": "prediction and truth must have the same number of frames",
    "prediction": "the prediction is cut to the truth; a shorter prediction is an error",
}
SIDE_WORDS: dict[Side, str] = {
    "prediction": "of the prediction",
    "truth": "of the truth",
    "gap": "of the prediction minus that of the truth",
}


def check_option(name: str, value: object, allowed: Any) -> None:  # noqa: ANN401 - a Literal has no type of its own
    """Refuse a value that is not among the known ones, a ``Literal`` type or strings.

    >>> check_option("pooling", "frame", Pooling)
    Traceback (most recent call last):
    ...
    ValueError: unknown pooling 'frame': did you mean "frames"? known are frames, sequences
    """
    names = get_args(allowed) or tuple(allowed)
    if value not in names:
        raise ValueError(f"unknown {name} {value!r}: {choices(str(value), names)}")


def check_range(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Refuse a number below ``low`` or above ``high``, infinity and NaN.

    >>> check_range("threshold", 1.5, 0, 1)
    Traceback (most recent call last):
    ...
    ValueError: threshold is 1.5; expected 0 to 1
    """
    if not low <= value <= high or value == math.inf:
        expected = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
        raise ValueError(f"{name} is {value:g}; expected {expected}")


def whole_numbers(name: str, values: Tensor | Sequence[int], count: int, limit: int) -> list[int]:
    """One whole number from 0 to ``limit`` for each of ``count`` sequences."""
    numbers = torch.as_tensor(values)
    integral = not numbers.is_floating_point() and numbers.dtype != torch.bool
    if numbers.numel() != count or (count and not (integral and numbers.min() >= 0 and numbers.max() <= limit)):
        raise ValueError(f"{name} must be {count} whole numbers from 0 to {limit}, one for each sequence")
    return list(map(int, numbers.flatten().tolist()))


# From padded batches to pairs of sequences that can be compared frame by frame.

Lengths = Tensor | Sequence[int] | int
"""Valid frames of each sequence, (batch,) integers, or a boolean mask of them (batch, frames)."""


@dataclass(frozen=True)
class Clip:
    """One sequence to score, with what some metrics read in addition to it.

    Args:
        name: what messages call the sequence.
        prediction: (frames, vertices, 3), a view; (frames, samples, vertices, 3) where there are several.
        truth: (frames, vertices, 3), a view; the prediction itself where a metric has no truth.
        template: neutral vertices (vertices, 3), as the metric reads them.
        speech: intensity of the speech in each frame (frames,), float64; empty if none was given.
        closures: closures of the mouth, each a first frame and the frame after the last.
        identity: number of the identity.
        partner: (frames, channels, dims), a view: the motion of the other person in a conversation.
    """

    name: str
    prediction: Tensor
    truth: Tensor
    template: Tensor | None = None
    speech: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.float64))
    closures: tuple[tuple[int, int], ...] = ()
    identity: int = 0
    partner: Tensor | None = None

    @property
    def frames(self) -> int:
        """How many frames are scored."""
        return len(self.truth)


@dataclass(frozen=True)
class Clips:
    """The sequences of one batch, and how many frames the length rule cut from either side."""

    clips: tuple[Clip, ...]
    cut_prediction: int
    cut_truth: int
    n_vertices: int
    dims: int = 3

    def attach(self, name: str, values: Sequence[Any]) -> Clips:
        """The same sequences with one value each in the field ``name``."""
        pairs = zip(self.clips, values, strict=True)
        return replace(self, clips=tuple(replace(clip, **{name: value}) for clip, value in pairs))

    def attach_templates(self, template: Tensor | None, name: str = "template") -> Clips:
        """The same sequences with their neutral vertices: (batch, vertices, 3), or (vertices, 3) for all sequences."""
        if template is None:
            return self
        batch, vertices, dims = len(self.clips), self.n_vertices, self.dims
        if template.shape not in ((batch, vertices, dims), (vertices, dims)):
            raise ValueError(
                f"{name} has shape {tuple(template.shape)}; expected {(batch, vertices, dims)} or {(vertices, dims)}"
            )
        templates = list(template.detach().expand(batch, vertices, dims))
        return self.attach("template", self.finite("template", templates))

    def rows(self, name: str, values: Tensor | None, *, single: bool, ndim: int) -> list[Tensor]:
        """Further values of each sequence, such as its speech."""
        rows = None if values is None else values.detach()[None] if single else values.detach()
        if rows is None or rows.ndim != ndim or len(rows) != len(self.clips) or not rows.is_floating_point():
            shape = "missing" if values is None else f"{values.dtype} of shape {tuple(values.shape)}"
            raise ValueError(
                f"{name} is {shape}; expected numbers with a point, for each of {len(self.clips)} sequences"
            )
        return list(rows)

    def finite(self, name: str, values: Sequence[Tensor]) -> Sequence[Tensor]:
        """The same values of each sequence; NaN and infinity among them are refused."""
        for clip, value in zip(self.clips, values, strict=True):
            if not bool(value.isfinite().all()):
                raise NotFiniteError(f"the {name} of {clip.name} holds NaN or infinity; repair or omit this clip")
        return values

    def check_finite(self) -> None:
        """Refuse NaN and infinity in the frames that are scored."""
        sides = [
            (clip.name, side, motion)
            for clip in self.clips
            for side, motion in (("truth", clip.truth), ("prediction", clip.prediction))
            if side == "prediction" or motion is not clip.prediction
        ]
        if not sides:
            return
        # A sum is NaN or infinite if any term is, and costs a tenth of looking at every value. It can also
        # overflow by itself, so suspicion is followed by the exact test. One transfer for the whole batch.
        half = (torch.float16, torch.bfloat16)
        sums = torch.stack([m.sum(dtype=torch.float32 if m.dtype in half else None).double() for _, _, m in sides])
        for (name, side, motion), finite in zip(sides, sums.isfinite().tolist(), strict=True):
            if not finite and not bool(motion.isfinite().all()):
                number = (~motion.isfinite()).flatten(1).any(1).nonzero()[0].item()
                raise NotFiniteError(
                    f"the {side} of {name} holds NaN or infinity, first in frame {number}; "
                    "a score over it would mean nothing: repair or omit this clip"
                )


def align(
    prediction: Tensor,
    truth: Tensor,
    *,
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
    rule: LengthRule = "min",
) -> Clips:
    """Remove padding and bring each prediction and its truth to one length.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3), floating point.
        truth: of the same shape, but for its padded number of frames.
        lengths: valid frames of the truth, and of the prediction unless ``prediction_lengths`` is given.
            Without it every frame of either tensor is valid.
        prediction_lengths: valid frames of the prediction. Needed in addition to ``lengths`` if the two tensors
            differ in their padded number of frames.
        clip_names: one name per sequence, for messages.
        rule: what to do where the lengths differ.

    Raises:
        ValueError: if shapes, types or lengths do not fit, a clip has no frame, or the rule refuses the lengths.
    """
    prediction, truth = prediction.detach(), truth.detach()  # scores are read, not optimised: keep no graph
    single = truth.ndim == 3
    axes = [(motion.ndim, *motion.shape[:-3], *motion.shape[-2:]) for motion in (prediction, truth)]  # all but frames
    floating = prediction.is_floating_point() and truth.is_floating_point()
    if (
        axes[0] != axes[1]
        or truth.ndim not in (3, 4)
        or truth.shape[-1] not in (1, 3)
        or not (truth.shape[-2] and floating)
    ):
        raise ValueError(
            f"the prediction is {prediction.dtype} of shape {tuple(prediction.shape)}, the truth {truth.dtype} of "
            f"{tuple(truth.shape)}; both must be floating-point (batch, frames, vertices, 3) or (frames, vertices, 3), "
            "or so with 1 for channels, and agree in batch and vertices"
        )
    if single:
        prediction, truth = prediction[None], truth[None]
    batch = len(truth)
    if prediction.shape[1] != truth.shape[1] and lengths is not None and prediction_lengths is None:
        raise ValueError(
            f"prediction and truth are padded to {prediction.shape[1]} and {truth.shape[1]} frames, "
            "so `lengths` cannot hold for both; give `prediction_lengths` too"
        )
    if clip_names is None:
        names = ["the clip"] if single else [f"clip {row} of the batch" for row in range(batch)]
    else:
        names = [clip_names] if isinstance(clip_names, str) else list(clip_names)
    valid = _valid_frames("lengths", lengths, truth)
    effective_lengths = prediction_lengths if prediction_lengths is not None else lengths
    predicted = _valid_frames("prediction_lengths", effective_lengths, prediction)
    clips, cut_prediction, cut_truth = [], 0, 0
    for row, (name, true_frames, predicted_frames) in enumerate(zip(names, valid, predicted, strict=True)):
        refused = predicted_frames < true_frames if rule == "prediction" else predicted_frames != true_frames
        frames = min(predicted_frames, true_frames)
        if frames == 0 or (rule != "min" and refused):
            problem = f"the length rule {rule!r} refuses this" if frames else "no frame is left to score"
            raise ValueError(
                f"{name}: the prediction has {predicted_frames} frames, the truth {true_frames}; {problem}. Predict "
                "all frames, choose a rule that cuts, or omit the clip"
            )
        cut_prediction += predicted_frames - frames
        cut_truth += true_frames - frames
        clips.append(Clip(name, prediction[row, :frames], truth[row, :frames]))
    return Clips(tuple(clips), cut_prediction, cut_truth, truth.shape[2], truth.shape[3])


def _valid_frames(name: str, lengths: Lengths | None, motion: Tensor) -> list[int]:
    """Valid frames of each sequence as plain integers, checked against the padded motion."""
    batch, padded = motion.shape[:2]
    if lengths is None:
        return [padded] * batch
    values = torch.as_tensor(lengths)
    if values.dtype == torch.bool:
        mask = values.reshape(-1, values.shape[-1]) if values.ndim else values
        values = mask.sum(-1)
        fits = mask.shape == (batch, padded)
        if not fits or not torch.equal(mask, torch.arange(padded, device=mask.device) < values[:, None]):
            raise ValueError(
                f"the mask {name} of shape {tuple(mask.shape)} must be {(batch, padded)}, true from the first frame "
                "on, without gaps"
            )
    return whole_numbers(name, values, batch, padded)


# The classes from which metrics are derived.


class ProcessOptions(TypedDict, total=False):
    """Options of every metric; see :class:`ExactMetric`."""

    sync_on_compute: bool
    process_group: Any


class FiniteOptions(ProcessOptions, total=False):
    """Options of every metric of sequences; see :class:`SequenceMetric`."""

    check_finite: bool


class SequenceOptions(FiniteOptions, total=False):
    """Options of every metric that compares sequences with their truth; see :class:`SequenceMetric`."""

    length_rule: LengthRule


class UpdateOptions(TypedDict, total=False):
    """Options of every :meth:`update` in addition to motion; see :meth:`SequenceMetric.update`."""

    lengths: Lengths | None
    prediction_lengths: Lengths | None
    clip_names: Sequence[str] | None


def _full_signature(cls: type, name: str) -> inspect.Signature:
    """A method's signature in which ``**options: Unpack[…]`` is written out, with the defaults of the base classes."""
    inherited: dict[str, inspect.Parameter] = {}
    bases = [vars(base)[name] for base in cls.__mro__[1:] if issubclass(base, ExactMetric) and name in vars(base)]
    for source in (*bases, align):
        inherited |= {
            key: parameter for key, parameter in inspect.signature(source).parameters.items() if key not in inherited
        }
    signature = inspect.signature(vars(cls)[name])
    written: list[inspect.Parameter] = []
    for parameter in signature.parameters.values():
        packed = vars(sys.modules[cls.__module__]).get(str(parameter.annotation).removeprefix("Unpack[").rstrip("]"))
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD or packed is None:
            written.append(parameter)
        else:
            written += [inherited[key] for key in inherited if key in packed.__annotations__]
    return signature.replace(parameters=written)


Inferred = dict[str, Callable[[Mapping[str, Any]], Any]]


class ExactMetric(Metric):
    """A metric that describes its definition in words and keeps its sums in float64.

    Args:
        definition: the metric in plain words, with its options.
        sync_on_compute: whether :meth:`compute` reduces the states over processes.
        process_group: over which processes; all if None.
        **kwargs: for :class:`torchmetrics.Metric`.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    """Needs of a metric that is chosen by name, keys of :data:`facediff.metrics.NEEDS`."""

    inferred: ClassVar[Inferred] = {}
    """Constructor arguments that the functional form reads from the batch instead of being given them."""

    full_state_update = False
    is_differentiable = False
    _arguments: tuple[tuple[Any, ...], dict[str, Any]] = ((), {})

    def __new__(cls, *arguments: Any, **options: Any) -> Self:  # noqa: ANN401
        """Keep the arguments, by which a collection tells metrics apart."""
        metric = super().__new__(cls)
        metric.__dict__["_arguments"] = arguments, options
        return metric

    def __init__(
        self,
        *,
        definition: str,
        sync_on_compute: bool = True,
        process_group: Any = None,  # noqa: ANN401 - as torchmetrics has it
        **kwargs: object,
    ) -> None:
        super().__init__(sync_on_compute=sync_on_compute, process_group=process_group, **kwargs)
        self.definition = definition
        # A MetricCollection merges metrics of which all states have the same names and nearly the same values after the
        # first batch: a signed and an absolute deviation, metres and millimetres of a perfect one. The name of a state
        # tells metrics apart that differ in an argument.
        positional, named = self._arguments
        parameters = list(inspect.signature(type(self).__init__).parameters.values())[1:]
        names = [parameter.name for parameter in parameters]
        stated = dict(zip(names, positional, strict=False)) | named
        defaults = {each.name: each.default for each in parameters if each.default is not inspect.Parameter.empty}
        arguments = {name: _identity(value) for name, value in sorted({**defaults, **stated}.items())}
        described = f"{type(self).__module__}.{type(self).__qualname__}: {definition}; {arguments}"
        mark = hashlib.sha256(described.encode()).hexdigest()[:16]
        self.add_state(f"definition_{mark}", torch.zeros(1, dtype=torch.int64), dist_reduce_fx="sum")

    def __init_subclass__(cls, **kwargs: object) -> None:
        """Write the options of ``**options`` and ``**batch`` out in the signatures that people and tools see."""
        super().__init_subclass__(**kwargs)
        for name in vars(cls).keys() & {"__init__", "update"}:
            vars(cls)[name].__signature__ = _full_signature(cls, name)

    def describe(self) -> str:
        """The metric's definition in plain words."""
        return self.definition

    def leave_synchronised_state(self) -> None:
        """To be called before :meth:`compute` raises: torchmetrics would keep the states of all processes."""
        if self._is_synced:
            self.unsync()

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> Self:
        """Follow moves to another device but keep float64: ``.to(torch.bfloat16)`` would ruin the sums."""

        def move_only(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return moved if moved.dtype == tensor.dtype else tensor.to(moved.device)

        super()._apply(move_only, exclude_state)
        return self


def _identity(value: object) -> object:
    """What tells a constructor's argument apart: its content as far as it is plain data, or the object itself."""
    if isinstance(value, Tensor):
        content = value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
        return "tensor", value.dtype, tuple(value.shape), hashlib.sha256(content).hexdigest()
    if isinstance(value, Mapping):
        return {str(name): _identity(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [_identity(entry) for entry in value]
    if is_dataclass(value):
        return type(value), [_identity(getattr(value, entry.name)) for entry in fields(value)]
    is_plain = value is None or isinstance(value, str | bytes | int | float | complex | type | os.PathLike)
    return repr(value) if is_plain else (type(value), id(value))


@dataclass(frozen=True)
class Coverage:
    """The frames and sequences of a score, and the frames that the length rule cut.

    Args:
        frames: frames scored. A metric that looks at some frames only counts those, see there.
        sequences: sequences scored.
        cut_prediction: frames cut from predictions.
        cut_truth: frames cut from truths.
        left_out: sequences that have no value under the metric's definition and do not enter the score.
    """

    frames: int
    sequences: int
    cut_prediction: int
    cut_truth: int
    left_out: int = 0


class SequenceMetric(ExactMetric):
    """Base of metrics that give each sequence one number and pool these; a new metric defines :meth:`clip_value`.

    The states are sums (float64) and counts (int64) of fixed size, so that memory does not grow and processes
    that saw different numbers of sequences, or none, reduce to the result of one process. They stay in these
    types when the module that holds the metric is converted to another precision.

    Under several processes :meth:`compute` and :meth:`coverage` are collective: call them on every rank, also on one
    that has no sequence (in Lightning from an ``on_…_epoch_end`` hook, not by logging from a step).

    Args:
        definition: the metric in plain words, with all its options; ``words`` if None.
        pooling: ``"frames"``, all frames of all sequences alike, or ``"sequences"``, the mean of the sequences' means.
        region: vertices that are looked at, None for all; motion of another mesh is refused.
        length_rule: ``"min"`` cuts prediction and truth to the shorter of the two; ``"error"`` refuses different
            lengths; ``"prediction"`` cuts the prediction and refuses one that is shorter than the truth.
        check_finite: whether :meth:`update` refuses NaN and infinity; off only where the caller has looked already.
        **kwargs: as of :class:`ExactMetric`.

    >>> class LastFrameError(SequenceMetric):
    ...     words = "mean distance in the last frame; mean over sequences [unit]"
    ...     def clip_value(self, clip):
    ...         return (clip.prediction[-1] - clip.truth[-1]).double().norm(dim=-1).mean()
    >>> metric = LastFrameError()
    >>> metric.update(torch.ones(2, 5, 7, 3), torch.zeros(2, 5, 7, 3), lengths=[5, 4])
    >>> round(metric.compute().item(), 6)
    1.732051
    """

    words: ClassVar[str] = ""
    """The definition, where it does not depend on options. ``{region}`` becomes the region's name, count and hash,
    ``{pooling}`` the pooling in words."""

    leaves_out = ""
    """Which sequences have no value, in words; empty if every sequence has one. :meth:`clip_value` gives NaN there."""

    in_order: ClassVar[bool] = False
    """Whether the order of frames counts, so that none can be left out of a sequence."""

    latest: Tensor | None
    """The results of :meth:`clip_value` in the last update, (batch,) float64; None before the first."""
    indices: Tensor | None
    total: Tensor
    counts: Tensor

    def __init__(
        self,
        *,
        definition: str | None = None,
        pooling: Pooling = "sequences",
        region: RegionLike | None = None,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: Any,  # noqa: ANN401 - whatever torchmetrics takes
    ) -> None:
        check_option("pooling", pooling, Pooling)
        check_option("length rule", length_rule, LengthRule)
        checked_region = None if region is None else as_region(region, "vertices")
        definition = (definition or self.words).replace("{pooling}", POOLING_WORDS[pooling])
        definition = definition.replace("{region}", "all vertices" if checked_region is None else str(checked_region))
        super().__init__(definition=definition, **kwargs)
        self.pooling: Pooling = pooling
        self.length_rule: LengthRule = length_rule
        self.check_finite = check_finite
        self.region: Region | None = checked_region
        self.latest = None
        self.register_buffer("indices", None if checked_region is None else checked_region.tensor(), persistent=False)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(5, dtype=torch.int64), dist_reduce_fx="sum")

    @property
    def over(self) -> Region | LipPairs | None:
        """The vertices, or pairs of vertices, that the metric reads; None for all vertices."""
        return self.region

    @abstractmethod
    def clip_value(self, clip: Clip) -> Tensor:
        """The metric of one sequence, a float64 scalar; NaN only if it ``leaves_out`` the sequence."""

    def clip_weight(self, clip: Clip) -> int:
        """How many frames the value of a sequence is a mean over: its weight when pooling by frames."""
        return clip.frames

    def check_vertices(self, n_vertices: int) -> None:
        """Refuse motion of a mesh that the metric's region cannot belong to."""
        if self.over is not None:
            self.over.check(n_vertices)

    def update(self, prediction: Tensor, truth: Tensor, **batch: Unpack[UpdateOptions]) -> None:
        """Add a batch of sequences.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: of the same shape as the prediction.
            lengths: valid frames (batch,) or a mask (batch, frames), of the truth and, unless
                ``prediction_lengths`` is given, of the prediction. Padding is never read.
            prediction_lengths: valid frames of the prediction.
            clip_names: one name per sequence, for messages.

        Raises:
            ValueError: if shapes or lengths do not fit or the length rule refuses them, or a valid frame
                holds NaN or infinity. Nothing is added then.
        """
        self.add(self.align(prediction, truth, **batch))

    def align(self, prediction: Tensor, truth: Tensor, **batch: Unpack[UpdateOptions]) -> Clips:
        """The sequences of a batch as the metric's length rule cuts them; see :meth:`update`."""
        return align(prediction, truth, rule=self.length_rule, **batch)

    def add(self, clips: Clips) -> None:
        """Check aligned sequences and add their values to the sums; nothing is added where one is refused."""
        self.check_vertices(clips.n_vertices)
        if self.check_finite:
            clips.check_finite()
        if not clips.clips:
            self.latest = self.total.new_empty(0)
            return
        of_clips = [self.clip_value(clip) for clip in clips.clips]
        for value in of_clips:  # a number for each frame would be added up, and weigh as one
            if not isinstance(value, Tensor) or value.ndim:
                shape = f" of shape {tuple(value.shape)}" if isinstance(value, Tensor) else ""
                raise ValueError(
                    f"clip_value of {type(self).__name__} gave a {type(value).__name__}{shape}; expected a tensor of "
                    "one number, such as .mean() of its frames"
                )
        values = self.latest = torch.stack(of_clips)
        weights = torch.tensor([self.clip_weight(clip) for clip in clips.clips], device=values.device)
        # A NaN that comes out of a metric that has a value everywhere must stay visible.
        scored = ~values.isnan() if self.leaves_out else torch.ones_like(weights, dtype=torch.bool)
        frames = torch.where(scored, weights, 0)
        values = torch.where(scored, values, 0) * (frames if self.pooling == "frames" else 1)
        cut = torch.tensor((clips.cut_prediction, clips.cut_truth), device=values.device)
        counts = torch.cat([torch.stack([frames.sum(), scored.sum()]), cut, (~scored).sum()[None]])
        # Not in place: a state made under inference_mode may not be changed in place outside of it.
        self.total = self.total + values.sum()
        self.counts = self.counts + counts.to(self.counts.device)

    def compute(self) -> Tensor:
        """The score over all sequences so far, a float64 scalar.

        Raises:
            ValueError: if no process had any sequence that has a value.
        """
        frames, sequences = self.counts[0], self.counts[1]
        if int(sequences) == 0:
            self.refuse_to_compute(int(self.counts[4]))
        return self.total / (frames if self.pooling == "frames" else sequences)

    def refuse_to_compute(self, left_out: int) -> NoReturn:
        """Raise the error of a metric that has nothing to score, or has left out all sequences."""
        self.leave_synchronised_state()
        reason = f"has no value on any of its {left_out} sequences: {self.leaves_out}"
        reason = reason if left_out else "has no sequence to score; call update before compute"
        raise ValueError(f"{type(self).__name__} {reason}")

    def coverage(self) -> Coverage:
        """How much was scored, cut and left out, over all processes."""
        if self._is_synced:
            return self.covered()
        with self.sync_context(dist_sync_fn=self.dist_sync_fn, should_sync=self.sync_on_compute):
            return self.covered()

    def covered(self) -> Coverage:
        """The :meth:`coverage` of the states as they are, without reducing them over processes."""
        return Coverage(*self.counts.tolist())


class LipMetric(SequenceMetric):
    """Base of metrics over the lip vertices that are pooled by sequence and have no options of their own.

    Args:
        lips: lip vertices, a :class:`Region` or indices.
        **options: see :class:`SequenceOptions`.
    """

    needs: ClassVar[tuple[str, ...]] = ("lips",)
    indices: Tensor

    def __init__(self, lips: RegionLike, **options: Unpack[SequenceOptions]) -> None:
        super().__init__(region=as_region(lips, "lips"), **options)


class SumsMetric(SequenceMetric):
    """Base of metrics of sums over all sequences, which have no value of a single sequence.

    Args:
        shape: of the sums.
        **options: of the next base class.
    """

    divides_by: ClassVar[str] = "the denominator is zero on every sequence"
    sums: Tensor

    def __init__(self, *, shape: tuple[int, ...], **options: Any) -> None:  # noqa: ANN401 - the next base's
        super().__init__(**options)
        self.add_state("sums", torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self._added: list[Tensor] = []

    @abstractmethod
    def clip_sums(self, clip: Clip) -> Tensor:
        """The sums of one sequence, float64."""

    @abstractmethod
    def score(self, sums: Tensor) -> Tensor:
        """From the sums over all sequences to the score, a float64 scalar."""

    def clip_value(self, clip: Clip) -> Tensor:
        """Zero, which does not enter the score."""
        self._added.append(self.clip_sums(clip))
        return torch.zeros((), dtype=torch.float64, device=clip.truth.device)

    def add(self, clips: Clips) -> None:
        """Check aligned sequences and add their sums; nothing is added where one is refused."""
        self._added = []
        super().add(clips)
        self.sums = sum(self._added, self.sums)
        self.latest = None

    def compute(self) -> Tensor:
        """The score over all sequences so far, a float64 scalar."""
        if int(self.counts[1]) == 0:
            self.refuse_to_compute(int(self.counts[4]))
        return self.score(self.sums)

    def check_denominator(self, sums: Tensor) -> None:
        """Refuse to divide by zero."""
        if bool((sums == 0).any()):
            self.leave_synchronised_state()
            raise ValueError(f"{type(self).__name__} would divide by zero: {self.divides_by}")


# The functional form.


INTERNAL = frozenset({"definition", "check_finite", "sync_on_compute", "process_group"})
"""Arguments of constructors that neither functions nor names with options take."""


def functional(metric: type[ExactMetric], *, positional: Sequence[str] = ()) -> Callable[..., Tensor]:
    """The functional form of a metric: its class, used once on one sequence or one padded batch.

    Both give the same number by construction. The function takes the motion that :meth:`update` takes, then regions,
    pairs and other arguments that the class requires, then the options of both by keyword. NumPy arrays do where
    tensors do. Processes are not brought together.

    Args:
        metric: the class; the function has its name in snake case.
        positional: keywords of :meth:`update` that the function also takes by position, after the class's.

    Returns:
        A function that returns a float64 scalar.
    """
    constructor = inspect.signature(metric).parameters
    updated = {name: p for name, p in inspect.signature(metric.update).parameters.items() if name != "self"}
    by_place = inspect.Parameter.POSITIONAL_OR_KEYWORD
    order: dict[str, inspect.Parameter] = {name: p for name, p in updated.items() if p.kind is by_place}
    order |= {name: p for name, p in constructor.items() if p.kind is by_place and name not in metric.inferred}
    order |= {name: updated[name].replace(kind=by_place, default=inspect.Parameter.empty) for name in positional}
    for name, parameter in (updated | constructor).items():
        if name not in {*order, *metric.inferred, *INTERNAL} and parameter.kind is not inspect.Parameter.VAR_KEYWORD:
            order[name] = parameter
    signature = inspect.Signature(list(order.values()), return_annotation=Tensor)

    def function(*args: Any, **kwargs: Any) -> Tensor:  # noqa: ANN401
        arguments = signature.bind(*args, **kwargs).arguments
        options = {name: arguments[name] for name in arguments if name in constructor}
        options |= {name: infer(arguments) for name, infer in metric.inferred.items()}
        batch = {name: as_tensor(arguments[name]) for name in arguments if name in updated}
        device = next((value.device for value in batch.values() if isinstance(value, Tensor)), None)
        one = metric(**options, sync_on_compute=False).to(device)
        one.update(**batch)
        return typing.cast(Tensor, one.compute())

    function.__name__ = function.__qualname__ = re.sub(r"(?<!^)(?=[A-Z])", "_", metric.__name__).lower()
    function.__module__ = metric.__module__
    function.__doc__ = f"The functional form of :class:`{metric.__name__}`, which has the formula and all arguments."
    function.__signature__ = signature  # type: ignore[attr-defined]  # for help() and IDEs
    return function


def as_tensor(value: Any) -> Any:  # noqa: ANN401 - whatever a metric takes
    """A NumPy array as a tensor of its own; everything else as it is."""
    if isinstance(value, Tensor) or not hasattr(value, "__array__"):
        return value
    array = value.__array__()
    # A copy: torch warns of arrays that may not be written to, such as motion files that are memory-mapped, and takes
    # none that is read backwards or has the other order of bytes.
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def describe_column(metric: Metric) -> dict[str, str | None]:
    """The facts with which a table pools a score again and compares it.

    Returns:
        ``pooling``: ``frames`` or ``sequences``; None if the score is no mean over sequences. ``better``:
        ``lower``, ``higher`` or ``zero``, which is the best value of a signed one; None if no direction is better.

    >>> from facediff.metrics import FaceDynamicsDeviation
    >>> describe_column(FaceDynamicsDeviation([0], sign="signed"))
    {'pooling': 'sequences', 'better': 'zero'}
    """
    pools = isinstance(metric, SequenceMetric) and type(metric).clip_weight is SequenceMetric.clip_weight
    signs = {"signed": "zero", "absolute": "lower"}
    directions = {False: "lower", True: "higher"}
    better = signs.get(getattr(metric, "sign", "")) or directions.get(metric.higher_is_better)  # type: ignore[arg-type]
    return {"pooling": str(getattr(metric, "pooling", "sequences")) if pools else None, "better": better}
