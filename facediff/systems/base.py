"""What all systems share: sizes and assets, checkpoints, optimisation, evaluation, animation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from facediff.components.audio_encoder import AudioEncoder
from facediff.components.mesh_encoder import MeshEncoder
from facediff.data import Assets, Batch, Reference, SpeechMotionDataModule, collate
from facediff.data.assets import ASSETS_KEY, DATA_SOURCE_KEY
from facediff.data.audio import samples_for
from facediff.errors import FaceDiffError
from facediff.hparams import plain
from facediff.systems.animation import Prediction, Style, speech_sample
from facediff.systems.evaluation import Evaluation
from facediff.systems.identity_policy import IdentityPolicy, conditioned
from facediff.systems.long_speech import SpeechStream, crossfaded, windowed
from facediff.systems.schedule import Schedule, lr_factor
from facediff.systems.windows import Window, WindowPlan
from facediff.topology.hierarchy import mesh_hierarchy

Progress = Callable[[Iterable[int]], Iterable[int]]
MotionScale = Literal["unit", "none"]


class SpeechAnimator(LightningModule, ABC):
    """Base of all systems.

    Class attributes:
        samples: whether motion is drawn by a sampler, which :meth:`choose_sampler` changes.

    Attributes:
        windows: how speech is cut that is too long to be animated at once; may be changed at any time.

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

    samples: ClassVar[bool] = False

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
    def perform(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Motion of whole clips at once; memory may grow with the square of their length.

        Args:
            batch: clips; ``motion`` gives the number of frames only.
            seed: seed of the noise; a clip's noise depends on it and on the clip's name, not on the clips beside it.
            progress: wraps the iteration over steps, e.g. in a progress bar.
        """

    def perform_takes(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "takes frames vertices 3"]:
        """Several motions for one clip, which share what does not depend on the seed.

        A system that draws nothing gives the same motion for all seeds.
        """
        return self.perform(clip, seed=seeds[0], progress=progress).expand(len(seeds), -1, -1, -1)

    def perform_window(
        self, clip: Batch, window: Window, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "takes frames vertices 3"], list[Tensor]]:
        """Motion of one window of long speech, which continues the window before it without a joint.

        Here for systems that draw nothing: where two windows overlap, one motion goes over into the other.

        Args:
            clip: one clip with the window's speech, and some before and after it.
            window: which of its frames are wanted.
            seeds: one for each take.
            before: what the window before handed over; None for the first.

        Returns:
            the motion, and what to hand over to the next window.
        """
        motion = self.perform_takes(clip, seeds)[:, window.context : window.context + window.frames]
        if before is not None:
            motion = crossfaded(before[0], motion)
        return motion, [motion[:, -window.kept :]]

    def generate(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Motion for the batch's speech, identity and reference; its true motion is not looked at.

        Clips that last longer than ``windows.above`` are made by windows, all others at once.

        Args:
            batch: clips; ``motion`` gives the number of frames only.
            seed: seed of the noise; a clip's noise depends on it and on the clip's name, not on the clips beside it.
            progress: wraps the iteration over steps, or over the seconds of long speech, e.g. in a progress bar.
        """
        if int(batch.frame_lengths.max()) <= self.windows.above * self.frame_rate:
            return self.perform(batch, seed=seed, progress=progress)
        with torch.no_grad():
            return windowed(self, batch, seed, progress)

    @abstractmethod
    def encode_style(
        self, reference: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions, as a batch's ``style`` takes them.

        Args:
            reference: offsets from the template.
            mask: True on valid frames.

        Raises:
            FaceDiffError: if the system was made without a style.
        """

    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else those of its references."""
        return self.encode_style(batch.reference, batch.reference_mask) if batch.style is None else batch.style

    @abstractmethod
    def personal_modules(self) -> list[nn.Module]:
        """The parts that hold who somebody is and how they move; the others may stay frozen when one is learnt."""

    @property
    @abstractmethod
    def speech_encoder(self) -> AudioEncoder:
        """The part that hears: its frozen part may be computed once per clip."""

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
                "the system knows no templates yet; train it with a data module or load a checkpoint first"
            )
        return self._assets

    @property
    def scale(self) -> float:
        """Factor from offsets in the corpus's unit to the motion that the networks see.

        Raises:
            FaceDiffError: if it has not been measured, because the system was never trained.
        """
        if self.motion_scaling == "none":
            return 1.0
        if self.assets.motion_scale is None:
            raise FaceDiffError("the model has never been trained: give a checkpoint (--ckpt_path, --checkpoint)")
        return self.assets.motion_scale

    def adopt(self, assets: Assets) -> None:
        """Take over a corpus's assets after checking that they fit the system's sizes.

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
            raise FaceDiffError("facediff's systems train and test on a SpeechMotionDataModule; pass datamodule=…")
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
                # The system itself is moved to its device later; a process without clips must have its metrics there.
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

    @torch.inference_mode()
    def animate(
        self,
        audio: Float[Tensor, " samples"],
        *,
        subject: str,
        style: Reference | Style | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> Prediction:
        """Animate a known face with new speech.

        Args:
            audio: speech at 16 kHz.
            subject: whose face and identity; any subject of the training corpus, also one not trained on.
            style: reference motion, or a style vector made by this system; the subject's default one if None.
            seed: seed of the noise; equal seeds give equal motion on one machine.
            progress: wraps the iteration over sampling steps, or over the seconds of long speech.

        Raises:
            FaceDiffError: if the subject is unknown, the reference does not fit the topology, or the speech is
                shorter than a frame.
        """
        return self.animate_takes(audio, subject=subject, style=style, seeds=[seed], progress=progress)[0]

    @torch.inference_mode()
    def animate_takes(
        self,
        audio: Float[Tensor, " samples"],
        *,
        subject: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int],
        progress: Progress | None = None,
    ) -> list[Prediction]:
        """Several takes of the same speech, one for each seed; the speech is encoded once.

        Args:
            audio: speech at 16 kHz.
            subject: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            progress: as :meth:`animate` takes it.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        clip = self.clip_of(audio, subject, style)
        if clip.motion.shape[1] <= self.windows.above * self.frame_rate:
            takes = self.perform_takes(clip, seeds, progress=progress)
        else:
            takes = torch.cat(list(SpeechStream(self, clip, seeds=seeds).over(clip.audio[0], progress=progress)), 1)
        identity = subject if int(clip.identity[0]) >= 0 else "unknown"
        return [
            Prediction(clip.names[0], identity, clip.reference_names[0], (motion + clip.template).cpu())
            for motion in takes
        ]

    @torch.inference_mode()
    def stream(
        self,
        *,
        subject: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int] = (0,),
        plan: WindowPlan | None = None,
    ) -> SpeechStream:
        """Animate speech of any length, in pieces as they come.

        Args:
            subject: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            plan: how speech is cut; shorter windows give frames sooner. :attr:`windows` if None.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        frame = torch.zeros(samples_for(1, self.frame_rate), device=self.device)
        return SpeechStream(self, self.clip_of(frame, subject, style), seeds=seeds, plan=plan)

    def clip_of(self, audio: Float[Tensor, " samples"], subject: str, style: Reference | Style | None) -> Batch:
        """Speech, a face and a style as a batch of one clip on the system's device.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        self.assets.template(subject)  # who is not known at all has no style either
        sample = speech_sample(audio, self.assets, subject, style or self.default_style(subject))
        return collate([sample]).to(self.device)

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; a system that does not sample has no choice.

        Args:
            name: the sampler's registered name; the present one if None.
            steps: its denoising steps; its own default if None.

        Raises:
            FaceDiffError: if the system does not sample, or there is no such sampler.
        """
        raise FaceDiffError(f"{type(self).__name__} does not sample: leave --sampler and --steps away")

    def default_style(self, subject: str) -> Reference:
        """The stored reference of a subject.

        Raises:
            FaceDiffError: if the subject has none.
        """
        if subject not in self.assets.references:
            raise FaceDiffError(f"style: the checkpoint holds no reference motion of {subject}; give one with --style")
        return self.assets.references[subject]
