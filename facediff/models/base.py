"""What all models share: sizes and assets, checkpoints, optimisation, evaluation, animation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from facediff.data import Assets, Batch, SpeechMotionDataModule
from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY
from facediff.errors import FaceDiffError
from facediff.mesh.hierarchy import mesh_hierarchy
from facediff.models.evaluation import Evaluation, IdentityPolicy, conditioned
from facediff.models.inference import Inference, Prediction, WindowPlan
from facediff.models.mesh_encoders import MeshEncoder
from facediff.registry import plain

# The learning rate over training.

Schedule = Literal["constant", "cosine"]


def lr_factor(step: int, *, total: int, warmup_steps: int, schedule: Schedule) -> float:
    """What the learning rate is multiplied by at an optimiser step.

    Args:
        step: the step, counted from 0.
        total: steps of the whole training.
        warmup_steps: steps over which the factor rises from zero.
        schedule: constant, or half a cosine down to zero at the end.
    """
    warm = min(1.0, (step + 1) / max(1, warmup_steps))
    if schedule == "constant":
        return warm
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / max(1, total))))


MotionScale = Literal["unit", "none"]


class AnimationModel(LightningModule, Inference, ABC):
    """Base of all models.

    Args:
        n_vertices: vertices of the topology.
        identities: training identities in the order of the identity index.
        frame_rate: motion frames a second.
        learning_rate: AdamW's learning rate.
        weight_decay: AdamW's weight decay.
        lr_schedule: constant, or a cosine down to zero at the end of training.
        warmup_steps: optimiser steps over which the learning rate rises from zero.
        protocol: the metrics' protocol for validation and test.
        motion_scale: ``unit`` multiplies motion by one factor so that training motion has unit variance, ``none``
            leaves it as it is.
        unseen_identity: as whom people are tested whom the model was not trained on.
    """

    def __init__(
        self,
        *,
        n_vertices: int,
        identities: list[str],
        frame_rate: float,
        motion_scale: MotionScale,
        unseen_identity: IdentityPolicy,
        learning_rate: float,
        weight_decay: float,
        lr_schedule: Schedule,
        warmup_steps: int,
        protocol: str,
    ) -> None:
        super().__init__()
        self.n_vertices = n_vertices
        self.identities = list(identities)
        self.frame_rate = frame_rate
        # Optimisers keep these in checkpoints, where a NumPy scalar would make loading unsafe.
        self.learning_rate = float(learning_rate)
        self.weight_decay = float(weight_decay)
        self.lr_schedule = lr_schedule
        self.warmup_steps = warmup_steps
        self.motion_scaling = motion_scale
        self.unseen_identity: IdentityPolicy = unseen_identity
        self._assets: Assets | None = None
        self.data_source: dict[str, str] = {}
        self.evaluation = Evaluation(protocol, unseen_identity)
        self.windows = WindowPlan()

    @abstractmethod
    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The loss terms of a batch, unweighted, and their weighted sum ``loss``.

        Args:
            batch: clips with their true motion.
            generator: source of whatever the loss draws; torch's global one if None.
        """

    @abstractmethod
    def personal_modules(self) -> list[nn.Module]:
        """The parts that hold who somebody is and how they move; the others may stay frozen when one is learnt."""

    def remember(self, arguments: dict[str, Any]) -> None:
        """Keep constructor arguments as plain hyper-parameters, in the form that Lightning rebuilds a module from."""
        self.save_hyperparameters(
            {
                "_class_path": f"{type(self).__module__}.{type(self).__qualname__}",
                "_instantiator": "lightning.pytorch.cli.instantiate_module",
                **plain(arguments),
            }
        )

    @property
    def assets(self) -> Assets:
        """Templates, faces, regions, references and scale of the training corpus.

        Raises:
            FaceDiffError: if neither a corpus nor a checkpoint has been seen yet.
        """
        if self._assets is None:
            raise FaceDiffError(
                "the model knows no templates yet; train it with a data module or load a checkpoint first"
            )
        return self._assets

    @property
    def scale(self) -> float:
        """Factor from offsets in the corpus's unit to the motion that the networks see.

        Raises:
            FaceDiffError: if it has not been measured, because the model was never trained.
        """
        if self.motion_scaling == "none":
            return 1.0
        if self.assets.motion_scale is None:
            raise FaceDiffError("the model has never been trained: give a checkpoint (--ckpt_path, --checkpoint)")
        return self.assets.motion_scale

    def adopt(self, assets: Assets) -> None:
        """Take over a corpus's assets after checking that they fit the model's sizes.

        Raises:
            FaceDiffError: naming what differs.
        """
        sizes = {template.shape[0] for template in assets.templates.values()}
        for what, mine, theirs in (
            ("vertices", {self.n_vertices}, sizes),
            ("identities", self.identities, assets.identities),
            ("frames a second", self.frame_rate, assets.frame_rate),
        ):
            if mine != theirs:
                raise FaceDiffError(
                    f"the model and the corpus {assets.corpus} do not fit: {what} are {mine} in the model and {theirs} "
                    f"in the corpus; use a checkpoint that was trained on this topology and these people"
                )
        self._assets = assets

    def setup(self, stage: str) -> None:
        """Take the assets from the data module; a checkpoint's own replace them when it is loaded."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError("facediff's models train and test on a SpeechMotionDataModule; pass datamodule=…")
        self.data_source = {
            "class_path": f"{type(data).__module__}.{type(data).__qualname__}",
            "root": str(data.root.resolve()),
        }
        scale = self._assets.motion_scale if self._assets is not None else None
        if scale is None and stage == "fit":
            scale = data.motion_scale()
        self.adopt(data.assets().with_motion_scale(scale))
        self._attach_mesh()
        if stage != "predict":
            self.evaluation.prepare(
                self.assets,
                ["val"] if stage in ("fit", "validate") else data.test_splits,
                # The model itself is moved to its device later; a process without clips must have its metrics there.
                self.trainer.strategy.root_device,
            )

    def _attach_mesh(self) -> None:
        """Tell mesh encoders that have not been told yet about the mesh; their tables are kept in the checkpoint."""
        waiting = [m for m in self.modules() if isinstance(m, MeshEncoder) and not m.attached]
        if not waiting:
            return
        if self.assets.faces is None:
            raise FaceDiffError(
                f"mesh_encoder: {type(waiting[0]).__name__} needs the mesh, and {self.assets.corpus} has no "
                f"mesh file; put one into its folder, or choose mesh_encoder=linear"
            )
        template = self.assets.templates[next(iter(sorted(self.assets.templates)))]
        for encoder in waiting:
            encoder.attach(mesh_hierarchy(template.numpy(), self.assets.faces.numpy(), **encoder.mesh_options))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the assets, so that the checkpoint animates without the corpus."""
        checkpoint[ASSETS_KEY] = self.assets.state()
        checkpoint[DATA_SOURCE_KEY] = self.data_source

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the assets from the checkpoint."""
        if ASSETS_KEY in checkpoint:
            self.adopt(Assets.from_state(checkpoint[ASSETS_KEY]))
            self.data_source = checkpoint.get(DATA_SOURCE_KEY, {})

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW on everything trainable, with the learning-rate schedule per optimiser step."""
        parameters = [p for p in self.parameters() if p.requires_grad]
        # Fused: one pass over all parameters instead of several operations for each.
        optimizer = torch.optim.AdamW(parameters, lr=self.learning_rate, weight_decay=self.weight_decay, fused=True)
        # It could undo a loss scale by itself, for which reason Lightning will not clip its gradients in mixed
        # precision. Told that it does not, the scale, if there is one, is undone before gradients are clipped.
        optimizer._step_supports_amp_scaling = False
        if self.lr_schedule == "constant" and not self.warmup_steps:
            return optimizer
        total = int(self.trainer.estimated_stepping_batches)
        factor = partial(lr_factor, total=total, warmup_steps=self.warmup_steps, schedule=self.lr_schedule)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted loss; every term is logged as ``train/<term>``."""
        losses = self.losses(batch)
        logged = {f"train/{name}": value.detach() for name, value in losses.items()}
        self.log_dict(logged, batch_size=len(batch), prog_bar=False)
        self.log("loss", losses["loss"].detach(), batch_size=len(batch), prog_bar=True, logger=False)
        return losses["loss"]

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss with fixed draws and the protocol's metrics of sampled motion, so that epochs compare."""
        losses = self.losses(batch, torch.Generator(self.device).manual_seed(batch_idx))
        logged = {f"val/{name}": value for name, value in losses.items()}
        self.log_dict(logged, batch_size=0 if batch.repeated else len(batch), sync_dist=True)
        self.evaluation.update("val", "model", self.generate(batch, seed=0), batch)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics as ``val/mve`` …."""
        # The metrics have been summed over the processes already; averaging equal values changes nothing.
        self.log_dict(self.evaluation.scalars("val"), prog_bar=False, sync_dist=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Score sampled motion, a still face, and the model's motion for another sentence's speech."""
        split = self.evaluation.splits[dataloader_idx]
        for name, view in conditioned(batch, self.unseen_identity, self.identities, self.assets.references):
            self.evaluation.update(split, "model", self.generate(view, seed=0), view, name)
        self.evaluation.update(split, "still", torch.zeros_like(batch.motion), batch)
        if batch.decoy_audio is not None:
            decoy = replace(batch, audio=batch.decoy_audio, features=None)
            shuffled = self.generate(decoy, seed=0)
            self.evaluation.update(split, "shuffled", shuffled, batch)

    def on_test_epoch_end(self) -> None:
        """Log ``<split>/lve`` and so on; the table is printed by the callback ``ScoreTable``."""
        for split in self.evaluation.splits:
            self.log_dict(self.evaluation.scalars(split), sync_dist=True)

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> list[Prediction]:
        """Absolute vertices of every clip of the batch."""
        motion = self.generate(batch, seed=0)
        vertices = motion + batch.template[:, None]
        names = [self.identities[i] if i >= 0 else "unknown" for i in batch.identity.tolist()]
        return [
            Prediction(name, names[i], batch.reference_names[i], vertices[i, : int(batch.frame_lengths[i])].cpu())
            for i, name in enumerate(batch.names)
        ]
