"""The base of all models: their common options, training, testing, prediction, and what a checkpoint keeps.

A model adds its network and three methods: ``__init__`` with its own options, ``losses``, and ``generate_clips``.
"""

from __future__ import annotations

import functools
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Annotated, Any, Literal, Self

import torch
from jaxtyping import Bool, Float
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn

from facediff.data import Assets, Batch, Reference, SpeechMotionDataModule
from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY, FORMAT, FORMAT_KEY, pad
from facediff.data.packed.stores import address_of
from facediff.errors import FaceDiffError, OptionError
from facediff.mesh.hierarchy import mesh_hierarchy
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.evaluation import Evaluation, IdentityPolicy, conditioned
from facediff.models.inference import Inference, Prediction, Style
from facediff.models.layers import frame_mask
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.principal import PrincipalComponents
from facediff.registry import COMPONENTS, component_class, corpus, defaults, describe, keeps_arguments, plain
from facediff.speech.windows import WindowPlan
from facediff.utils.licences import LICENCES_KEY, Licence, merged, network_licences, read_licences
from facediff.utils.limits import LIMITS, quoted
from facediff.utils.plain_options import is_name, is_plain_text
from facediff.utils.ranges import Range, Vertices

Schedule = Literal["constant", "cosine", "exponential", "step"]
StyleSource = Literal["reference", "person"]
MotionScale = Literal["unit", "none"]
Decay = Annotated[float, Range(0, 1000)]


PROVENANCE_KEY = "facediff_provenance"
"""Where a checkpoint keeps what it was made from, as texts by name: ``parent``, ``epochs``, ``steps``, ``version``."""

STYLES_KEY = "facediff_styles"
"""Where a checkpoint keeps the speakers' style vectors, if they are of all their motion."""

DIVERGENCE_INTERVAL = 50
"""Steps between two looks at the loss on an accelerator."""


def lr_factor(
    step: int,
    *,
    total: int,
    warmup_steps: int,
    schedule: Schedule,
    epoch_steps: int = 1,
    decay: float = 0.9,
    decay_epoch: int = 30,
) -> float:
    """What the learning rate is multiplied by at an optimiser step.

    Args:
        step: the step, counted from 0.
        total: steps of the whole training.
        warmup_steps: steps over which the factor rises from zero.
        schedule: constant; half a cosine down to zero at the end; exponential, which multiplies by ``decay`` in
            every epoch from ``decay_epoch`` on; or step, which does so once in every ``decay_epoch`` epochs.
        epoch_steps: steps of an epoch.
        decay: the factor of an epoch.
        decay_epoch: the first epoch with the factor, counted from 0 as Lightning counts; of step, how many epochs lie
            between two decays.
    """
    warm = min(1.0, (step + 1) / max(1, warmup_steps))
    if schedule == "constant":
        return warm
    if schedule == "exponential":
        return warm * decay ** max(0, step // max(1, epoch_steps) - decay_epoch + 1)
    if schedule == "step":
        return warm * decay ** (step // max(1, epoch_steps) // max(1, decay_epoch))
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / max(1, total))))


class AnimationModel(LightningModule, Inference, ABC):
    """Base of all models.

    A model's own constructor names its own options and hands the others on::

        def __init__(self, *, dim: int = 64, **options: Any) -> None:
            super().__init__(**options)

    Its arguments become hyper-parameters by themselves: plain data in which every option of every component is filled
    in. An option that takes a component has the name of the component's kind (``decoder``, ``audio_encoder`` …).

    Args:
        n_vertices: vertices of the topology; taken from the data module on the command line.
        identities: training identities in the order of the identity index; taken from the data module on the command
            line.
        frame_rate: motion frames a second; taken from the data module on the command line.
        motion_scale: ``unit`` multiplies motion by one factor so that training motion has unit variance, ``none``
            leaves it as it is.
        learning_rate: AdamW's learning rate.
        weight_decay: AdamW's weight decay.
        lr_schedule: constant, a cosine down to zero at the end of training, ``exponential``, or ``step``.
        lr_decay: what ``exponential`` multiplies the learning rate by in every epoch from ``lr_decay_epoch`` on, and
            ``step`` once in every ``lr_decay_epoch`` epochs.
        lr_decay_epoch: the first epoch that ``exponential`` does so, counted from 0; see ``lr_decay`` for ``step``.
        warmup_steps: optimiser steps over which the learning rate rises from zero.
        protocol: the metrics' protocol for validation and test.
        metrics: further metrics for validation and test, by name with their options, such as
            ``lip_warping_distance`` or ``temporal_misalignment:at=path``; see docs/metrics.md.
        unseen_identity: which identity unseen speakers are tested with: none, with their own style (``style_only``),
            each training identity in turn with the mean of the scores (``each_seen``), or their own, once the model is
            adapted to them (``adapted``).
        style_source: the style that speakers have in validation, test and prediction, and by default in animation: of
            one ``reference`` clip, or of all motion of the ``person`` outside the evaluated clips, as the mean of the
            style vectors of stretches of ``data.reference_frames``. Checkpoints then keep every speaker's vector.
        validation_samples: samples of each validation clip for ``val/energy``, the score by which the bundled trainers
            choose the best checkpoint; with 1 it is a distance, which a mean face may win.
        score_by: clip attributes, such as ``[emotion,intensity]``, by which test scores are printed and written too.
    """

    @keeps_arguments
    def __init__(
        self,
        *,
        n_vertices: Vertices,
        identities: Annotated[list[str], Range(items=(1, 1_000_000))],
        frame_rate: Annotated[float, Range(0, 1000, above=True)],
        motion_scale: MotionScale = "unit",
        learning_rate: Annotated[float, Range(0, 1000)] = 1e-4,
        weight_decay: Decay = 0.05,
        lr_schedule: Schedule = "constant",
        lr_decay: Annotated[float, Range(0, 1, above=True)] = 0.9,
        lr_decay_epoch: Annotated[int, Range(0, 10**9)] = 30,
        warmup_steps: Annotated[int, Range(0, 10**9)] = 0,
        protocol: str = "paper",
        metrics: Sequence[str] = (),
        unseen_identity: IdentityPolicy = "style_only",
        style_source: StyleSource = "reference",
        validation_samples: Annotated[int, Range(1, 1000)] = 2,
        score_by: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.n_vertices = n_vertices
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
        self.unseen_identity: IdentityPolicy = unseen_identity
        self.protocol = protocol
        self.metrics = list(metrics)
        self.validation_samples = validation_samples
        self.score_by = list(score_by)
        self.windows = WindowPlan()
        self.data_source: dict[str, str] = {}
        self.licences: tuple[Licence, ...] = ()
        self.provenance: dict[str, str] = {}
        self.data_options: dict[str, Any] = {}
        self._assets: Assets | None = None
        self.style_source: StyleSource = style_source
        self.person_styles: dict[str, Style] = {}
        self._styles_of_step: int | None = None  # the step whose weights gave the vectors

    @functools.cached_property
    def evaluation(self) -> Evaluation:
        """The metrics of validation and test; a model that only animates makes none.

        Raises:
            FaceDiffError: if there is no such protocol, metric or option.
        """
        return Evaluation(
            self.protocol,
            self.unseen_identity,
            self.metrics,
            validation_samples=self.validation_samples,
            score_by=self.score_by,
        )

    options_path = "model"

    def __init_subclass__(cls, **words: Any) -> None:  # noqa: ANN401
        """Let every model keep its constructor's arguments."""
        super().__init_subclass__(**words)
        if "__init__" in vars(cls):
            cls.__init__ = keeps_arguments(cls.__init__)  # type: ignore[method-assign]

    # What a model adds; :meth:`generate_clips` of the base class too.

    @abstractmethod
    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The loss terms of a batch, unweighted, and their weighted sum ``loss``.

        Args:
            batch: clips with their true motion.
            generator: source of the loss's random numbers; torch's global one if None.
        """

    def encode_style(
        self, reference: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions; of width 0 for a model without a speaking style.

        Args:
            reference: offsets from the template.
            mask: True on valid frames.
        """
        return reference.new_zeros(len(reference), 0)

    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else those of its references."""
        return self.encode_style(batch.reference, batch.reference_mask) if batch.style is None else batch.style

    def default_style(self, identity: str) -> Reference | Style:
        """The style of all of an identity's motion if the model keeps it, else its stored reference.

        Raises:
            FaceDiffError: if it has neither.
        """
        return self.person_styles.get(identity) or super().default_style(identity)

    def styled_identities(self) -> list[str]:
        """The identities that have a style of their own to be conditioned on."""
        return [*{**self.assets.references, **self.person_styles}]

    def with_person_styles(self, batch: Batch) -> Batch:
        """The batch with the style of all motion of each clip's speaker, where the model uses it and knows it."""
        known = [self.person_styles.get(name) for name in batch.identity_names]
        if not any(known) or batch.style is not None:
            return batch
        with torch.no_grad():
            style = self.style_of(batch).clone()
        names = list(batch.reference_names)
        for clip, found in enumerate(known):
            if found is not None:
                style[clip], names[clip] = found.vector.to(style), found.name
        return replace(batch, style=style, reference_names=names)

    def personal_modules(self) -> list[nn.Module]:
        """The parts that hold identity and style; ``facediff adapt --train person`` trains them alone."""
        return []

    @property
    def speech_encoder(self) -> AudioEncoder:
        """The model's audio encoder: the first among its modules.

        Raises:
            FaceDiffError: if there is none.
        """
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
        parameters = [p for p in self.parameters() if p.requires_grad]
        # Fused: one pass over all parameters instead of several operations for each.
        optimizer = torch.optim.AdamW(parameters, lr=self.learning_rate, weight_decay=self.weight_decay, fused=True)
        # A fused optimiser could undo a loss scale itself, so Lightning refuses to clip its gradients in mixed
        # precision. Without this mark, the scale is undone before gradients are clipped.
        optimizer._step_supports_amp_scaling = False
        if self.lr_schedule == "constant" and not self.warmup_steps:
            return optimizer
        total = int(self.trainer.estimated_stepping_batches)
        factor = functools.partial(
            lr_factor,
            total=total,
            warmup_steps=self.warmup_steps,
            schedule=self.lr_schedule,
            epoch_steps=self._steps_an_epoch() if self.lr_schedule in ("exponential", "step") else 1,
            decay=self.lr_decay,
            decay_epoch=self.lr_decay_epoch,
        )
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

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
        """Stop training whose loss is no number any more: no further step can mend its weights.

        Raises:
            FaceDiffError: with what to change.
        """
        # On an accelerator, looking at every loss would wait for the device. In 16-bit mixed precision an overflow is
        # usual, and the step is skipped.
        looked_at = loss.device.type == "cpu" or self.trainer.global_step % DIVERGENCE_INTERVAL == 0
        if looked_at and str(self.trainer.precision) != "16-mixed" and not bool(torch.isfinite(loss)):
            raise FaceDiffError(
                f"training has diverged: the loss is {float(loss)} at step {self.trainer.global_step}. Lower "
                f"model.learning_rate (it is {self.learning_rate:g}), set trainer.gradient_clip_val, or check the "
                f"corpus with `facediff data check`"
            )

    def on_validation_epoch_start(self) -> None:
        """Take the styles of all motion by the weights that are validated; weight averaging has put its own in."""
        self.encode_people()

    def on_test_epoch_start(self) -> None:
        """Take the styles of all motion of the speakers that are tested."""
        self.encode_people()

    def on_predict_epoch_start(self) -> None:
        """Take the styles of all motion of the speakers that are predicted."""
        self.encode_people()

    def encode_people(self, weights: Mapping[str, Tensor] | None = None) -> None:
        """Take every speaker's style from all of their motion, if that is what the model uses.

        The motion is cut into stretches as long as a style reference; a speaker's style is the mean of the stretches'
        vectors, weighted by their frames. Clips of the evaluated splits are never among them.

        Args:
            weights: the weights to encode with, by the names of the state dict; the present ones if None.
        """
        step = int(self.trainer.global_step)
        if self.style_source != "person" or self._styles_of_step == step:
            return
        data: SpeechMotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        encoder, given = StyleEncoding(self), {f"model.{name}": value for name, value in (weights or {}).items()}
        modes = [(module, module.training) for module in self.modules()]
        self.eval()
        styles: dict[str, Style] = {}
        with torch.no_grad():
            for name, clips in data.known_clips().items():
                total, frames = torch.zeros(()), 0
                for clip in clips if name in data.corpus.templates else []:
                    parts = torch.split(data.corpus.read_motion(clip).to(self.device), data.reference_frames)
                    lengths = torch.tensor([len(part) for part in parts], device=self.device)
                    mask = frame_mask(lengths, int(lengths.max()))
                    vectors = torch.func.functional_call(encoder, given, (pad(parts), mask)).float()
                    total, frames = total + (vectors * lengths[:, None]).sum(0).cpu(), frames + int(lengths.sum())
                if frames and total.numel():
                    styles[name] = Style(f"all motion of {name} ({len(clips)} clips)", total / frames)
        for module, mode in modes:
            module.training = mode
        self.person_styles, self._styles_of_step = styles, step

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss with fixed random numbers, so that epochs compare, and the protocol's metrics of generated motion."""
        # The same steps and noise in every epoch; otherwise the curve would show their chance.
        losses = self.losses(batch, torch.Generator(self.device).manual_seed(batch_idx))
        logged = {f"val/{name}": value for name, value in losses.items()}
        self.log_dict(logged, batch_size=0 if batch.repeated else len(batch), sync_dist=True)
        self.evaluation.score(self, "val", self.with_person_styles(batch))

    def on_validation_epoch_end(self) -> None:
        """Log the metrics as ``val/mve`` …."""
        # The metrics have been summed over the processes already; averaging equal values changes nothing.
        self.log_dict(self.evaluation.scalars("val"), prog_bar=False, sync_dist=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Score generated motion, faces that do not move, and the model's motion for another sentence's speech."""
        split = self.evaluation.splits[dataloader_idx]
        batch = self.with_person_styles(batch)
        styles = {name: self.default_style(name) for name in self.styled_identities()}
        for name, view in conditioned(batch, self.unseen_identity, self.identities, styles):
            self.evaluation.score(self, split, view, name)
            if view.decoy_audio is not None:
                decoy = replace(view, audio=view.decoy_audio, features=None)
                self.evaluation.update(split, "shuffled", self.generate(decoy, seed=0), view, name)
        # Baselines: the model with speech that does not belong to the clip, and faces that do not move.
        self.evaluation.score_baselines(split, batch)

    def on_test_epoch_end(self) -> None:
        """Log ``<split>/lve`` and so on; the table is printed by the callback ``ScoreTable``."""
        for split in self.evaluation.splits:
            self.log_dict(self.evaluation.scalars(split), sync_dist=True)

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> list[Prediction]:
        """Absolute vertices of every clip of the batch."""
        batch = self.with_person_styles(batch)
        vertices = self.generate(batch, seed=0) + batch.template[:, None]
        names = [self.identities[i] if i >= 0 else "unknown" for i in batch.identity.tolist()]
        return [
            Prediction(name, names[i], batch.reference_names[i], vertices[i, : int(batch.frame_lengths[i])].cpu())
            for i, name in enumerate(batch.names)
        ]

    # What the model knows of its corpus.

    @property
    def assets(self) -> Assets:
        """Templates, faces, regions, references and scale of the training corpus.

        Raises:
            FaceDiffError: if neither a corpus nor a checkpoint has been seen yet.
        """
        if self._assets is None:
            raise FaceDiffError("the model has no templates yet; train it with a data module or load a checkpoint")
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
            raise OptionError.naming("the model has never been trained: give a checkpoint (--ckpt_path, {checkpoint})")
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
                    f"in the corpus; use a checkpoint that was trained on this topology and these identities"
                )
        self._assets = assets
        self.make_parts(assets)

    def make_parts(self, assets: Assets) -> None:
        """Make modules whose size only the corpus knows; by itself a model has none.

        Called when assets are adopted, also a second time, and before that by what copies the model for a training.

        Args:
            assets: those of the corpus.
        """

    def check_training(self, *, resumed: bool) -> None:
        """Refuse, before a run writes anything, what cannot be trained; by itself a model refuses nothing.

        Args:
            resumed: whether a checkpoint will be loaded into the model.
        """

    def setup(self, stage: str) -> None:
        """Take the assets from the data module; a checkpoint's own replace them when it is loaded."""
        self._styles_of_step = None
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError("facediff's models train and test on a SpeechMotionDataModule; pass datamodule=…")
        if stage != "predict":
            _ = self.evaluation  # an unknown protocol or metric is reported before the corpus is read
        if stage == "fit":
            # The seed that Lightning was given; scores name it, so that runs of one method can be told apart.
            self.provenance |= {"seed": seed} if (seed := os.environ.get("PL_GLOBAL_SEED")) else {}
            # Those of a checkpoint that is adapted or resumed stay: a model inherits from all that it has learnt from.
            self.licences = merged(self.licences, data.licences(), network_licences(dict(self.hparams)))
        self.data_source = {
            "class_path": f"{type(data).__module__}.{type(data).__qualname__}",
            "root": address_of(data.source) or str(Path(data.source).expanduser().resolve()),
        }
        # Measured on the training split once; a resumed or adapted model keeps the scale that its weights know.
        scale = self._assets.motion_scale if self._assets is not None else None
        untrained = self._assets is None and stage == "fit"
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

    def attach_mesh(self) -> None:
        """Give the mesh to those mesh encoders that have none yet; their tables are kept in the checkpoint.

        Raises:
            FaceDiffError: if one needs a mesh and the corpus has none.
        """
        waiting = [m for m in self.modules() if isinstance(m, MeshEncoder) and not m.attached]
        if not waiting:
            return
        if self.assets.faces is None:
            raise FaceDiffError(
                f"mesh_encoder: {type(waiting[0]).__name__} needs the mesh, and {self.assets.corpus} has no "
                f"mesh file; put one into its folder, or choose mesh_encoder=linear"
            )
        template = self.assets.templates[min(self.assets.templates)]
        for encoder in waiting:
            encoder.attach(mesh_hierarchy(template.numpy(), self.assets.faces.numpy(), **encoder.mesh_options))

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Take from the training split what a model that was never trained needs: principal components of motion.

        Args:
            data: set up for training.
            at_least: components that the caller needs, whatever its modules do.

        Returns:
            the components of scaled, weighted motion, each as long as its standard deviation; None if nobody needs any.

        Raises:
            FaceDiffError: if some modules need them and the training motion never changes.
        """
        waiting = [module for module in self.modules() if isinstance(module, PrincipalComponents)]
        count = max([at_least, *(module.count for module in waiting)])
        if not count:
            return None
        weights = self.motion_weights().flatten()
        mean, shapes = data.principal_motion(count, weights)
        for module in waiting:
            module.attach(mean * self.scale, shapes * self.scale, weights)
        return shapes * self.scale

    def motion_weights(self) -> Float[Tensor, "vertices 3"]:
        """What motion is multiplied by before its principal components are taken."""
        return torch.ones(self.n_vertices, 3)

    # Checkpoints.

    def keep_hyperparameters(self, given: dict[str, Any]) -> None:
        """Save the constructor's arguments as plain data, in the form that Lightning rebuilds a module from."""
        options = {**defaults(type(self)), **given}
        for kind in COMPONENTS.keys() & options.keys():
            made = [m for m in self.modules() if isinstance(m, component_class(options[kind]))]
            options[kind] = describe(options[kind], made[0] if made else None)
        self.save_hyperparameters(
            {
                "_class_path": f"{type(self).__module__}.{type(self).__qualname__}",
                "_instantiator": "lightning.pytorch.cli.instantiate_module",
                **plain(options),
            }
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the assets, so that the checkpoint animates without the corpus."""
        checkpoint[FORMAT_KEY] = FORMAT
        checkpoint[ASSETS_KEY] = self.assets.state()
        checkpoint[DATA_SOURCE_KEY] = self.data_source
        checkpoint[LICENCES_KEY] = [licence.state() for licence in self.licences]
        if self.provenance:
            checkpoint[PROVENANCE_KEY] = dict(self.provenance)
        if self.style_source == "person":
            # Of the weights that are saved: weight averaging has replaced the present ones in the checkpoint by now.
            if self._trainer is not None and isinstance(self.trainer.datamodule, SpeechMotionDataModule):  # type: ignore[attr-defined]
                self.encode_people(checkpoint["state_dict"])
            checkpoint[STYLES_KEY] = {name: (style.name, style.vector) for name, style in self.person_styles.items()}

    def save_pretrained(
        self,
        folder: str | Path,
        *,
        half: bool = False,
        license: str | None = None,  # noqa: A002 - the hub's word
        name: str | None = None,
        scores: str | Path | None = None,
        languages: Sequence[str] | None = None,
    ) -> Path:
        """Write the model as a folder that can be handed to others, or sent to the Hugging Face hub.

        ``facediff.load`` and every command that takes a checkpoint read it again. It holds the weights, what animation
        needs of the corpus, and a model card, but nothing that only training needs.

        Args:
            folder: a folder that does not exist, or is empty.
            half: store the parameters in 16 bits: half as large; the motion differs a little.
            license: licence of the weights, such as ``apache-2.0``; that of the data if None.
            name: what the card calls the model; the folder's name if None.
            scores: ``test_scores.csv`` that ``facediff test`` wrote for this model, for the card.
            languages: codes of the languages that it was trained on; those of its corpus if None.

        Returns:
            the folder.

        Raises:
            FaceDiffError: if the folder is not empty or cannot be written.

        Example:
            >>> model.save_pretrained("talking-face", license="apache-2.0")  # doctest: +SKIP
        """
        from facediff.models.pretrained import publish

        table = None if scores is None else Path(scores)
        return publish(self, Path(folder), half=half, licence=license, name=name, scores=table, languages=languages)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the assets from the checkpoint."""
        if ASSETS_KEY in checkpoint:
            self.adopt(Assets.from_state(checkpoint[ASSETS_KEY]))
            self.data_source = checkpoint.get(DATA_SOURCE_KEY, {})
            self.licences = merged(self.licences, self._stated_licences(checkpoint))
            self.provenance = read_provenance(checkpoint)
            self.data_options = dict(checkpoint.get("datamodule_hyper_parameters") or {})
            self.person_styles = read_person_styles(checkpoint.get(STYLES_KEY, {}))

    def _stated_licences(self, checkpoint: dict[str, Any]) -> tuple[Licence, ...]:
        """A checkpoint's labels; of one without, written before there were labels, those of its corpus by name."""
        if LICENCES_KEY in checkpoint:
            return read_licences("its labels", checkpoint[LICENCES_KEY])
        known: list[type[Any]] = [entry.implementation for entry in corpus]
        named = next((each for each in known if getattr(each, "corpus_name", None) == self.assets.corpus), None)
        own = Licence(f"corpus {self.assets.corpus}") if named is None else named.corpus_licence()
        options = checkpoint.get("datamodule_hyper_parameters") or {}
        people = [Licence(f"speaker {Path(str(folder)).name}") for folder in options.get("people") or []]
        return merged([own], people, network_licences(dict(self.hparams)))

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path | IO[bytes],
        *arguments: Any,  # noqa: ANN401
        **options: Any,  # noqa: ANN401
    ) -> Self:
        """Lightning's method, after the checks that every checkpoint goes through; the arguments are Lightning's.

        Raises:
            FaceDiffError: as :func:`facediff.models.checkpoint.read_checkpoint`.
        """
        from facediff.models.checkpoint import checked_file

        with checked_file(checkpoint_path) as stream:
            made: Self = super().load_from_checkpoint(stream, *arguments, **{**options, "weights_only": True})
        return made


class StyleEncoding(nn.Module):
    """A model's style encoder as a module, so that it can be called with other weights than the model has.

    Args:
        model: the model.
    """

    def __init__(self, model: AnimationModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, reference: Tensor, mask: Tensor) -> Tensor:
        """Style vectors, as :meth:`AnimationModel.encode_style` gives them."""
        return self.model.encode_style(reference, mask)


def read_provenance(checkpoint: Mapping[str, Any]) -> dict[str, str]:
    """What a checkpoint was made from; the epochs and steps of one that says nothing else.

    Raises:
        FaceDiffError: if it is anything but short texts by name.
    """
    found = checkpoint.get(PROVENANCE_KEY, {})
    if not isinstance(found, dict) or not all(
        isinstance(text, str) and is_plain_text(text) for item in found.items() for text in item
    ):
        raise FaceDiffError(f"its provenance is {quoted(found)}; expected texts by name. The file is damaged")
    counted = {"epochs": checkpoint.get("epoch"), "steps": checkpoint.get("global_step")}
    return {**found, **{name: str(count) for name, count in counted.items() if isinstance(count, int)}}


def read_person_styles(state: object) -> dict[str, Style]:
    """The styles of all motion of each speaker, from a checkpoint.

    Raises:
        FaceDiffError: if they are anything but finite vectors of one length, by speaker.
    """
    if not isinstance(state, dict):
        raise FaceDiffError(f"its styles are {quoted(state)}; expected vectors by speaker. The file is damaged")
    styles: dict[str, Style] = {}
    for name, value in state.items():
        fits = is_name(name) and isinstance(value, list | tuple) and len(value) == 2 and isinstance(value[0], str)
        vector = value[1] if fits and is_plain_text(value[0]) else None
        if not isinstance(vector, Tensor) or vector.ndim != 1 or not bool(vector.isfinite().all()):
            raise FaceDiffError(
                f"its style of {quoted(name)} is {quoted(value)}; expected a name and a finite vector. The file is "
                f"damaged"
            )
        styles[name] = Style(value[0], vector.float())
    LIMITS.check("identities", len(styles), STYLES_KEY)
    if len({len(style.vector) for style in styles.values()}) > 1:
        raise FaceDiffError("its styles of speakers differ in length; expected one length. The file is damaged")
    return styles
