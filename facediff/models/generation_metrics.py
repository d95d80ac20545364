"""Generation metrics: diversity, liveliness, calibration and errors of a model's samples, measured in one pass.

From top to bottom: names and meaning of the metrics (:data:`GENERATION_METRICS`; docs/generation.md judges models by
them), how one model is measured on one split (:class:`Measurement`), and several models together (:func:`measure`,
:class:`GenerationScores`).
"""

from __future__ import annotations

import math
import statistics
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.data import Batch, Clip, Sample, SpeechMotionDataModule, collate
from facediff.data.batch import UNKNOWN_IDENTITY
from facediff.data.conversations import channel_regions
from facediff.data.dataset import MotionDataset
from facediff.data.speakers import MeanFaces, speaker_gallery
from facediff.errors import FaceDiffError, counted
from facediff.metrics import (
    BilabialClosureRate,
    BlinkRate,
    BlinkRateRatio,
    CoverageError,
    DifferenceRatio,
    EnergyScore,
    EyelidDrift,
    FaceDynamicsDeviation,
    FrameStep,
    LipPairs,
    LipVertexError,
    MeanEstimateError,
    MeanVertexError,
    MotionLiveliness,
    NearestSpeakerAccuracy,
    RealTimeFactor,
    Region,
    SpectrumDistance,
    SpreadErrorRatio,
    device_name,
)
from facediff.metrics.eyes import LidMetric
from facediff.models.base import AnimationModel
from facediff.models.evaluation import closures_of, eyelid_pairs_of, regions_of, with_identity
from facediff.models.inference import named
from facediff.registry import name_of
from facediff.utils import ranges

REFERENCES = {
    "own": "own reference",
    "own_other_mood": "own reference in another mood",
    "another": "another speaker's reference",
    "another_other_mood": "another speaker's reference in another mood",
}
"""Whose reference gives the style. Moods are equal or not by the corpus's ``reference_attributes``."""

CHANNEL_GROUPS = ("expression", "jaw", "head", "eyes")
"""Groups of channels whose liveliness is measured."""

GENERATION_METRICS: dict[str, str] = {
    "liveliness_upper_face": "liveliness of the upper face (1)",
    "liveliness_lips": "liveliness of the lips (1)",
    "spectrum_upper_face": "spectrum of the upper face: decibels off (0)",
    "difference_ratio_upper_face": "difference ratio of the upper face / truth's (1)",
    "difference_ratio_lips": "difference ratio of the lips / truth's (1)",
    "frame_step_upper_face": "frame step of the upper face / truth's (1)",
    "frame_step_lips": "frame step of the lips / truth's (1)",
    "spread_face": "spread / error, whole face (1)",
    "spread_upper_face": "spread / error, upper face (1)",
    "spread_lips": "spread / error, lips (1)",
    "variance_upper_face": "spread / error in variances, upper face (1)",
    "variance_lips": "spread / error in variances, lips (1)",
    "blink_ratio": "blink rate / truth's (1)",
    "blinks_a_minute": "blinks a minute",
    "true_blinks_a_minute": "blinks a minute, truth",
    "eyelid_drift": "eyelid drift between blinks / truth's (1)",
    "fdd_still": "FDD / still face's (0)",
    "fdd_signed_still": "FDD, signed / still face's (0)",
    "lve": "LVE, one sample",
    "lve_still": "LVE / still face's, one sample",
    "lve_default_still": "LVE / still face's, one sample, with the style that animate takes",
    "lve_mean_still": "LVE / still face's, mean of {samples} samples",
    "lve_best_still": "LVE / still face's, best of {samples} samples",
    "lve_mean_face": "LVE / mean face's, one sample",
    "lve_mean_mean_face": "LVE / mean face's, mean of {samples} samples",
    "lve_best_mean_face": "LVE / mean face's, best of {samples} samples",
    "mve": "MVE, one sample",
    "energy_lips": "energy score of the lips",
    "energy_upper_face": "energy score of the upper face",
    "closures": "closures at p, b, m / truth's (1)",
    "nearest_speaker": "nearest speaker is right, identity hidden (1; chance {chance})",
    "true_nearest_speaker": "nearest speaker is right, truth",
    **{
        f"mve_{label}_{whose}": f"MVE with {title} / own, identity {label}"
        for label in ("hidden", "known")
        for whose, title in REFERENCES.items()
        if whose != "own"
    },
    "mve_hidden_own": "MVE with own reference, identity hidden",
    "mve_known_own": "MVE with own reference, identity known",
    **{f"param_liveliness_{name}": f"liveliness of the channels of {name} (1)" for name in CHANNEL_GROUPS},
    "param_spread": "spread / error, all channels (1)",
    "param_mve": "MVE of channels, one sample",
    "real_time_factor": "real-time factor, one sample",
}
"""Names of the metrics in files, and their titles; in parentheses what the truth itself, or a model that draws
from the truth's distribution, would get."""


@dataclass(frozen=True)
class SamplingOptions:
    """How a model is asked for motion.

    Attributes:
        samples: of each clip.
        references: samples of each clip with each reference.
        sampler: by name; the checkpoint's if None.
        steps: of the sampler; the sampler's own if None.
        seed: of the first sample; the others follow.
        expressivity: 0 for the mean prediction, 1 for a sample; the checkpoint's if None.
        low_latency: frame by frame, as speech arrives.
    """

    samples: ranges.Samples = 10
    references: ranges.Samples = 2
    sampler: str | None = None
    steps: ranges.Steps | None = None
    seed: ranges.Seed = 0
    expressivity: ranges.Expressivity | None = None
    low_latency: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        ranges.check_fields(self)
        if self.samples < 2:
            raise FaceDiffError(f"--samples {self.samples}: the spread of a model needs two samples; give 2 or more")


class EvaluationCorpus:
    """What measuring needs of a corpus in addition to its clips; made once for all models and splits."""

    def __init__(self, data: SpeechMotionDataModule) -> None:
        self.data = data
        self.assets = data.assets()
        # Scores are those of vertices, also of channels, which their rig decodes; without a rig, those of channels.
        self.regions = regions_of(self.assets.scored)
        self.channels = {
            name: region for name, region in channel_regions(self.assets.space).items() if name in CHANNEL_GROUPS
        }
        compared = data.compared_speakers
        self.speakers = sorted(name for name in self.assets.templates if compared is None or name in compared)
        self.mean_faces = MeanFaces(data)
        self.missing: dict[str, str] = {}
        self.gallery = None
        try:
            if not self.assets.scored.space.is_vertices:
                raise FaceDiffError("no rig decodes the channels, and speakers are told apart by their faces")
            self.gallery = speaker_gallery(data, self.speakers, self.assets)
        except FaceDiffError as error:
            self.missing["nearest_speaker"] = str(error)
        self.eyelids = eyelid_pairs_of(data)
        if self.eyelids is None:
            self.missing["blink_ratio"] = "the corpus lists no eyelid pairs; name a file of them by data.eyelid_pairs"
        pairs = self.assets.scored.inner_lip_pairs
        self.lips = None if pairs is None else LipPairs.from_pairs(f"{self.assets.corpus}/inner lips", pairs)
        if self.lips is None or not (data.root / "phonemes").is_dir():
            self.missing["closures"] = "the corpus has no phonemes/, or no regions/inner_lip_pairs.txt"

    def references(self, clip: Clip, own: str) -> dict[str, Clip]:
        """A clip's references by whose they are; ``own`` is the name of the usual one."""
        attributes = self.data.reference_attributes
        candidates = {
            name: [other for other in clips if other.name != clip.name]
            for name, clips in self.data.reference_policy().candidates.items()
        }
        mine = candidates.get(clip.identity, [])
        others = [other for name in self.speakers if name != clip.identity for other in candidates.get(name, [])]

        def alike(other: Clip) -> bool:
            return all(other.attributes.get(name) == clip.attributes.get(name) for name in attributes)

        sorts = {
            "own": [other for other in mine if other.name == own],
            "own_other_mood": [other for other in mine if not alike(other)],
            "another": [other for other in others if alike(other)],
            "another_other_mood": [other for other in others if not alike(other)],
        }
        # By chance, but the same for every model: moods and speakers are met about equally often.
        return {
            whose: clips[zlib.crc32(f"{clip.name}/{whose}".encode()) % len(clips)]
            for whose, clips in sorts.items()
            if clips
        }


class Measurement:
    """All metrics of one model on one split.

    Args:
        model: a trained model in evaluation mode.
        corpus: what it is measured on.
        sampling: how it is asked for motion.
    """

    def __init__(self, model: AnimationModel, corpus: EvaluationCorpus, sampling: SamplingOptions) -> None:
        self.model, self.corpus, self.sampling = model, corpus, sampling
        lips, upper = corpus.regions["lips"], corpus.regions["upper_face"]
        # Without noise all samples are one: their spread is zero, and the energy score is the distance itself.
        self.drawn = sampling.samples if model.samples else 1
        self.compared = max(2, self.drawn)
        count = self.compared
        areas: dict[str, Region | None] = {"face": None, "upper_face": upper, "lips": lips}
        self.of_samples: dict[str, Metric] = {
            "lve_mean": MeanEstimateError(lips, n_samples=count),
            "lve_best": CoverageError(lips, n_samples=count),
            "energy_lips": EnergyScore(lips, n_samples=count),
            "energy_upper_face": EnergyScore(upper, n_samples=count),
            **{f"spread_{name}": SpreadErrorRatio(area, n_samples=count) for name, area in areas.items()},
            "variance_upper_face": SpreadErrorRatio(upper, n_samples=count, squared=True),
            "variance_lips": SpreadErrorRatio(lips, n_samples=count, squared=True),
        }
        # Each sample by itself, and the same of two faces that do not move.
        self.of_each: dict[str, Metric] = {
            "liveliness_upper_face": MotionLiveliness(upper),
            "liveliness_lips": MotionLiveliness(lips),
            "spectrum_upper_face": SpectrumDistance(upper),
            "difference_ratio_upper_face": DifferenceRatio(upper),
            "difference_ratio_lips": DifferenceRatio(lips),
            "frame_step_upper_face": FrameStep(upper),
            "frame_step_lips": FrameStep(lips),
            "lve": LipVertexError(lips),
            "mve": MeanVertexError(),
            "fdd": FaceDynamicsDeviation(upper),
            "fdd_signed": FaceDynamicsDeviation(upper, sign="signed"),
        }
        if corpus.eyelids is not None:
            rate = corpus.assets.frame_rate
            self.of_each |= {
                "blink_ratio": BlinkRateRatio(corpus.eyelids),
                "blinks_a_minute": BlinkRate(corpus.eyelids, frames_per_second=rate),
                "true_blinks_a_minute": BlinkRate(corpus.eyelids, frames_per_second=rate, of="truth"),
                "eyelid_drift": EyelidDrift(corpus.eyelids),
            }
        if corpus.lips is not None and "closures" not in corpus.missing:
            self.of_each |= {
                "closed": BilabialClosureRate(corpus.lips),
                "truly_closed": BilabialClosureRate(corpus.lips, of="truth"),
            }
        # Of the channels themselves, of motion in parameters.
        self.of_channels: dict[str, Metric] = {
            f"param_liveliness_{name}": MotionLiveliness(region) for name, region in corpus.channels.items()
        }
        if corpus.channels:
            self.of_channels |= {"param_mve": MeanVertexError(), "param_spread": SpreadErrorRatio(n_samples=count)}
        self.of_baselines: dict[str, Metric] = {
            "still_lve": LipVertexError(lips),
            "mean_face_lve": LipVertexError(lips),
            "still_fdd": FaceDynamicsDeviation(upper),
            "still_fdd_signed": FaceDynamicsDeviation(upper, sign="signed"),
        }
        self.of_references: dict[str, Metric] = {
            f"{label}_{whose}": MeanVertexError() for label in ("hidden", "known") for whose in REFERENCES
        }
        self.of_references["lve_default"] = LipVertexError(lips)
        if corpus.gallery is not None:
            nearest = partial(NearestSpeakerAccuracy, corpus.gallery, components=64)
            self.of_references["nearest_speaker"] = nearest()
            self.of_baselines["true_nearest_speaker"] = nearest()
        self.speed = RealTimeFactor(device_name(model.device))
        for metrics in (self.of_samples, self.of_each, self.of_channels, self.of_baselines, self.of_references):
            for metric in metrics.values():
                metric.to(model.device)

    @torch.inference_mode()
    def add(self, clip: Clip, sample: Sample) -> None:
        """Generate motion for a clip, and score it."""
        batch = self.model.with_person_styles(collate([sample]).to(self.model.device))
        motion, truth = self._samples(batch), batch.motion[0]
        for name, metric in self.of_channels.items():
            if name == "param_spread":
                metric.update(motion.expand(self.compared, -1, -1, -1), truth)
            else:
                for drawn in motion:
                    metric.update(drawn, truth)
        motion, truth = self._scored(motion, clip), self._scored(truth, clip)
        template = self.corpus.assets.scored.template(clip.identity).to(truth)
        for metric in self.of_samples.values():
            metric.update(motion.expand(self.compared, -1, -1, -1), truth)
        closures = closures_of(self.corpus.data, clip.name) if "closed" in self.of_each else []
        for drawn in motion:
            for metric in self.of_each.values():
                if isinstance(metric, BilabialClosureRate):
                    metric.update(drawn, truth, closures=closures, offsets_from=template)
                elif isinstance(metric, LidMetric):
                    metric.update(drawn, truth, offsets_from=template)
                else:
                    metric.update(drawn, truth)
        self._add_baselines(clip, truth)
        self._add_references(clip, sample)

    def _samples(self, batch: Batch) -> Tensor:
        """Samples of a clip (drawn, frames, V, 3); the first one is timed, alone as `facediff animate` makes it."""
        seeds = range(self.sampling.seed, self.sampling.seed + self.drawn)
        with self.speed.measure(batch.motion.shape[1] / self.corpus.assets.frame_rate):
            first = self.model.sample_clip(batch, seeds[:1])
        return torch.cat([first, self.model.sample_clip(batch, seeds[1:])]) if self.drawn > 1 else first

    def _scored(self, motion: Tensor, clip: Clip) -> Tensor:
        """Offsets of a clip (*frames, points, dims) as those of what is scored."""
        return self.corpus.assets.to_scored(motion, clip.identity)

    def warm_up(self, sample: Sample) -> None:
        """Generate once without a measurement: the first call makes what later ones find."""
        with torch.inference_mode():
            self.model.sample_clip(collate([sample]).to(self.model.device), [self.sampling.seed])

    def _add_baselines(self, clip: Clip, truth: Tensor) -> None:
        face = self._scored(self.corpus.mean_faces.of([clip.identity]).to(truth), clip).expand_as(truth)
        for name, metric in self.of_baselines.items():
            if name == "true_nearest_speaker":
                metric.update(truth, self._number(clip))
            else:
                metric.update(face if name.startswith("mean_face") else torch.zeros_like(truth), truth)

    def _add_references(self, clip: Clip, sample: Sample) -> None:
        """Score motion with other references, with the label of a trained speaker and without."""
        views = dict(self._views(clip, sample))
        batch = collate(list(views.values())).to(self.model.device)
        default = self._with_default_style(clip, sample)
        for seed in range(self.sampling.seed, self.sampling.seed + (self.sampling.references if self.drawn > 1 else 1)):
            if default is not None:
                motion = self.model.generate(default, seed=seed)[0]
                sides = (self._scored(motion, clip), self._scored(default.motion[0], clip))
                self.of_references["lve_default"].update(*sides)
            truth = self._scored(batch.motion[0], clip)
            for name, generated in zip(views, self.model.generate(batch, seed=seed), strict=True):
                motion = self._scored(generated, clip)
                self.of_references[name].update(motion, truth)
                if name == "hidden_own" and "nearest_speaker" in self.of_references:
                    self.of_references["nearest_speaker"].update(motion, self._number(clip))

    def _with_default_style(self, clip: Clip, sample: Sample) -> Batch | None:
        """A clip with the style that its identity has where none is named; None if it has none, or the clip itself."""
        try:
            style = self.model.default_style(clip.identity)
        except FaceDiffError:
            return None
        if named(style) == clip.name:  # of a speaker of evaluated clips only
            return None
        return with_identity(collate([sample]).to(self.model.device), sample.identity, style)

    def _views(self, clip: Clip, sample: Sample) -> list[tuple[str, Sample]]:
        views = []
        data = self.corpus.data
        for whose, source in self.corpus.references(clip, sample.reference_name).items():
            reference = sample.reference
            if whose != "own":
                frames = min(data.corpus.frames(source), data.reference_frames)
                reference = data.corpus.read_motion(source, 0, frames)
            styled = replace(sample, reference=reference, reference_name=source.name)
            views.append((f"hidden_{whose}", replace(styled, identity=UNKNOWN_IDENTITY)))
            if sample.identity != UNKNOWN_IDENTITY:
                views.append((f"known_{whose}", styled))
        return views

    def _number(self, clip: Clip) -> list[int]:
        return [self.corpus.speakers.index(clip.identity)]

    def result(self) -> dict[str, float | None]:
        """The value of every metric, in the order of :data:`GENERATION_METRICS`; None where there is none."""
        raw: dict[str, float] = {}
        everything = {**self.of_samples, **self.of_each, **self.of_channels, **self.of_baselines, **self.of_references}
        for name, metric in {**everything, "real_time_factor": self.speed}.items():
            if metric.update_called:
                with suppress(ValueError):  # no value on any sequence
                    raw[name] = float(metric.compute())

        def ratio(above: str, below: str) -> float | None:
            numerator, denominator = raw.get(above), raw.get(below)
            return None if numerator is None or not denominator else numerator / denominator

        values: dict[str, float | None] = {
            **raw,
            "fdd_still": ratio("fdd", "still_fdd"),
            "fdd_signed_still": ratio("fdd_signed", "still_fdd_signed"),
            "closures": ratio("closed", "truly_closed"),
            **{
                f"{name}_{face}": ratio(name, f"{face}_lve")
                for name in ("lve", "lve_mean", "lve_best")
                for face in ("still", "mean_face")
            },
            "lve_default_still": ratio("lve_default", "still_lve"),
            **{
                f"mve_{label}_{whose}": ratio(f"{label}_{whose}", f"{label}_own")
                for label in ("hidden", "known")
                for whose in REFERENCES
            },
            "mve_hidden_own": raw.get("hidden_own"),
            "mve_known_own": raw.get("known_own"),
        }
        return {name: values.get(name) for name in GENERATION_METRICS}


# Several models, such as three training seeds of one method.


@dataclass(frozen=True)
class GenerationScores:
    """What several models of one method got.

    Attributes:
        corpus: name of the corpus.
        synthetic: whether a program made it.
        checkpoints: what was measured.
        sampler: how motion was sampled, in words.
        samples: of each clip; 1 for a model without noise.
        speakers: among how many the nearest one was looked for; 0 if it was not.
        clips: how many, by split.
        values: one for each checkpoint, by split and metric.
        missing: why metrics have no value.
        against: mean values of another method, by split and metric.
        against_name: what that method is called.
    """

    corpus: str
    synthetic: bool
    checkpoints: list[str]
    sampler: str
    samples: int
    speakers: int
    clips: dict[str, int]
    values: dict[str, dict[str, list[float | None]]]
    missing: dict[str, str] = field(default_factory=dict)
    against: dict[str, dict[str, float | None]] = field(default_factory=dict)
    against_name: str = ""

    def mean(self, split: str, name: str) -> float | None:
        """Mean over the checkpoints that have a value."""
        values = [value for value in self.values[split][name] if value is not None]
        return statistics.fmean(values) if values else None

    def deviation(self, split: str, name: str) -> float | None:
        """Standard deviation over checkpoints (n − 1); None for less than two values."""
        values = [value for value in self.values[split][name] if value is not None]
        return statistics.stdev(values) if len(values) > 1 else None

    def title(self, name: str) -> str:
        """Title of a metric in tables."""
        chance = f"1/{self.speakers}" if self.speakers else "unknown"
        return GENERATION_METRICS[name].format(samples=self.samples, chance=chance)

    def rows(self) -> list[dict[str, Any]]:
        """One flat row for each split and metric."""
        table = []
        for split, values in self.values.items():
            for name in GENERATION_METRICS:
                mean, against = self.mean(split, name), self.against.get(split, {}).get(name)
                row: dict[str, Any] = {
                    "split": split,
                    "metric": name,
                    "title": self.title(name),
                    "mean": mean,
                    "std": self.deviation(split, name),
                }
                if self.against_name:
                    row |= {"against": against, "ratio": mean / against if mean is not None and against else None}
                numbered = {f"value_{place}": value for place, value in enumerate(values[name], 1)}
                table.append(row | numbered)
        return table

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, as :func:`means_of` reads them again."""
        facts = {name: value for name, value in vars(self).items() if name not in ("values", "against")}
        keys = ("split", "metric", "title", "mean", "std", "against", "ratio")
        scores = [
            {key: row[key] for key in keys if key in row} | {"values": self.values[row["split"]][row["metric"]]}
            for row in self.rows()
        ]
        return {"format": FORMAT, **facts, "metrics": scores}


FORMAT = "facediff generation metrics 1"


def means_of(content: object, source: object) -> dict[str, dict[str, float | None]]:
    """Mean values by split and metric from what :meth:`GenerationScores.as_dict` gave.

    Raises:
        FaceDiffError: if it is anything else.
    """
    means: dict[str, dict[str, float | None]] = {}
    try:
        if not isinstance(content, dict) or content["format"] != FORMAT:
            raise TypeError
        if not content["metrics"]:
            raise ValueError
        for row in content["metrics"]:
            mean = row["mean"]
            means.setdefault(str(row["split"]), {})[str(row["metric"])] = None if mean is None else float(mean)
    except (TypeError, KeyError, ValueError) as error:
        raise FaceDiffError(
            f"{source}: holds no generation metrics; expected a file of `facediff generation-metrics --json`"
        ) from error
    return means


def measure(
    models: Mapping[str, Callable[[], AnimationModel]],
    data: SpeechMotionDataModule,
    *,
    splits: Sequence[str] | None = None,
    sampling: SamplingOptions | None = None,
    most_clips: int | None = None,
    step: Callable[[], object] = lambda: None,
) -> GenerationScores:
    """Measure models by all generation metrics, one after another.

    Args:
        models: what loads each model, by the name of its checkpoint; one is in memory at a time.
        data: the corpus, whose folder is there.
        splits: ``val``, ``test_a``, ``test_b``; all test splits if None.
        sampling: how they are asked for motion.
        most_clips: clips of a split, evenly spread; all if None.
        step: called after each clip of each model.

    Raises:
        FaceDiffError: if a split has no clip, a model is of another corpus, or the sampler does not fit.
    """
    sampling = sampling or SamplingOptions()
    corpus = EvaluationCorpus(data)
    datasets = {split: data.dataset(split) for split in splits or data.test_splits}
    chosen = {split: picked(dataset, most_clips) for split, dataset in datasets.items()}
    values: dict[str, dict[str, list[float | None]]] = {
        split: {name: [] for name in GENERATION_METRICS} for split in datasets
    }
    described: set[str] = set()
    drawn = 1
    for name, load in models.items():
        model = load()
        if model.assets.identities != corpus.assets.identities or model.n_vertices != data.n_vertices:
            raise FaceDiffError(
                f"{name}: is a model of {model.assets.corpus} with other speakers or vertices than those of "
                f"{data.corpus_name} that are measured on; measure it by itself"
            )
        if sampling.low_latency:
            model.choose_low_latency()
        if sampling.sampler is not None or sampling.steps is not None:
            model.choose_sampler(sampling.sampler, sampling.steps)
        if sampling.expressivity is not None:
            model.choose_expressivity(sampling.expressivity)
        described.add(sampler_of(model))
        for split, dataset in datasets.items():
            measurement = Measurement(model, corpus, sampling)
            measurement.warm_up(dataset[chosen[split][0]])
            for place in chosen[split]:
                measurement.add(dataset.clips[place], dataset[place])
                step()
            for metric, value in measurement.result().items():
                values[split][metric].append(value)
            drawn = measurement.drawn
    return GenerationScores(
        corpus=corpus.assets.corpus,
        synthetic=corpus.assets.synthetic,
        checkpoints=list(models),
        sampler=", ".join(sorted(described)),
        samples=drawn,
        speakers=len({*corpus.gallery.speakers}) if corpus.gallery is not None else 0,
        clips={split: len(places) for split, places in chosen.items()},
        values=values,
        missing=corpus.missing,
    )


def picked(dataset: MotionDataset, most: int | None) -> list[int]:
    """The clips that are measured: all, or at most ``most``, evenly spread."""
    count = len(dataset)
    if most is None or count <= most:
        return list(range(count))
    return [math.floor(place * count / most) for place in range(most)]


def sampler_of(model: AnimationModel) -> str:
    """How a model samples, in words."""
    if not model.samples:
        return f"{type(model).__name__} without noise"
    sampler = getattr(model, "sampler", None)
    if sampler is None:
        return type(model).__name__
    description = f"{name_of(type(sampler))} with {counted(sampler.steps, 'step')}"
    own = model.expressivity
    if isinstance(own, Tensor):
        return f"{description}, expressivity by vertex"
    return description if own == 1 else f"{description}, expressivity {own:g}"
