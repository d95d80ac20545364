"""Scores of a test: the model, two faces that never move, and the model given another sentence's speech."""

from __future__ import annotations

import contextlib
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor
from torchmetrics import Metric

from facediff.data import Assets, Batch, Reference, SpeechMotionDataModule
from facediff.data.batch import pad
from facediff.errors import ArgumentError, FaceDiffError, damaged
from facediff.metrics import (
    Context,
    EnergyScore,
    ProtocolMetrics,
    Region,
    SequenceMetric,
    describe_column,
    feed,
    protocol,
)
from facediff.metrics.by_name import parse_all
from facediff.metrics.generation import SMOOTHNESS
from facediff.models.inference import Inference, Style, named
from facediff.models.scoring import ScoredCorpus, regions_of
from facediff.spaces.space import metres_per_unit

IdentityPolicy = Literal["style_only", "each_seen"]
"""Which identity unseen speakers are tested and predicted with. ``style_only``: none, with their reference's style.
``each_seen``: each training identity in turn, with that identity's own style, and the mean of the scores, as the
released test scripts do."""


def conditioned(
    batch: Batch, policy: IdentityPolicy, identities: Sequence[str], references: Mapping[str, Reference | Style]
) -> list[tuple[str, Batch]]:
    """Copies of a batch, one per identity that unseen speakers are conditioned on, with that identity's name.

    A clip of a training identity comes once. ``identities`` are in the order of the identity index.
    """
    clips = [clip for clip, index in enumerate(batch.identity.tolist()) if index >= 0]
    unknown = [clip for clip in range(len(batch)) if clip not in clips]
    if not unknown or policy == "style_only":
        return [("", batch)]
    views = [("", batch.select(clips))] if clips else []
    unseen = batch.select(unknown)
    for index, name in enumerate(identities):
        views.append((name, with_identity(unseen, index, references[name])))
    return views


def with_identity(batch: Batch, index: int, reference: Reference | Style) -> Batch:
    """The batch as if all clips were of one training identity, with that identity's style."""
    batch = replace(
        batch, identity=batch.identity.new_full((len(batch),), index), reference_names=[named(reference)] * len(batch)
    )
    if isinstance(reference, Style):
        return replace(batch, style=reference.vector.to(batch.reference).expand(len(batch), -1))
    motion = reference.motion.to(batch.reference)
    lengths = batch.reference_lengths.new_full((len(batch),), len(motion))
    return replace(batch, reference=pad([motion] * len(batch)), reference_lengths=lengths, style=None)


def with_usual_styles(batch: Batch, style_of: Callable[[str], Reference | Style]) -> list[Batch]:
    """The clips as ``animate`` makes them without ``--style``, in one batch for each identity that has one.

    A clip that is itself that style is left out: a speaker of evaluated clips only has one of them as reference.
    """
    views = []
    for name in dict.fromkeys(batch.identity_names):
        try:
            style = style_of(name)
        except FaceDiffError:  # nobody animates as this identity without naming a style
            continue
        identities = zip(batch.identity_names, batch.names, strict=True)
        clips = [index for index, clip in enumerate(identities) if clip[0] == name and clip[1] != named(style)]
        if clips and (not isinstance(style, Style) or style.vector.numel()):
            views.append(with_identity(batch.select(clips), int(batch.identity[clips[0]]), style))
    return views


def to_shuffle(name: str, view: Batch, identities: Sequence[str]) -> Batch | None:
    """The clips of a view of :func:`conditioned` that are tested with another sentence's speech; None if none is.

    Every clip is so once: under each identity that an unseen speaker is conditioned on, it would double a test's time.
    The hash of the clip's name decides under which.
    """
    turns = [identities[zlib.crc32(clip.encode()) % len(identities)] for clip in view.names]
    clips = [index for index, turn in enumerate(turns) if name in ("", turn)]
    return view.select(clips) if clips and view.decoy_audio is not None else None


def count_generations(data: SpeechMotionDataModule, policy: str, samples: int) -> int:
    """How many animations a test generates, without those for further metrics and for the usual style.

    Args:
        data: the corpus.
        policy: an :data:`IdentityPolicy`.
        samples: of each clip for the mean of several; 1 for none.
    """
    turns = len(data.identities) if policy == "each_seen" else 1
    of_view = 1 + (samples if samples > 1 else 0)
    clips = [clip for split in data.test_splits for clip in data.clips(split)]
    return sum((1 if clip.identity in data.identities else turns) * of_view + 1 for clip in clips)


METHODS = {
    "model": "{model}",
    "sample_mean": "{model}, mean of samples",
    "usual_style": "{model}, the style that animate takes",
    "still": "still face",
    "mean_face": "speaker's mean face",
    "shuffled": "{model}, shuffled speech",
}
"""Methods that are scored, and what tables call them: one sample of the model; the mean of several, where a test is
asked for them; the model with the style that ``animate`` takes where none is given; a face that never moves from its
template, or from the mean of its speaker's training clips; the model given another sentence's speech."""

ENERGY_REGIONS = ("lips", "upper_face")
"""Regions of the energy scores by which the best checkpoint is chosen."""

PARAMETERS = "param_"
"""How the names of scores begin that are taken of the channels of a parametric space."""

OF_THE_MODEL = {"samples", "conditions", "time"}
"""Needs that only the model meets: metrics that have one are not taken of a still face or of shuffled speech."""


@contextlib.contextmanager
def argument(name: str, value: object) -> Iterator[None]:
    """Name an option of the model in errors of its value."""
    try:
        yield
    except (FaceDiffError, ValueError) as error:
        raise ArgumentError({name: value}, str(error), located=True) from error


class Evaluation:
    """Metrics of one protocol, and ``metrics`` chosen by name with their options, for every split and method.

    No part of the model's module tree: weight averaging copies that tree before the regions are known.
    """

    corpus: ScoredCorpus

    def __init__(
        self,
        protocol_name: str,
        unseen_identity: str,
        metrics: Sequence[str] = (),
        validation_samples: int = 2,
    ) -> None:
        with argument("model.protocol", protocol_name):
            self.protocol = protocol(protocol_name)
        self.unseen_identity = unseen_identity
        self.validation_samples = validation_samples
        self.energies: dict[str, EnergyScore] = {}
        with argument("model.metrics", list(metrics)):
            self.requests = {request.text: request for request in parse_all(metrics)}
        self.requests |= self.protocol.further()
        self.needs = {need for request in self.requests.values() for need in request.needs}
        self.splits: list[str] = []
        self.metrics: dict[str, dict[str, ProtocolMetrics]] = {}
        self.chosen: dict[str, dict[str, dict[str, Metric]]] = {}
        self._sequences: list[dict[str, Any]] = []
        self._validation_seeds = range(1)

    def prepare(
        self, model: Inference, splits: Sequence[str], device: torch.device, data: SpeechMotionDataModule | None
    ) -> None:
        """Make empty metrics for a corpus, on the device where processes reduce them."""
        if data is None and self.requests:
            raise FaceDiffError("model.metrics needs a SpeechMotionDataModule; pass datamodule=…")
        assets, corpus = model.assets, ScoredCorpus(data, model.assets)
        self.corpus = corpus
        self._check_space(assets)
        scale = self._scale(assets)
        self.requests |= self.protocol.further(scale)
        of_protocol = regions_of(assets) if self.protocol.channels else corpus.regions
        self.splits = list(splits)
        self._sequences = []
        self._prepare_energies(model, corpus.regions, device)
        methods = list(METHODS) if self.splits != ["val"] else ["model"]
        self.metrics = {
            split: {
                method: self.protocol.build(of_protocol["lips"], of_protocol["upper_face"], scale=scale).to(device)
                for method in methods
            }
            for split in self.splits
        }
        context = self._context(model, corpus, device) if self.requests else Context()
        self.chosen = {
            split: {
                method: {
                    name: request.build(context).to(device)
                    for name, request in self.requests.items()
                    if method == "model" or not OF_THE_MODEL & set(request.needs)
                }
                | self._of_channels(assets, device)
                | self._smoothness(corpus.regions, device)
                for method in methods
            }
            for split in self.splits
        }

    def _check_space(self, assets: Assets) -> None:
        """Refuse a protocol that needs vertices, or channels, of a corpus that has none."""
        vertices, protocol = assets.space.is_vertices, self.protocol
        # Before there were protocols of parameters, channels without a known rig took the vertices' protocols.
        if (protocol.channels and vertices) or (protocol.unit is not None and not vertices and assets.rig is None):
            problem = "scores channels" if protocol.channels else f"scores vertices in {protocol.unit}"
            lack = "has vertices" if vertices else "has channels without a rig that decodes them"
            raise FaceDiffError(
                f"protocol {protocol.name} {problem}, and {assets.corpus} {lack}; choose another --model.protocol"
            )

    def _scale(self, assets: Assets) -> float:
        """The factor of lengths from the corpus's unit to the protocol's."""
        if self.protocol.unit is None:
            return 1.0
        return metres_per_unit(assets.scored.unit) / metres_per_unit(self.protocol.unit)

    def _of_channels(self, assets: Assets, device: torch.device) -> dict[str, Metric]:
        """The formulas of vertices on the channels themselves, of parametric spaces."""
        if assets.space.is_vertices or self.protocol.channels:
            return {}
        metrics = self.protocol.build(*(regions_of(assets)[name] for name in ("lips", "upper_face")))
        return {f"{PARAMETERS}{name}": metric.to(device) for name, metric in metrics.scores().items()}

    def _smoothness(self, regions: Mapping[str, Region], device: torch.device) -> dict[str, Metric]:
        """Difference ratio and frame step by region, of tests."""
        if self.splits == ["val"]:
            return {}
        return {name: metric(regions[region]).to(device) for name, (metric, region) in SMOOTHNESS.items()}

    def _prepare_energies(self, model: Inference, regions: Mapping[str, Region], device: torch.device) -> None:
        """Make the energy scores of validation, of the model and of a still face, by region."""
        self.energies = {}
        if self.splits != ["val"]:
            return
        # Without noise, samples would be one and the same, and the score is the distance from the truth.
        self._validation_seeds = range(self.validation_samples if model.samples else 1)
        count = max(2, len(self._validation_seeds))
        self.energies = {
            f"{who}/{name}": EnergyScore(regions[name], n_samples=count).to(device)
            for who in ("model", "still")
            for name in ENERGY_REGIONS
        }

    def _add_energies(self, samples: Tensor, batch: Batch) -> None:
        """Add a validation batch's samples (batch, samples, frames, V, 3), and a still face's."""
        if batch.repeated:
            return
        samples, truth = (self.corpus.decoded(motion, batch.identity_names) for motion in (samples, batch.motion))
        for name, metric in self.energies.items():
            generated = torch.zeros_like(samples) if name.startswith("still") else samples
            repeated = generated[:, : metric.n_samples].expand(-1, metric.n_samples, -1, -1, -1)
            metric.to(samples.device).update(repeated, truth, lengths=batch.frame_lengths, clip_names=batch.names)

    def _energy(self) -> float | None:
        """The energy score over the still face's, mean of the regions; empties the metrics."""
        shares = []
        for name in ENERGY_REGIONS if self.energies else ():
            with contextlib.suppress(ValueError):  # nothing was validated
                score, still = (float(self.energies[f"{who}/{name}"].compute()) for who in ("model", "still"))
                shares += [score / still] if still else []
        for metric in self.energies.values():
            metric.reset()
        return sum(shares) / len(shares) if shares else None

    def _context(self, model: Inference, corpus: ScoredCorpus, device: torch.device) -> Context:
        """Inputs of metrics that the corpus and the model have, and reasons why they lack the rest."""
        context, name = corpus.context(self.needs, device), type(model).__name__
        conditions = {"samples": model.samples, "conditions": len(self._styles(model)) > 1}
        reasons = {
            "samples": f"{name} is deterministic",
            "conditions": "the corpus has no style references of two training identities",
        }
        has = {**context.has, **{need: {} for need, fulfilled in conditions.items() if fulfilled}}
        return replace(context, has=has, reasons={**context.reasons, **reasons})

    @staticmethod
    def _styles(model: Inference) -> dict[int, Reference | Style]:
        """Styles of the training identities that have a stored reference, by index."""
        assets = model.assets
        referenced = [(index, name) for index, name in enumerate(assets.identities) if name in assets.references]
        return {index: model.default_style(name) for index, name in referenced}

    def score(self, model: Inference, split: str, batch: Batch, identity: str = "") -> None:
        """Generate a batch's motion, with all that metrics need of the model, and add its scores.

        ``identity`` is the one that all clips are generated with, if it is not their own.
        """
        start = self._clock(model)
        motion = model.generate(batch, seed=0)
        seconds = float(batch.frame_lengths.sum()) / model.assets.frame_rate
        inputs: dict[str, Any] = {"computing": self._clock(model) - start, "speech": seconds}
        if not batch.repeated:
            requests = self.chosen[split]["model"].values()
            count = len(self._validation_seeds) if self.energies else 1
            if "samples" in self.needs:
                count = max(count, *(int(getattr(metric, "n_samples", 1)) for metric in requests))
            # A sample is the seed of its noise; the first is the motion that all other metrics score.
            if count > 1 or self.energies or "samples" in self.needs:
                more = [model.generate(batch, seed=seed) for seed in range(1, count)]
                inputs["samples"] = torch.stack([motion, *more], 1)
            if self.energies:
                self._add_energies(inputs["samples"][:, : len(self._validation_seeds)], batch)
            if "conditions" in self.needs:
                views = [with_identity(batch, index, style) for index, style in self._styles(model).items()]
                inputs["predictions"] = torch.stack([model.generate(view, seed=0) for view in views], 1)
        self.update(split, "model", motion, batch, identity, inputs)

    def score_baselines(self, split: str, batch: Batch) -> None:
        """Add the scores of two faces that do not move: the template, and the mean of the speaker's training clips."""
        self.update(split, "still", torch.zeros_like(batch.motion), batch)
        if self.corpus.data.clips("train"):  # else there is no row, as with shuffled speech
            faces = self.corpus.mean_faces.of(batch.identity_names).to(batch.motion)
            self.update(split, "mean_face", faces[:, None] * batch.mask[..., None, None], batch)

    def _clock(self, model: Inference) -> float:
        """Seconds; work on a GPU is waited for where a metric asks how long inference took."""
        if "time" in self.needs and model.device.type == "cuda":
            torch.cuda.synchronize(model.device)
        return time.perf_counter()

    def update(
        self,
        split: str,
        method: str,
        motion: Tensor,
        batch: Batch,
        identity: str = "",
        inputs: Mapping[str, Any] | None = None,
    ) -> None:
        """Add a batch's motion (offsets from the template), unless another process adds the same clips.

        ``inputs`` is what metrics chosen by name read in addition, by the name under which they take it.
        """
        if batch.repeated:
            return
        corpus, names, metrics = self.corpus, batch.identity_names, self.metrics[split][method].to(motion.device)
        channels: dict[str, Any] = {"prediction": motion, "truth": batch.motion}
        motion, truth = corpus.decoded(motion, names), corpus.decoded(batch.motion, names)
        sides = (channels["prediction"], channels["truth"]) if self.protocol.channels else (motion, truth)
        metrics.update(*sides, lengths=batch.frame_lengths, clip_names=batch.names)
        scores: dict[str, Metric] = {**metrics.scores()}
        inputs = dict(inputs or {})
        for name in ("samples", "predictions"):  # several motions of each clip
            if name in inputs:
                inputs[name] = corpus.decoded(inputs[name], names)
        inputs = corpus.inputs(motion, truth, batch, self.needs) | inputs if self.chosen[split][method] else {}
        for name, metric in self.chosen[split][method].items():
            request = self.requests.get(name)
            of_channels = name.startswith(PARAMETERS) if request is None else request.of_channels
            own_inputs = inputs | channels if of_channels else inputs
            if "samples" in inputs and hasattr(metric, "n_samples"):
                own_inputs = inputs | {"samples": inputs["samples"][:, : metric.n_samples]}
            with damaged(f"metric {name}", "check the corpus with `facediff data check`"):
                feed(metric.to(motion.device), own_inputs, "all" if request is None else request.moment)
            scores[name] = metric
        if split == "val":
            return
        values = {
            name: metric.latest.tolist()
            for name, metric in scores.items()
            if isinstance(metric, SequenceMetric) and metric.latest is not None
        }
        for row, (clip, frames) in enumerate(zip(batch.names, batch.frame_lengths.tolist(), strict=True)):
            clip_scores = {name: scores_of_clips[row] for name, scores_of_clips in values.items()}
            facts = {"split": split, "method": method, "clip": clip, "identity": identity, "frames": frames}
            attributes = {} if corpus.data is None else corpus.data.corpus.clips[clip].attributes
            columns = () if corpus.data is None else corpus.data.score_attributes
            self._sequences.append({**facts, **{name: attributes.get(name) for name in columns}, **clip_scores})

    def sequences(self) -> list[dict[str, Any]]:
        """One row per test clip and method with its own scores, of all processes; collective under several.

        All rows have the same keys; None stands where a metric has no value.
        """
        rows = self._sequences
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            shares: list[Any] = [None] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(shares, rows)
            rows = [row for share in shares for row in share]
        methods = list(METHODS)
        rows = sorted(rows, key=lambda row: (row["split"], methods.index(row["method"]), row["clip"], row["identity"]))
        keys = dict.fromkeys(key for row in rows for key in row)
        # NaN, which alone differs from itself, is a clip that a metric leaves out.
        return [{key: None if row.get(key) != row.get(key) else row.get(key) for key in keys} for row in rows]

    def scalars(self, split: str) -> dict[str, float]:
        """``<split>/<metric>`` of the model and ``<split>/<method>/<metric>`` of the others; empties the metrics.

        For validation ``val/energy`` too, by which the best checkpoint is chosen: the energy score of lips and upper
        face, each over the still face's. No mean face can win it.
        """
        scalars: dict[str, float] = {}
        for row in self.rows(split):
            prefix = split if row["method"] == "model" else f"{split}/{row['method']}"
            names = [*map(str, self.metrics[split]["model"]), *self.chosen[split]["model"]]
            scalars |= {f"{prefix}/{name}": row[name] for name in names if row[name] is not None}
        if (energy := self._energy()) is not None:
            scalars[f"{split}/energy"] = energy
        for metrics in self.metrics[split].values():
            metrics.reset()
        for requests in self.chosen[split].values():
            for metric in requests.values():
                metric.reset()
        return scalars

    def rows(self, split: str) -> list[dict[str, Any]]:
        """One row per method: scores and numbers of scored clips and frames; collective under several processes.

        A metric that has no value over the whole split has None.
        """
        table = []
        for method, metrics in self.metrics[split].items():
            summary = metrics.summary()
            if not summary.coverage.sequences:
                continue  # no clip of the split had speech of another sentence to shuffle with
            scores: dict[str, float | None] = {name: float(value) for name, value in metrics.compute().items()}
            for name in self.chosen[split]["model"]:
                scores[name] = None
                if name in self.chosen[split][method]:
                    with contextlib.suppress(ValueError):  # no value on any sequence
                        scores[name] = float(self.chosen[split][method][name].compute())
            facts = {"split": split, "method": method, "unseen_identity": self.unseen_identity}
            if self.corpus.data is not None and self.corpus.data.test_share < 1 and split != "val":
                facts["test_share"] = self.corpus.data.test_share
            table.append({**facts, **scores, **summary.as_dict()})
        return table

    def columns(self) -> dict[str, dict[str, str | None]]:
        """How each score is pooled over sequences, and which way it is better.

        By the name of the score; see :func:`facediff.metrics.describe_column`.
        """
        of_model = next(iter(self.metrics.values()))["model"].scores()
        requests = next(iter(self.chosen.values()), {}).get("model", {})
        return {name: describe_column(metric) for name, metric in {**of_model, **requests}.items()}

    def describe(self) -> str:
        """The definitions of all numbers, in words."""
        lines = [self.protocol.describe()]
        for name, metric in next(iter(self.chosen.values()), {}).get("model", {}).items():
            lines.append(f"metric {name}: {getattr(metric, 'definition', type(metric).__doc__)}")
        return "\n".join(lines)
