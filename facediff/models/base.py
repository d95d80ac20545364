"""The base of all models: their common options, training, testing and prediction.

A model adds its network and three methods: ``__init__`` with its own options, ``losses``, and ``generate_clips``. The
content of checkpoints stands in :mod:`facediff.models.checkpoint_content`, sampling in
:mod:`facediff.models.inference`.
"""

from __future__ import annotations

import functools
import math
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Annotated, Any, Self, cast

import torch
from jaxtyping import Bool, Float
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from facediff.data import Assets, Batch, SpeechMotionDataModule
from facediff.data.packed.stores import address_of
from facediff.errors import ArgumentError, FaceDiffError, damaged
from facediff.hyperparameters import keeps_arguments
from facediff.mesh.hierarchy import mesh_hierarchy
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.channel_weights import ChannelWeights, channel_weights
from facediff.models.checkpoint import checked_file, misfit, model_of, naming, read_checkpoint
from facediff.models.checkpoint_content import CheckpointContent, MotionScale, StyleSource
from facediff.models.evaluation import Evaluation, IdentityPolicy, conditioned, to_shuffle, with_usual_styles
from facediff.models.graphs import Graphs
from facediff.models.inference import Prediction, noise_stream
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.motion_space import PrincipalComponents, Projection
from facediff.models.optimizers import FactorSchedule, Schedule, apply_at_resume, lr_factor, parameter_groups
from facediff.models.pretrained import publish
from facediff.spaces import Space
from facediff.speech.windows import WindowPlan
from facediff.utils.licences import merged, network_licences, require_cleared
from facediff.utils.ranges import Range, Vertices

Decay = Annotated[float, Range(0, 1000)]


SIZES = ("n_vertices", "identities", "frame_rate", "space")
"""Options of a model that follow from its data module, by their name in both."""

DIVERGENCE_INTERVAL = 50
"""Steps between two looks at the loss on an accelerator."""


def read_space(space: object, points: int) -> Space:
    """A space, or its state, or None for vertices."""
    if not isinstance(space, Space | dict | None):
        raise ArgumentError({"space": space}, "expected a Space, or its state as a dict")
    with damaged("space", "give the corpus's own"):
        record = Space() if space is None else space if isinstance(space, Space) else Space.from_state(space)
    if not record.is_vertices and len(record.channels) != points:
        raise ArgumentError(
            {"space": record.kind},
            f"has {len(record.channels)} channels and the motion {points}; give the corpus's own",
        )
    return record


class AnimationModel(CheckpointContent, ABC):
    """Base of all models.

    A model's own constructor names its own options and hands the others on::

        def __init__(self, *, dim: int = 64, **options: Any) -> None:
            super().__init__(**options)

    Its arguments become hyper-parameters by themselves: plain data in which every option of every component is filled
    in. An option that takes a component has the name of the component's kind (``decoder``, ``audio_encoder`` …).

    Args:
        n_vertices: points of the motion: vertices of the topology, or channels of its space; taken from the data module
            on the command line.
        identities: training identities in the order of the identity index; taken from the data module on the command
            line.
        frame_rate: motion frames a second; taken from the data module on the command line.
        space: the meaning of the motion's numbers, a :class:`facediff.spaces.Space` or its state; vertices if None;
            taken from the data module on the command line.
        channel_weights: weights of a parametric space's channels: by the vertices that the corpus's ``rig`` moves
            by them, by their standard ``deviation`` (also where there is no rig), or as they are (``none``).
        motion_scale: ``unit`` multiplies motion by one factor so that training motion has unit variance, ``none``
            leaves it as it is.
        learning_rate: AdamW's learning rate.
        weight_decay: AdamW's weight decay.
        lr_schedule: constant, a cosine down to zero at the end of training, ``exponential``, or ``step``.
        lr_decay: what ``exponential`` multiplies the learning rate by in every epoch from ``lr_decay_epoch`` on, and
            ``step`` once in every ``lr_decay_epoch`` epochs.
        lr_decay_epoch: the first epoch that ``exponential`` does so, counted from 0; see ``lr_decay`` for ``step``.
        warmup_steps: optimiser steps over which the learning rate rises from zero.
        parameter_groups: options of the optimiser for some parts, by their name among the modules, such as
            ``{audio_encoder: {lr: 1e-5}}``; the schedule holds for all.
        protocol: the metrics' protocol for validation and test.
        metrics: further metrics for validation and test, by name with their options, such as
            ``lip_warping_distance`` or ``temporal_misalignment:at=path``; see docs/metrics.md.
        unseen_identity: which identity unseen speakers are tested and predicted with: none, with their own style
            (``style_only``), or each training identity in turn with the mean of the scores (``each_seen``).
        style_source: the style that speakers have in validation, test and prediction, and by default in animation: of
            one ``reference`` clip, or of all motion of the ``person`` outside the evaluated clips, as the mean of the
            style vectors of stretches of ``data.reference_frames``. Checkpoints then keep every speaker's vector.
        validation_samples: samples of each validation clip for ``val/energy``, the score by which the bundled trainers
            choose the best checkpoint; with 1 it is a distance, which a mean face may win.
        test_samples: samples of each test clip by a model that draws them; with more than one, a test has a row of
            their mean too, which has the lower squared error by nature (a sample's is twice a mean's if it is drawn
            from the right distribution).
    """

    @keeps_arguments
    def __init__(
        self,
        *,
        n_vertices: Vertices,
        identities: Annotated[list[str], Range(items=(1, 1_000_000))],
        frame_rate: Annotated[float, Range(0, 1000, above=True)],
        space: Space | dict[str, Any] | None = None,
        channel_weights: ChannelWeights = "rig",
        motion_scale: MotionScale = "unit",
        learning_rate: Annotated[float, Range(0, 1000)] = 1e-4,
        weight_decay: Decay = 0.05,
        lr_schedule: Schedule = "constant",
        lr_decay: Annotated[float, Range(0, 1, above=True)] = 0.9,
        lr_decay_epoch: Annotated[int, Range(0, 10**9)] = 30,
        warmup_steps: Annotated[int, Range(0, 10**9)] = 0,
        parameter_groups: dict[str, dict[str, Any]] | None = None,
        protocol: str = "paper",
        metrics: Sequence[str] = (),
        unseen_identity: IdentityPolicy = "style_only",
        style_source: StyleSource = "reference",
        validation_samples: Annotated[int, Range(1, 1000)] = 2,
        test_samples: Annotated[int, Range(1, 1000)] = 1,
    ) -> None:
        super().__init__()
        self.n_vertices = n_vertices
        self.space = read_space(space, n_vertices)
        self.channel_weighting: ChannelWeights = channel_weights
        # Weights of the errors of channels, measured when training begins. Vertices count as they are.
        self.register_buffer("geometry", None if self.space.is_vertices else torch.eye(n_vertices))
        self.identities = list(identities)
        self.frame_rate = frame_rate
        self.motion_scaling = motion_scale
        # Optimisers keep these in checkpoints, where a NumPy scalar would make loading unsafe.
        self.learning_rate = float(learning_rate)
        self.weight_decay = float(weight_decay)
        self.lr_schedule = lr_schedule
        self.lr_decay = float(lr_decay)
        self.lr_decay_epoch = lr_decay_epoch
        self.warmup_steps = warmup_steps
        self.parameter_groups = parameter_groups
        self.unseen_identity: IdentityPolicy = unseen_identity
        self.protocol = protocol
        self.metrics = list(metrics)
        self.validation_samples = validation_samples
        self.test_samples = test_samples
        self.windows = WindowPlan()
        self.style_source: StyleSource = style_source
        self._validation_sums: dict[str, Tensor] = {}  # of each loss term, and the number of clips

    geometry: Tensor | None

    @classmethod
    def for_data(cls, data: SpeechMotionDataModule, **options: Any) -> Self:  # noqa: ANN401
        """A model with the sizes of a corpus, as on the command line.

        Example:
            >>> data = Puppet(batch_size=8)  # doctest: +SKIP
            >>> model = DualPathDiffusion.for_data(data, dim=64)  # doctest: +SKIP
            >>> Trainer(max_epochs=30).fit(model, data)  # doctest: +SKIP
        """
        return cls(**{name: getattr(data, name) for name in SIZES}, **options)

    @functools.cached_property
    def evaluation(self) -> Evaluation:
        """The metrics of validation and test; a model that only animates makes none."""
        return Evaluation(self.protocol, self.unseen_identity, self.metrics, self.validation_samples)

    options_path = "model"

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        """Let every model keep its constructor's arguments."""
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            cls.__init__ = keeps_arguments(cls.__init__)  # type: ignore[method-assign]

    # For a model to implement; :meth:`generate_clips` of the base class too.

    @abstractmethod
    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The loss terms of a batch, unweighted, and their weighted sum ``loss``."""

    def encode_style(
        self, reference: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions; of width 0 for a model without a speaking style."""
        return reference.new_zeros(len(reference), 0)

    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else its references' vectors."""
        return self.encode_style(batch.reference, batch.reference_mask) if batch.style is None else batch.style

    def graphs(self) -> Graphs:
        """The model as graphs that run without PyTorch, with its present sampler; see :mod:`facediff.models.graphs`."""
        raise FaceDiffError(
            f"{type(self).__name__}: has no graphs and cannot be exported; a model that can overrides graphs()"
        )

    def fit_to_features(self, data: SpeechMotionDataModule) -> dict[str, Tensor]:  # noqa: ARG002
        """Fit again the parts that were fitted to the speech features, after the audio encoder alone was trained.

        Returns:
            what has changed, by its name in the state dict; by itself a model has nothing of the kind.
        """
        return {}

    def personal_modules(self) -> list[nn.Module]:
        """The parts that hold identity and style; ``facediff adapt --train person`` trains them alone."""
        return []

    @property
    def speech_encoder(self) -> AudioEncoder:
        """The model's audio encoder: the first among its modules."""
        for module in self.modules():
            if isinstance(module, AudioEncoder):
                return module
        raise FaceDiffError(
            f"{type(self).__name__} has no audio encoder, which long speech and cached speech features need; make the "
            f"module that takes the speech a subclass of facediff.models.audio_encoders.AudioEncoder"
        )

    # Training, validation, test, prediction.

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW on everything trainable, with the learning-rate schedule per optimiser step."""
        return self.scheduled(self.default_optimizer())

    def default_optimizer(self) -> torch.optim.Optimizer:
        """AdamW with the model's options."""
        groups = parameter_groups(self, self.parameter_groups)
        # Fused: one pass over all parameters instead of several operations for each.
        optimizer = torch.optim.AdamW(groups, lr=self.learning_rate, weight_decay=self.weight_decay, fused=True)
        # A fused optimiser could undo a loss scale itself, so Lightning refuses to clip its gradients in mixed
        # precision. Without this mark, the scale is undone before gradients are clipped.
        optimizer._step_supports_amp_scaling = False
        return optimizer

    def scheduled(self, optimizer: torch.optim.Optimizer) -> OptimizerLRScheduler:
        """An optimiser with the model's schedule; it takes its options, and not a checkpoint's, at a resume."""
        if self.lr_schedule == "constant" and not self.warmup_steps:
            return apply_at_resume(optimizer)
        total = self.trainer.estimated_stepping_batches if self.lr_schedule == "cosine" else 0
        if math.isinf(total):
            raise ArgumentError(
                {"lr_schedule": self.lr_schedule, "trainer.max_epochs": self.trainer.max_epochs},
                "half a cosine needs the length of the training; state trainer.max_steps, or choose another schedule",
            )
        factor = functools.partial(
            lr_factor,
            total=int(total),
            warmup_steps=self.warmup_steps,
            schedule=self.lr_schedule,
            epoch_steps=self._steps_an_epoch() if self.lr_schedule in ("exponential", "step") else 1,
            decay=self.lr_decay,
            decay_epoch=self.lr_decay_epoch,
        )
        scheduler = FactorSchedule(optimizer, factor)
        return {"optimizer": apply_at_resume(optimizer), "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _steps_an_epoch(self) -> int:
        """Optimiser steps of an epoch."""
        if not math.isfinite(self.trainer.num_training_batches):
            self.trainer.fit_loop.setup_data()  # with max_steps, Lightning has not counted the batches yet
        return math.ceil(self.trainer.num_training_batches / self.trainer.accumulate_grad_batches)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted loss; every term is logged as ``train/<term>``."""
        losses = self.losses(batch)
        self.stop_if_diverged(losses["loss"].detach())
        logged = {f"train/{name}": value.detach() for name, value in losses.items()}
        self.log_dict(logged, batch_size=len(batch), prog_bar=False)
        self.log("loss", losses["loss"].detach(), batch_size=len(batch), prog_bar=True, logger=False)
        return losses["loss"]

    def stop_if_diverged(self, loss: Tensor) -> None:
        """Stop a training with a NaN or infinite loss: no further step can mend its weights."""
        # On an accelerator, looking at every loss would wait for the device. In 16-bit mixed precision an overflow is
        # usual, and the step is skipped.
        looked_at = loss.device.type == "cpu" or self.trainer.global_step % DIVERGENCE_INTERVAL == 0
        if looked_at and str(self.trainer.precision) != "16-mixed" and not bool(torch.isfinite(loss)):
            raise FaceDiffError(
                f"training has diverged: the loss is {float(loss)} at step {self.trainer.global_step}. Lower "
                f"model.learning_rate (it is {self.learning_rate:g}), set trainer.gradient_clip_val, or check the "
                f"corpus with `facediff data check`"
            )

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss with fixed random numbers, so that epochs compare, and the protocol's metrics of generated motion."""
        # The same steps and noise in every epoch; otherwise the curve would show their chance. They follow from the
        # clips and not from the batch's number, which is another one where several processes share the batches.
        losses = self.losses(batch, noise_stream(" ".join(batch.names), 0, self.device))
        clips = 0 if batch.repeated else len(batch)
        for name, value in losses.items():
            total = torch.stack([value.detach() * clips, value.new_tensor(clips)])
            self._validation_sums[name] = self._validation_sums.get(name, 0) + total
        model = self.model_of(batch)
        model.evaluation.score(model, "val", model.with_person_styles(batch))

    def on_validation_epoch_start(self) -> None:
        """Encode the speakers; begin new sums, also after a validation that was stopped."""
        super().on_validation_epoch_start()
        self._validation_sums = {}

    def on_validation_epoch_end(self) -> None:
        """Log the loss terms and the metrics as ``val/mve`` …."""
        # All have been summed over the processes already; averaging equal values changes nothing.
        self.log_dict({**self.validation_terms(), **self.evaluation.scalars("val")}, prog_bar=False, sync_dist=True)

    def validation_terms(self) -> dict[str, Tensor]:
        """The loss terms as ``val/<term>``: means over the clips of all processes.

        Lightning's own reduction averages the number of clips over the processes as a whole number.
        """
        if not self._validation_sums:
            return {}
        sums = torch.stack([*self._validation_sums.values()])
        totals, counts = self.trainer.strategy.reduce(sums, reduce_op="sum").T
        return {f"val/{name}": value for name, value in zip(self._validation_sums, totals / counts, strict=True)}

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Score generated motion, faces that do not move, and the model's motion for another sentence's speech."""
        split = self.evaluation.splits[dataloader_idx]
        batch = self.with_person_styles(batch)
        for name, view in self.views_of_clips(batch):
            self.evaluation.score(self, split, view, name)
            if self.samples and self.test_samples > 1:
                samples = torch.stack([self.generate(view, seed=seed) for seed in range(self.test_samples)])
                self.evaluation.update(split, "sample_mean", samples.mean(0), view, name)
            if (some := to_shuffle(name, view, self.identities)) is not None and some.decoy_audio is not None:
                decoy = replace(some, audio=some.decoy_audio, features=None)
                self.evaluation.update(split, "shuffled", self.generate(decoy, seed=0), some, name)
        # A test gives every clip a reference of its own speaker and mood; an animation has none.
        for view in with_usual_styles(batch, self.default_style) if self.style_of(batch).shape[1] else ():
            self.evaluation.update(split, "usual_style", self.generate(view, seed=0), view)
        # Baselines: the model with speech that does not belong to the clip, and faces that do not move.
        self.evaluation.score_baselines(split, batch)

    def on_test_epoch_end(self) -> None:
        """Log ``<split>/lve`` and so on; the table is printed by the callback ``ScoreTable``."""
        for split in self.evaluation.splits:
            self.log_dict(self.evaluation.scalars(split), sync_dist=True)

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> list[Prediction]:
        """Absolute vertices of every clip of the batch, also of channels with a rig; without one the channels.

        Unseen speakers are conditioned as ``unseen_identity`` says, so that a clip may have several predictions.
        """
        return [clip for _, view in self.views_of_clips(batch) for clip in self._predicted(view)]

    def views_of_clips(self, batch: Batch) -> list[tuple[str, Batch]]:
        """The batch as it is tested and predicted, once for each identity that unseen speakers are conditioned on."""
        styles = {name: self.default_style(name) for name in self.styled_identities()}
        return conditioned(self.with_person_styles(batch), self.unseen_identity, self.identities, styles)

    def _predicted(self, batch: Batch) -> list[Prediction]:
        """One prediction of every clip of the batch."""
        motion, assets = self.generate(batch, seed=0), self.assets
        vertices = [
            assets.to_scored(clip, name) + assets.scored.template(name).to(clip) if assets.rig else clip + template
            for clip, name, template in zip(motion, batch.identity_names, batch.template, strict=True)
        ]
        names = [self.identities[i] if i >= 0 else "unknown" for i in batch.identity.tolist()]
        return [
            Prediction(name, names[i], batch.reference_names[i], vertices[i][: int(batch.frame_lengths[i])].cpu())
            for i, name in enumerate(batch.names)
        ]

    def check_training(self, *, resumed: bool) -> None:
        """Refuse, before a run writes anything, what cannot be trained; by itself a model refuses nothing."""

    def setup(self, stage: str) -> None:
        """Take the assets from the data module; a checkpoint's own replace them when it is loaded.

        A trained model has its assets already, and takes plain loaders of batches: not for a test, which also scores
        faces of the training split.
        """
        self._styles_of_step = None
        self.__dict__.pop("evaluation", None)  # the protocol may be another one now
        data = getattr(self.trainer, "datamodule", None)
        if data is None and self._assets is not None and stage != "test":
            if stage != "predict":
                self.evaluation.prepare(self, ["val"], self.trainer.strategy.root_device, None)
            return
        if not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError(
                "a model that was never trained, and a test, need a SpeechMotionDataModule; pass datamodule=…"
            )
        faces = dict(self.heads())
        if stage in ("fit", "validate") and data.further.keys() != faces.keys():
            raise FaceDiffError(
                f"data.further_corpora: has {', '.join(data.further) or 'none'}; expected a corpus for each further "
                f"face of the model: {', '.join(faces) or 'none, since it is no model of many faces (ManyFaces)'}"
            )
        self.use_corpus(data, stage)

    def use_corpus(self, data: SpeechMotionDataModule, stage: str) -> None:
        """Take a corpus's assets, and measure what training needs of it."""
        if stage != "predict":
            _ = self.evaluation  # an unknown protocol or metric is reported before the corpus is read
        if stage == "fit":
            # The seed that Lightning was given; scores name it, so that runs of one method can be told apart.
            self.provenance |= {"seed": seed} if (seed := os.environ.get("PL_GLOBAL_SEED")) else {}
            # Labels of a checkpoint that is adapted or resumed stay: a model inherits from all its training data.
            self.licences = merged(self.licences, data.licences(), network_licences(dict(self.hparams)))
        self.data_source = {
            "class_path": f"{type(data).__module__}.{type(data).__qualname__}",
            "root": address_of(data.source) or str(Path(data.source).expanduser().resolve()),
        }
        # Measured on the training split once; a resumed or adapted model keeps the scale that its weights know.
        scale = self._assets.motion_scale if self._assets is not None else None
        untrained = self.untrained and stage == "fit"
        if scale is None and stage == "fit":
            scale = data.motion_scale()
        self.adopt(data.assets().with_motion_scale(scale))
        self.attach_mesh()
        if untrained:
            self.measure(data)
        if stage != "predict":
            self.evaluation.prepare(
                self,
                ["val"] if stage in ("fit", "validate") else data.test_splits,
                # The model itself is moved to its device later; a process without clips must have its metrics there.
                self.trainer.strategy.root_device,
                data,
            )

    def heads(self) -> Iterator[tuple[str, AnimationModel]]:
        """The models of further faces by name: none, by itself."""
        return iter(())

    def model_of(self, batch: Batch) -> AnimationModel:  # noqa: ARG002 - a model of one face
        """The model of the face that a batch is of."""
        return self

    def own_modules(self) -> Iterator[nn.Module]:
        """The modules that belong to the model's own corpus: all, by itself."""
        return self.modules()

    def attach_mesh(self) -> None:
        """Give the mesh to those mesh encoders that have none yet; their tables are kept in the checkpoint."""
        encoders = [m for m in self.own_modules() if isinstance(m, MeshEncoder) and not m.attached]
        if not encoders:
            return
        if self.assets.faces is None:
            raise FaceDiffError(
                f"mesh_encoder: {type(encoders[0]).__name__} needs the mesh, and {self.assets.corpus} has no "
                f"mesh file; put one into its folder, or choose mesh_encoder=linear"
            )
        template = self.assets.templates[min(self.assets.templates)]
        for encoder in encoders:
            encoder.attach(mesh_hierarchy(template.numpy(), self.assets.faces.numpy(), **encoder.mesh_options))

    def on_fit_start(self) -> None:
        """Say in which form training motion is wanted, before the first clip is read."""
        data = getattr(self.trainer, "datamodule", None)
        if isinstance(data, SpeechMotionDataModule):
            # Options of the data that a resume changes apply to the losses too, in place of the checkpoint's.
            self.adopt(data.assets().with_motion_scale(self.assets.motion_scale))
            data.projection.choose(self.training_projection())

    def training_projection(self) -> Projection | None:
        """What training motion is read as, in place of vertices; validation and tests always have these."""
        return None

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Fit the data-dependent parts of an untrained model to the training split: principal components of motion.

        Returns:
            the components of scaled, weighted motion, each as long as its standard deviation; None if no part of
            the model needs them.
        """
        weights = self.coordinate_weights(data)
        if self.geometry is not None:
            self.geometry.copy_(weights)
        components = [module for module in self.own_modules() if isinstance(module, PrincipalComponents)]
        count = max([at_least, *(module.count for module in components)])
        if not count:
            return None
        mean, shapes = data.principal_motion(count, weights)
        for module in components:
            module.attach(mean * self.scale, shapes * self.scale, weights)
        return shapes * self.scale

    def coordinate_weights(self, data: SpeechMotionDataModule) -> Float[Tensor, "*all"]:
        """Factors of the coordinates of motion, (n,); of channels the matrix (n, n)."""
        points = self.motion_weights(data)
        if self.space.is_vertices:
            return points.flatten()
        _, shapes = data.principal_motion(self.n_vertices)
        covariance = shapes.T @ shapes
        return channel_weights(self.assets, covariance.diag(), covariance, points, self.channel_weighting)

    def motion_weights(self, data: SpeechMotionDataModule) -> Float[Tensor, "points dims"]:  # noqa: ARG002
        """Weights of the points of :attr:`weighted_assets` in principal components and in losses of channels."""
        weighted = self.weighted_assets
        return torch.ones(weighted.n_vertices, weighted.space.dims)

    @property
    def weighted_assets(self) -> Assets:
        """The assets; of channels with a rig, the assets of the vertices that the rig moves."""
        by_rig = self.assets.rig is not None and self.channel_weighting == "rig"
        return self.assets.mesh if by_rig else self.assets

    def weighed(self, motion: Float[Tensor, "*frames points dims"]) -> Float[Tensor, "*frames points dims"]:
        """Motion scaled so that squared errors are weighted by :attr:`channel_weighting`; vertices as they are."""
        if self.geometry is None:
            return motion
        # Not in mixed precision: differences over time of half-precision motion are noise.
        with torch.autocast(motion.device.type, enabled=False):
            return (motion[..., 0].to(self.geometry.dtype) @ self.geometry.T)[..., None]

    # Checkpoints and publishing.

    def save_pretrained(
        self,
        folder: str | Path,
        *,
        license: str | None = None,  # noqa: A002 - the hub's word
        name: str | None = None,
    ) -> Path:
        """Write the model as a folder that can be handed to others, or sent to the Hugging Face hub.

        ``facediff.load`` and every command that takes a checkpoint read it again. It holds the weights, what animation
        needs of the corpus, and a model card, but nothing that only training needs.

        Args:
            folder: a folder that does not exist, or is empty.
            license: licence of the weights, such as ``apache-2.0``; the data's if None.
            name: the model's name in the card; the folder's if None.

        Returns:
            the folder.

        Example:
            >>> model.save_pretrained("talking-face", license="apache-2.0")  # doctest: +SKIP
        """
        return publish(self, Path(folder), licence=license, name=name)

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path | IO[bytes],
        *arguments: Any,  # noqa: ANN401
        **options: Any,  # noqa: ANN401
    ) -> Self:
        """Lightning's method, after the checks that every checkpoint goes through; the arguments are Lightning's."""
        with checked_file(checkpoint_path) as stream:
            model: Self = super().load_from_checkpoint(stream, *arguments, **{**options, "weights_only": True})
        return model


def load_model(path: Path | str, device: str = "cpu", *, commercial_only: bool = False) -> AnimationModel:
    """A trained model, ready for inference.

    Args:
        path: a checkpoint of any model, also of an installed package's; a model folder; or ``user/name[@revision]`` of
            the Hugging Face hub, where no such path exists.
        device: where it computes.
        commercial_only: refuse a model if its licence labels do not allow commercial use.

    Example:
        >>> model = load_model("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate(speech, identity="F1").vertices.shape  # doctest: +SKIP
        torch.Size([75, 1008, 3])
    """
    model = build_model(path, read_checkpoint(path))
    if commercial_only:
        require_cleared(path, model.licences)
    return model.to(device)


def build_model(path: Path | str, checkpoint: dict[str, Any]) -> AnimationModel:
    """The model of a checkpoint that :func:`read_checkpoint` has read, ready for inference on the CPU."""
    weights = checkpoint["state_dict"]
    # The model is rebuilt from its own options with the sizes that the checkpoint states; then come the assets,
    # before the weights, since tables of mesh encoders are among these.
    implementation, arguments = model_of(path, checkpoint["hyper_parameters"])
    with naming(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that are 0, for example
        built = implementation(**arguments)
        built.on_load_checkpoint(checkpoint)
        if difference := misfit(weights, built.state_dict()):
            raise FaceDiffError(difference)
        built.load_state_dict(weights)
        model = cast(AnimationModel, built.eval())  # no other model has what it extends
        check_styles(model)
    return model


def check_styles(model: AnimationModel) -> None:
    """Refuse styles of speakers that are not as long as the model's; a single number would fill all."""
    lengths = {len(style.vector) for style in model.person_styles.values()}
    if not lengths:
        return
    still = torch.zeros(1, 1, model.n_vertices, model.dims)
    with torch.inference_mode():
        width = model.encode_style(still, torch.ones(1, 1, dtype=torch.bool)).shape[-1]
    if lengths != {width}:
        raise FaceDiffError(
            f"its styles of speakers have {min(lengths)} numbers, those of its model {width}; the file is damaged"
        )
