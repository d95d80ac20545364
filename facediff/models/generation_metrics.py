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
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.data import Batch, Clip, Sample, SpeechMotionDataModule, collate
from facediff.data.articulation import MouthMotion, articulation, mouth_motion
from facediff.data.batch import UNKNOWN_IDENTITY
from facediff.data.corpus import LIP_TEETH_PAIRS
from facediff.data.dataset import MotionDataset
from facediff.errors import FaceDiffError
from facediff.metrics import (
    MeanVertexError,
    RealTimeFactor,
    device_name,
    feed,
    parse,
)
from facediff.models.base import AnimationModel
from facediff.models.evaluation import with_usual_styles
from facediff.models.scoring import ScoredCorpus
from facediff.spaces.space import METRES
from facediff.speech.phonemes import phonemes_file, read_phonemes
from facediff.utils import ranges
from facediff.utils.ranges import Range

REFERENCES = ("own", "another")
"""Owner of the reference that gives the style: the speaker, or another one in the same mood."""

LABELS = ("hidden", "known")
"""Whether the model is told who a trained speaker is."""

NEAREST_SPEAKER = "nearest_speaker_accuracy:components=64"

TABLE: dict[str, tuple[str, ...]] = {
    "liveliness_upper_face": ("liveliness of the upper face (1)", "each", "motion_liveliness:region=upper_face"),
    "liveliness_lips": ("liveliness of the lips (1)", "each", "motion_liveliness:region=lips"),
    "spectrum_upper_face": (
        "spectrum of the upper face: decibels off (0)",
        "each",
        "spectrum_distance:region=upper_face",
    ),
    "difference_ratio_upper_face": (
        "difference ratio of the upper face / truth's (1)",
        "each",
        "difference_ratio:region=upper_face",
    ),
    "difference_ratio_lips": ("difference ratio of the lips / truth's (1)", "each", "difference_ratio:region=lips"),
    "frame_step_upper_face": ("frame step of the upper face / truth's (1)", "each", "frame_step:region=upper_face"),
    "frame_step_lips": ("frame step of the lips / truth's (1)", "each", "frame_step:region=lips"),
    "spread_face": ("spread / error, whole face (1)", "samples", "spread_error_ratio"),
    "spread_upper_face": ("spread / error, upper face (1)", "samples", "spread_error_ratio:region=upper_face"),
    "spread_lips": ("spread / error, lips (1)", "samples", "spread_error_ratio:region=lips"),
    "variance_upper_face": (
        "spread / error in variances, upper face (1)",
        "samples",
        "spread_error_ratio:region=upper_face,squared=true",
    ),
    "variance_lips": (
        "spread / error in variances, lips (1)",
        "samples",
        "spread_error_ratio:region=lips,squared=true",
    ),
    "blink_ratio": ("blink rate / truth's (1)", "each", "blink_rate_ratio"),
    "blinks_a_minute": ("blinks a minute", "each", "blink_rate"),
    "true_blinks_a_minute": ("blinks a minute, truth", "each", "blink_rate:of=truth"),
    "eyelid_drift": ("eyelid drift between blinks / truth's (1)", "each", "eyelid_drift"),
    "fdd_still": ("FDD / still face's (0)",),
    "fdd_signed_still": ("FDD, signed / still face's (0)",),
    "lve": ("LVE, one sample", "each", "lip_vertex_error"),
    "lve_still": ("LVE / still face's, one sample",),
    "lve_default_still": ("LVE / still face's, one sample, with the style that animate takes",),
    "lve_mean_still": ("LVE / still face's, mean of {samples} samples",),
    "lve_best_still": ("LVE / still face's, best of {samples} samples",),
    "lve_mean_face": ("LVE / mean face's, one sample",),
    "lve_mean_mean_face": ("LVE / mean face's, mean of {samples} samples",),
    "lve_best_mean_face": ("LVE / mean face's, best of {samples} samples",),
    "mve": ("MVE, one sample", "each", "mean_vertex_error"),
    "energy_lips": ("energy score of the lips", "samples", "energy_score:region=lips"),
    "energy_upper_face": ("energy score of the upper face", "samples", "energy_score:region=upper_face"),
    "closure_auc": ("lips nearer at p, b, m than at other sounds, AUC / truth's (1)",),
    "closed": ("lips within 1 mm at p, b, m / truth's (1)",),
    "chance": ("the same at other sounds / truth's (1)",),
    "open_vowels": ("opening of open vowels / truth's (1)",),
    "rounding": ("narrowing at u, o, w / truth's (1)",),
    "contact": ("lower lip at the teeth for f, v / truth's (1)",),
    "nearest_speaker": (
        "nearest speaker is right, identity hidden (1; chance {chance})",
        "own_reference",
        NEAREST_SPEAKER,
    ),
    "true_nearest_speaker": ("nearest speaker is right, truth", "truth", NEAREST_SPEAKER),
    **{f"mve_{label}_another": (f"MVE with another speaker's reference / own, identity {label}",) for label in LABELS},
    "mve_hidden_own": ("MVE with own reference, identity hidden",),
    "mve_known_own": ("MVE with own reference, identity known",),
    "real_time_factor": ("real-time factor, one sample",),
}
"""By the names of the metrics in files: their titles, in parentheses the score of the truth itself, or of a model that
draws from the truth's distribution; the group of motions that a metric is taken of, and the metric by name."""

GENERATION_METRICS = {name: title for name, (title, *_) in TABLE.items()}
"""Titles by name."""

UNTITLED: dict[str, dict[str, str]] = {
    "each": {"fdd": "face_dynamics_deviation", "fdd_signed": "face_dynamics_deviation:sign=signed"},
    "samples": {"lve_mean": "mean_estimate_error", "lve_best": "coverage_error"},
    "still": {
        "still_lve": "lip_vertex_error",
        "still_fdd": "face_dynamics_deviation",
        "still_fdd_signed": "face_dynamics_deviation:sign=signed",
    },
    "mean_face": {"mean_face_lve": "lip_vertex_error"},
    "default_style": {"lve_default": "lip_vertex_error"},
}
"""Metrics by group that are parts of ratios."""

GROUPS = {
    group: {name: row[2] for name, row in TABLE.items() if row[1:2] == (group,)} | UNTITLED.get(group, {})
    for group in ("each", "samples", "still", "mean_face", "truth", "own_reference", "default_style")
}
"""Requests by name: of each sample by itself, of all samples of a clip together, of two faces that do not move, of the
truth itself, of samples with the clip's own reference, and with the style that ``animate`` takes."""

NEEDED = {"nearest_speaker": ("gallery",), "blink_ratio": ("lid_pairs",), "closed": ("closures", "lip_pairs")}
"""Metrics for which a corpus may have no files, and the files."""


@dataclass(frozen=True)
class SamplingOptions:
    """How a model is asked for motion.

    Attributes:
        samples: of each clip; the spread of a model needs two.
        references: samples of each clip with each reference.
        sampler: by name; the checkpoint's if None.
        steps: of the sampler; the sampler's own if None.
        seed: of the first sample; the others follow.
        expressivity: 0 for the mean prediction, 1 for a sample; the checkpoint's if None.
        low_latency: frame by frame, as speech arrives.
    """

    samples: Annotated[int, Range(2, 1000)] = 10
    references: ranges.Samples = 2
    sampler: str | None = None
    steps: ranges.Steps | None = None
    seed: ranges.Seed = 0
    expressivity: ranges.Expressivity | None = None
    low_latency: bool = False

    def __post_init__(self) -> None:
        """Check the numbers."""
        ranges.check_options(self)


class EvaluationCorpus(ScoredCorpus):
    """What measuring needs of a corpus in addition to its clips; made once for all models and splits."""

    def __init__(self, data: SpeechMotionDataModule) -> None:
        compared, assets = data.compared_speakers, data.assets()
        speakers = sorted(name for name in assets.templates if compared is None or name in compared)
        super().__init__(data, assets, speakers)
        self.needs = {need for table in GROUPS.values() for text in table.values() for need in parse(text).needs}
        self.teeth = None if data.mesh_corpus is None else data.mesh_corpus.read_pairs(LIP_TEETH_PAIRS)
        context = self.context(self.needs, torch.device("cpu"))
        # Of a model without noise all samples are one.
        self.offered = replace(context, has={**context.has, "samples": {}})
        lacking = [(name, need) for name, needs in NEEDED.items() for need in needs if need not in self.offered.has]
        self.reasons = {name: self.offered.reasons[need] for name, need in lacking}

    def metrics(self, group: str, device: torch.device, **options: Any) -> dict[str, Metric]:  # noqa: ANN401
        """The metrics of a group that the corpus has all for, with further options."""
        requests = {name: parse(text) for name, text in GROUPS[group].items()}
        return {
            name: replace(request, options={**request.options, **options}).build(self.offered).to(device)
            for name, request in requests.items()
            if set(request.needs) <= self.offered.has.keys()
        }

    def mouths(self, clip: Clip, *motions: Tensor) -> list[MouthMotion]:
        """The mouth of motions (frames, V, 3) of a clip; none where lips, lengths or phonemes are not known."""
        scored, file = self.assets.scored, phonemes_file(self.data.root, clip.name)
        if file is None or scored.inner_lip_pairs is None or scored.unit not in METRES:
            return []
        rest = scored.template(clip.identity).cpu().numpy()
        measured = partial(
            mouth_motion,
            template=rest,
            lip_pairs=scored.inner_lip_pairs.cpu().numpy(),
            millimetres=1000 * METRES[scored.unit],
            frame_rate=scored.frame_rate,
            phonemes=read_phonemes(file),
            lip_teeth_pairs=None if self.teeth is None else self.teeth.numpy(),
        )
        return [measured(motion.cpu().numpy() + rest) for motion in motions]

    def references(self, clip: Clip, template: str) -> dict[str, Clip]:
        """A clip's references by their owner; ``template`` is the name of the usual one."""
        candidates, names = self.data.reference_policy().candidates, self.data.reference_attributes
        own = [candidate for candidate in candidates.get(clip.identity, ()) if candidate.name == template]
        another = [
            candidate
            for name in self.speakers
            for candidate in candidates.get(name, ())
            if name != clip.identity and all(candidate.attributes.get(key) == clip.attributes.get(key) for key in names)
        ]
        # By chance, but the same for every model: speakers are met about equally often.
        return {
            whose: clips[zlib.crc32(f"{clip.name}/{whose}".encode()) % len(clips)]
            for whose, clips in zip(REFERENCES, (own, another), strict=True)
            if clips
        }


class Measurement:
    """All metrics of one model on one split."""

    def __init__(self, model: AnimationModel, corpus: EvaluationCorpus, sampling: SamplingOptions) -> None:
        self.model, self.corpus, self.sampling = model, corpus, sampling
        # Without noise all samples are one: their spread is zero, and the energy score is the distance itself.
        self.drawn = sampling.samples if model.samples else 1
        self.compared = max(2, self.drawn)
        device, count = model.device, self.compared
        self.metrics: dict[str, dict[str, Metric]] = {
            group: corpus.metrics(group, device, **({"n_samples": count} if group == "samples" else {}))
            for group in GROUPS
        }
        self.metrics["references"] = {
            f"{label}_{whose}": MeanVertexError().to(device) for label in LABELS for whose in REFERENCES
        }
        self.speed = RealTimeFactor(device_name(device))
        self.mouths: list[list[MouthMotion]] = []  # of each clip: made and true

    def _update(self, group: str, inputs: Mapping[str, Any]) -> None:
        for metric in self.metrics[group].values():
            feed(metric, inputs)

    @torch.inference_mode()
    def add(self, clip: Clip, sample: Sample) -> None:
        """Generate motion for a clip, and score it."""
        batch, corpus = self.model.with_person_styles(collate([sample]).to(self.model.device)), self.corpus
        sides = (self._samples(batch)[None], batch.motion)  # of vertices, where a rig decodes them
        motion, truth = (corpus.decoded(side, batch.identity_names) for side in sides)
        inputs = corpus.inputs(truth, truth, batch, corpus.needs)
        self._update("samples", {**inputs, "samples": motion.expand(-1, self.compared, -1, -1, -1)})
        for one_sample in motion.unbind(1):
            self._update("each", {**inputs, "prediction": one_sample})
        if mouths := corpus.mouths(clip, motion[0, 0], truth[0]):
            self.mouths.append(mouths)
        mean = corpus.decoded(corpus.mean_faces.of([clip.identity]).to(batch.motion)[:, None], [clip.identity])
        faces = {"still": torch.zeros_like(truth), "mean_face": mean.expand_as(truth), "truth": truth}
        for face, motion in faces.items():
            self._update(face, {**inputs, "prediction": motion})
        self._add_references(clip, sample)

    def _samples(self, batch: Batch) -> Tensor:
        """Samples of a clip (drawn, frames, V, 3); the first one is timed, alone as `facediff animate` makes it."""
        seeds = range(self.sampling.seed, self.sampling.seed + self.drawn)
        with self.speed.measure(batch.motion.shape[1] / self.corpus.assets.frame_rate):
            first = self.model.sample_clip(batch, seeds[:1])
        return torch.cat([first, self.model.sample_clip(batch, seeds[1:])]) if self.drawn > 1 else first

    def warm_up(self, sample: Sample) -> None:
        """Generate once without a measurement: the first call makes what later ones find."""
        with torch.inference_mode():
            self.model.sample_clip(collate([sample]).to(self.model.device), [self.sampling.seed])

    def _add_references(self, clip: Clip, sample: Sample) -> None:
        """Score motion with other references, with the label of a trained speaker and without."""
        views, corpus = dict(self._views(clip, sample)), self.corpus
        batch = collate(list(views.values())).to(self.model.device)
        usual = with_usual_styles(collate([sample]).to(self.model.device), self.model.default_style)
        default, names = next(iter(usual), None), batch.identity_names
        truth = corpus.decoded(batch.motion, names)
        for seed in range(self.sampling.seed, self.sampling.seed + (self.sampling.references if self.drawn > 1 else 1)):
            if default is not None:
                motion = corpus.decoded(self.model.generate(default, seed=seed), default.identity_names)
                self._update("default_style", {"prediction": motion, "truth": truth[:1]})
            generated = corpus.decoded(self.model.generate(batch, seed=seed), names)
            for number, name in enumerate(views):
                self.metrics["references"][name].update(generated[number], truth[number])
                if name == "hidden_own":
                    numbers = corpus.numbers(batch)[:1]
                    self._update("own_reference", {"prediction": generated[number], "identities": numbers})

    def _views(self, clip: Clip, sample: Sample) -> list[tuple[str, Sample]]:
        views, data = [], self.corpus.data
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

    def result(self) -> dict[str, float | None]:
        """The value of every metric, in the order of :data:`GENERATION_METRICS`; None where there is none."""
        raw: dict[str, float] = {}
        everything = {name: metric for group in self.metrics.values() for name, metric in group.items()}
        for name, metric in {**everything, "real_time_factor": self.speed}.items():
            if metric.update_called:
                with suppress(ValueError):  # no value on any sequence
                    raw[name] = float(metric.compute())

        if self.mouths:
            made, true = (articulation(mouths) for mouths in zip(*self.mouths, strict=True))
            raw |= {name: value for name, value in made.shares_of(true).items() if math.isfinite(value)}

        def ratio(above: str, below: str) -> float | None:
            numerator, denominator = raw.get(above), raw.get(below)
            return None if numerator is None or not denominator else numerator / denominator

        values: dict[str, float | None] = {
            **raw,
            "fdd_still": ratio("fdd", "still_fdd"),
            "fdd_signed_still": ratio("fdd_signed", "still_fdd_signed"),
            **{
                f"{name}_{face}": ratio(name, f"{face}_lve")
                for name in ("lve", "lve_mean", "lve_best")
                for face in ("still", "mean_face")
            },
            "lve_default_still": ratio("lve_default", "still_lve"),
            **{f"mve_{label}_another": ratio(f"{label}_another", f"{label}_own") for label in LABELS},
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
        checkpoints: the measured models.
        sampler: how motion was sampled, in words.
        samples: of each clip; 1 for a model without noise.
        speakers: among how many the nearest one was looked for; 0 if it was not.
        clips: how many, by split.
        values: one for each checkpoint, by split and metric.
        missing: why metrics have no value.
    """

    corpus: str
    synthetic: bool
    checkpoints: list[str]
    sampler: str
    samples: int
    speakers: int
    clips: dict[str, int]
    values: dict[str, dict[str, list[float | None]]]
    missing: dict[str, str]

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
        return [
            {
                **{"split": split, "metric": name, "title": self.title(name)},
                **{"mean": self.mean(split, name), "std": self.deviation(split, name)},
                **{f"value_{number}": value for number, value in enumerate(values[name], 1)},
            }
            for split, values in self.values.items()
            for name in GENERATION_METRICS
        ]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        facts = {name: value for name, value in vars(self).items() if name != "values"}
        keys = ("split", "metric", "title", "mean", "std")
        scores = [
            {key: row[key] for key in keys} | {"values": self.values[row["split"]][row["metric"]]}
            for row in self.rows()
        ]
        return {"format": "facediff generation metrics 1", **facts, "metrics": scores}


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
        data: the corpus, with its folder.
        splits: ``val``, ``test_a``, ``test_b``; all test splits if None.
        sampling: how they are asked for motion.
        most_clips: clips of a split, evenly spread; all if None.
        step: called after each clip of each model.
    """
    sampling = sampling or SamplingOptions()
    corpus = EvaluationCorpus(data)
    datasets = {split: data.dataset(split) for split in splits or data.test_splits}
    clips_of = {split: picked(dataset, most_clips) for split, dataset in datasets.items()}
    values: dict[str, dict[str, list[float | None]]] = {
        split: {name: [] for name in GENERATION_METRICS} for split in datasets
    }
    described: set[str] = set()
    n_samples = 1
    for name, load in models.items():
        model = load()
        mine, measured = (
            (assets.identities, assets.frame_rate, assets.unit, assets.space)
            for assets in (model.assets, corpus.assets)
        )
        if mine != measured or model.n_vertices != data.n_vertices:
            raise FaceDiffError(
                f"{name}: is a model of {model.assets.corpus} with other speakers, vertices, frame rate or unit than "
                f"those of {data.corpus_name} that are measured on; measure it by itself"
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
            measurement.warm_up(dataset[clips_of[split][0]])
            for clip_index in clips_of[split]:
                measurement.add(dataset.clips[clip_index], dataset[clip_index])
                step()
            for metric, value in measurement.result().items():
                values[split][metric].append(value)
            n_samples = measurement.drawn
    gallery = corpus.offered.has.get("gallery")
    return GenerationScores(
        corpus=corpus.assets.corpus,
        synthetic=corpus.assets.synthetic,
        checkpoints=list(models),
        sampler=", ".join(sorted(described)),
        samples=n_samples,
        speakers=len({*gallery["gallery"].speakers}) if gallery else 0,
        clips={split: len(indices) for split, indices in clips_of.items()},
        values=values,
        missing=corpus.reasons,
    )


def picked(dataset: MotionDataset, limit: int | None) -> list[int]:
    """The clips that are measured: all, or at most ``limit``, evenly spread."""
    count = len(dataset)
    if limit is None or count <= limit:
        return list(range(count))
    return [math.floor(number * count / limit) for number in range(limit)]


def sampler_of(model: AnimationModel) -> str:
    """How a model samples, in words."""
    if not model.samples:
        return f"{type(model).__name__} without noise"
    sampler = getattr(model, "sampler", None)
    if sampler is None:
        return type(model).__name__
    description = str(sampler)
    expressivity = model.expressivity
    if isinstance(expressivity, Tensor):
        return f"{description}, expressivity by vertex"
    return description if expressivity == 1 else f"{description}, expressivity {expressivity:g}"
