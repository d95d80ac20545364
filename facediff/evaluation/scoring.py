"""The numbers of one clip, from the metrics themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.errors import FaceDiffError
from facediff.evaluation.file_pairs import Pair, errors_of
from facediff.metrics import (
    FaceDynamicsDeviation,
    Protocol,
    Region,
    SequenceMetric,
    VertexError,
    describe_column,
    feed,
)
from facediff.metrics.base import Clips, LengthRule, Pooling, align
from facediff.metrics.channels import Moment
from facediff.metrics.one_pass import one_pass
from facediff.utils.arrays import open_vertices
from facediff.utils.jobs import run_tasks
from facediff.utils.limits import COORDINATE, in_range
from facediff.utils.workers import WorkerDied

METRICS = "metrics"  # Stands in place of a protocol's name where metrics were chosen by name
UNLIKE = 3.0
"""Times that no two faces differ in size by: they are in two units, or one side holds offsets."""
NATIVE = (np.float16, np.float32, np.float64)  # Types that torch reads as they are


@dataclass(frozen=True)
class Column:
    """One score of one protocol."""

    protocol: str  # the protocol's name; ``metrics`` for metrics that were chosen by name
    metric: str  # the score's name there: ``mve``, ``lve``, ``fdd``, ``fdd_absolute``, or the metric as it was chosen
    pooling: Pooling
    rule: LengthRule  # of the protocol for different lengths
    source: str  # which of the scorer's metrics gives the value of a sequence
    finish: Callable[[Tensor], Tensor] | None = None  # from that value to the score: sign, root and unit
    region: dict[str, Any] | str = "all vertices"  # name, count and hash
    better: str | None = None  # ``lower``, ``higher``, ``zero``, or None; see :func:`facediff.metrics.describe_column`
    channels: bool = False  # whether it is of channels and not of vertices
    by_name: bool = False  # whether it is a metric that was chosen by name, also by a protocol

    @property
    def name(self) -> str:
        """``<protocol>/<metric>``."""
        return f"{self.protocol}/{self.metric}"


@dataclass(frozen=True)
class ClipScores:
    """The scores of one clip, the mean over its conditions where there are several."""

    values: tuple[float, ...]  # a value for each column; NaN where the metric has none on this clip
    weights: tuple[float, ...]  # frames behind it, for pooling by frames
    frames: int  # frames scored, all conditions together
    cut_prediction: int  # frames cut from predictions
    cut_truth: int
    # The metrics of this clip that have a value over all clips only, by the source of their column.
    states: Mapping[str, Metric] = field(default_factory=dict)


@dataclass(frozen=True)
class Motion:
    """The motion of a file, as vertices or channels or both."""

    vertices: Tensor | None = None  # (T, V, 3) absolute
    channels: Tensor | None = None  # (T, C, 1)
    template: Tensor | None = None  # (V, 3) the person's neutral face, where the file says it

    def get(self, *, channels: bool) -> Tensor:
        """The one or the other, which the protocols and metrics have been checked against."""
        return cast(Tensor, self.channels if channels else self.vertices)


class Scorer:
    """Scores clips by several protocols; values that two protocols share are computed once.

    May be used by several threads at the same time.

    Args:
        upper_face: upper-face vertices; None if no protocol has FDD.
        templates: neutral face (V, 3) by identity; empty if no protocol has FDD.
        metrics: further metrics by name, made for the corpus.
        inputs: gives their inputs of a clip besides its motion.
        moments: in which frames a metric of that name is taken.
        owners: protocol and label of each of these that a protocol names.
        read: reads a file, every ``stride``-th frame of it; None for files of vertices.
        channels: regions ``lips`` and ``upper_face`` of channels, for protocols of channels; None for vertices.
        scales: factor of lengths of each protocol, by its name.
    """

    def __init__(
        self,
        protocols: Sequence[Protocol],
        *,
        lips: Region,
        upper_face: Region | None,
        templates: Mapping[str, Tensor],
        n_vertices: int,
        truth_stride: int,
        metrics: Mapping[str, Metric],
        inputs: Callable[[Pair], dict[str, Any]],
        moments: Mapping[str, Moment],
        owners: Mapping[str, tuple[str, str]],
        read: Callable[[Path, int], Motion] | None,
        channels: Mapping[str, Region] | None,
        scales: Mapping[str, float],
    ) -> None:
        self.columns: list[Column] = []
        self.metrics: dict[str, SequenceMetric] = {}
        self.templates, self.n_vertices, self.truth_stride = templates, n_vertices, truth_stride
        self.remarks: list[str] = []
        self.read = read or self._read
        self.moments = moments
        for protocol in protocols:
            with errors_of(f"protocol {protocol.name}"):
                if protocol.channels:
                    if not channels:
                        raise ValueError("it scores channels, and the files hold vertices")
                    built = protocol.build(channels["lips"], channels["upper_face"])
                else:
                    built = protocol.build(lips, upper_face, scale=scales[protocol.name])
                    for region in (built.lips, built.upper):
                        if region is not None:
                            region.check(n_vertices)
            self.remarks += [remark for remark in built.summary().remarks if remark not in self.remarks]
            for name, metric in built.scores().items():
                self._add(protocol, name, metric)
        has_fdd = any(isinstance(metric, FaceDynamicsDeviation) for metric in self.metrics.values())
        if read is None and has_fdd and not templates:
            raise FaceDiffError("FDD needs each speaker's neutral face: give --templates, or a protocol without FDD")
        self.further, self.inputs = metrics, inputs
        for name, further in self.further.items():
            over = further.over if isinstance(further, SequenceMetric) else None
            of_channels = bool(getattr(further, "of_channels", False))
            if over is not None and not of_channels:
                with errors_of(f"metric {name}"):
                    over.check(n_vertices)
            pooling: Pooling = getattr(further, "pooling", "sequences")
            where = "all vertices" if over is None else over.as_dict()
            better = describe_column(further)["better"]
            protocol_name, label = owners.get(name, (METRICS, name))
            facts: dict[str, Any] = {"region": where, "better": better, "channels": of_channels, "by_name": True}
            self.columns.append(Column(protocol_name, label, pooling, "min", name, **facts))
        has_template = any("template" in getattr(further, "needs", ()) for further in metrics.values())
        self.needs_template = read is None and (has_fdd or has_template)

    def _add(self, protocol: Protocol, name: str, metric: SequenceMetric) -> None:
        finish: Callable[[Tensor], Tensor] | None = None
        better = describe_column(metric)["better"]
        if isinstance(metric, FaceDynamicsDeviation):
            finish = metric.finished
            source = f"fdd {metric.region}"
            metric = FaceDynamicsDeviation(cast(Region, metric.region), sign="signed", check_finite=False)
        elif isinstance(metric, VertexError):
            finish = metric.finished
            source = f"{metric.reduction} {metric.squared} {metric.region}"
        else:
            source = f"{protocol.name} {name}"
        source += " of channels" if protocol.channels else ""
        self.metrics.setdefault(source, metric)
        pooling: Pooling = "sequences" if source.startswith("fdd") else protocol.pooling
        region = "all vertices" if metric.region is None else metric.region.as_dict()
        self.columns.append(
            Column(
                protocol.name, name, pooling, protocol.length_rule, source, finish, region, better, protocol.channels
            )
        )

    def score(self, pair: Pair) -> ClipScores | str:
        """The scores of a clip, or the reason why a file of it cannot be used."""
        subject = pair.truth.name.subject
        template = self.templates.get(subject)
        if self.needs_template and template is None:
            return f"no template for {subject}"
        try:
            truth = self.read(pair.truth.path, self.truth_stride)
            predictions = {condition: self.read(path, 1) for condition, path in pair.predictions.items()}
            template = template if truth.template is None else truth.template
            inputs = self.inputs(pair) if self.further else {}
        except FaceDiffError as error:
            return str(error)
        for condition, prediction in predictions.items():
            size = times_as_large(prediction, truth)
            if not 1 / UNLIKE < size < UNLIKE:
                return (
                    f"{pair.predictions[condition]}: its face is {size:.3g} times as large as the truth's; "
                    "expected whole faces, not offsets, in the truth's unit"
                )
        scored = [
            self._score(pair.predictions[condition].stem, prediction, truth, template)
            for condition, prediction in predictions.items()
        ]
        weights = np.array([scores.weights for scores in scored])
        values = np.array([scores.values for scores in scored])
        by_frames = np.array([column.pooling == "frames" for column in self.columns[: values.shape[1]]])
        # A condition's share of the clip is its frames where all frames count alike; they differ only if one was cut.
        shares = np.where(by_frames, weights, 1.0)
        by_name, states = self._further(pair, truth, predictions, inputs | {"template": template})
        return ClipScores(
            (*((values * shares).sum(0) / shares.sum(0)).tolist(), *(value for value, _ in by_name)),
            (*weights.mean(0).tolist(), *(weight for _, weight in by_name)),
            sum(scores.frames for scores in scored),
            sum(scores.cut_prediction for scores in scored),
            sum(scores.cut_truth for scores in scored),
            states,
        )

    def _further(
        self, pair: Pair, truth: Motion, predictions: Mapping[str, Motion], inputs: dict[str, Any]
    ) -> tuple[list[tuple[float, float]], dict[str, Metric]]:
        """Value and weight of a clip under each metric chosen by name, and the metrics that have no such values."""
        valued: list[tuple[float, float]] = []
        states: dict[str, Metric] = {}
        for name, metric in self.further.items():
            one = metric.clone()
            channels = bool(getattr(metric, "of_channels", False))
            moment = self.moments.get(name, "all")
            with errors_of(f"metric {name}"):
                if "conditions" in getattr(metric, "needs", ()):
                    motions = [motion.get(channels=channels) for motion in predictions.values()]
                    frames = min(map(len, motions))
                    conditions = torch.stack([motion[:frames] for motion in motions])
                    feed(one, {"predictions": conditions, "clip_names": [pair.clip]})
                else:
                    for condition, motion in predictions.items():
                        clip_names = [pair.predictions[condition].stem]
                        sides = {
                            "prediction": motion.get(channels=channels),
                            "truth": truth.get(channels=channels),
                        }
                        feed(one, inputs | sides | {"clip_names": clip_names}, moment)
                if not isinstance(one, SequenceMetric) or one.latest is None:
                    states[name] = one
                    valued.append((math.nan, 0.0))
                    continue
                frames, sequences = one.counts[:2].tolist()
                valued.append((one.compute().item(), frames / sequences) if sequences else (math.nan, 0.0))
        return valued, states

    def _score(self, name: str, prediction: Motion, truth: Motion, template: Tensor | None) -> ClipScores:
        """One prediction."""
        aligned: dict[tuple[bool, str], Clips] = {}
        columns = [column for column in self.columns if not column.by_name]
        for column in columns:
            if (column.channels, column.rule) not in aligned:
                # Every rule that does not refuse the lengths leaves the same frames, those that both sides have.
                with errors_of(f"protocol {column.protocol}"):
                    sides = (motion.get(channels=column.channels) for motion in (prediction, truth))
                    clips = align(*sides, clip_names=[name], rule=column.rule)
                # Channels are offsets from a face at rest.
                clips = clips.attach("template", [None if column.channels else template])
                aligned[column.channels, column.rule] = clips
        by_source: dict[str, float] = {}
        for channels in {column.channels for column in columns}:
            clips = next(clips for (of_channels, _), clips in aligned.items() if of_channels == channels)
            sources = {column.source for column in columns if column.channels == channels}
            by_source |= self._values(clips, {source: self.metrics[source] for source in sources})
        first = next(iter(aligned.values()))
        values = [
            by_source[column.source]
            if column.finish is None
            else column.finish(torch.tensor(by_source[column.source], dtype=torch.float64)).item()
            for column in columns
        ]
        frames = first.clips[0].frames
        return ClipScores(
            tuple(values),
            (float(frames),) * len(values),
            frames,
            first.cut_prediction,
            first.cut_truth,
        )

    def _read(self, path: Path, stride: int) -> Motion:
        return Motion(read_vertices(path, self.n_vertices, stride))

    def _values(self, clips: Clips, metrics: Mapping[str, SequenceMetric]) -> dict[str, float]:
        """The value of each source on one clip."""
        clip = clips.clips[0]
        errors = {source: metric for source, metric in metrics.items() if isinstance(metric, VertexError)}
        dynamics = {source: metric for source, metric in metrics.items() if isinstance(metric, FaceDynamicsDeviation)}
        means, deviations = one_pass(
            clip.prediction,
            clip.truth,
            errors=[metric.error_of() for metric in errors.values()],
            template=clip.template,
            uppers=[metric.indices for metric in dynamics.values()],
        )
        by_source = dict(zip([*errors, *dynamics], torch.stack([*means, *deviations]).tolist(), strict=True))
        # An error over all vertices is finite only if every value of the frames is: the clip need not be read again.
        complete = any(metric.region is None for metric in errors.values())
        if not complete or not all(map(math.isfinite, by_source.values())):
            with errors_of(f"protocol {self.columns[0].protocol}"):
                clips.check_finite()
        remaining = metrics.keys() - by_source.keys()
        return by_source | {source: float(metrics[source].clip_value(clip)) for source in remaining}


def times_as_large(prediction: Motion, truth: Motion) -> float:
    """How large a prediction's face is for the truth's, by their first frames; 1 where a side has no extent to tell."""
    if prediction.vertices is None or truth.vertices is None:
        return 1.0
    first, second = (
        float((face[0].amax(0) - face[0].amin(0)).norm()) for face in (prediction.vertices, truth.vertices)
    )
    return first / second if math.isfinite(first) and second > 0 and math.isfinite(second) else 1.0


def read_vertices(path: Path, n_vertices: int, stride: int = 1) -> Tensor:
    """Absolute vertices (T, V, 3) of a file that holds (T, 3V) or (T, V, 3) in any float type, memory-mapped."""
    # torch warns of arrays that cannot be written; copy-on-write ones can, and nothing writes to them.
    array = open_vertices(path, n_vertices, mode="c")[::stride]
    if array.dtype not in NATIVE or not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("=") if array.dtype.itemsize <= 8 else np.float64)
    # Metrics refuse NaN and infinity themselves; finite numbers may be so large that their squares are infinite.
    if not in_range(array) and np.isfinite(array).all():
        raise FaceDiffError(f"{path}: holds coordinates beyond {COORDINATE:g}; generate the motion again")
    return torch.from_numpy(array)


# Scoring many clips on all processors.


def score_all(
    scorer: Scorer,
    jobs: Sequence[tuple[str, Pair]],
    workers: int | None,
    *,
    scheduler: str | None = "",
    reads: Sequence[Path] = (),
    progress: bool = False,
) -> dict[str, dict[str, ClipScores | str]]:
    """The scores of every job, by method and clip.

    On one machine, the workers are threads: nearly all of the time is spent in torch, which lets other threads
    run, and a thread starts immediately where a process would take seconds, and a hundred megabytes, to import torch.
    """
    by_method: dict[str, dict[str, ClipScores | str]] = {method: {} for method, _ in jobs}
    results = run_tasks(
        partial(_score_job, scorer),
        jobs,
        workers=workers,
        mode="threads",
        scheduler=scheduler,
        reads=reads,
        progress="clips" if progress else "",
    )
    with closing(results):
        for (method, pair), scores in results:
            if isinstance(scores, WorkerDied):
                scores = "killed the process that scored it, perhaps for lack of memory"  # noqa: PLW2901
            by_method[method][pair.clip] = scores
    return by_method


def _score_job(scorer: Scorer, job: tuple[str, Pair]) -> ClipScores | str:
    return scorer.score(job[1])
