"""The moving average of the weights, with a warm-up: validation, previews and checkpoints use the averaged weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import StochasticWeightAveraging, WeightAveraging
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from facediff.data import SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.utils.hints import checks_arguments
from facediff.utils.ranges import Range


class EmaWithWarmup(WeightAveraging):
    """Exponential moving average of the weights with a decay that rises from a small value to ``decay``.

    After k averaged steps the decay is min(``decay``, (1 + k) / (``warmup`` + k)), as in TensorFlow's
    ``ExponentialMovingAverage``. A constant decay d keeps the share dⁿ of the first, untrained weights after n steps:
    a tenth for 0.999 and 2 350 steps. With the warm-up, the average is about that of the last 1 / (``warmup`` − 1) of
    the steps until ``decay`` is reached, so it suits a training of any length.

    Buffers are not averaged but taken over: they hold constants (filters, windows), which averaging would make drift.

    Args:
        decay: the largest decay.
        warmup: how slowly the decay rises; 1 is a constant decay.
        device: where the averaged weights are kept; the model's own device if None.
    """

    @checks_arguments
    def __init__(
        self,
        decay: Annotated[float, Range(0, 1)] = 0.999,
        warmup: Annotated[float, Range(1, 1e9)] = 10.0,
        device: str | None = None,
    ) -> None:
        self.decay, self.warmup, self.device = decay, warmup, device
        self.begin()

    def begin(self) -> None:
        """Know nothing of earlier runs."""
        super().__init__(device=self.device, use_buffers=False, multi_avg_fn=self.average)
        self._swapped = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Copy the whole model; its own set-up by the corpus comes later."""
        callbacks = getattr(trainer, "callbacks", ())
        averaging = [c for c in callbacks if isinstance(c, WeightAveraging | StochasticWeightAveraging)]
        if stage == "fit" and len(averaging) > 1:
            raise FaceDiffError(
                f"--trainer.callbacks: {' and '.join(type(callback).__name__ for callback in averaging)} average the "
                f"weights, and a checkpoint has one average; leave one, with --trainer.callbacks=[] before others"
            )
        data = getattr(trainer, "datamodule", None)
        if stage == "fit" and isinstance(pl_module, AnimationModel) and isinstance(data, SpeechMotionDataModule):
            pl_module.make_parts(data.assets())
        self.begin()
        super().setup(trainer, pl_module, stage)

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Continue averaging in training; scores and predictions are of the average, which the model has loaded."""
        if trainer.state.fn == TrainerFn.FITTING:
            super().on_load_checkpoint(trainer, pl_module, checkpoint)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the average, also where a checkpoint left nothing to train."""
        self.on_train_end(trainer, pl_module)

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Validate the average during training; otherwise the model has the weights to be validated."""
        if trainer.state.fn == TrainerFn.FITTING:
            super().on_validation_epoch_start(trainer, pl_module)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Put the trained weights back."""
        if trainer.state.fn == TrainerFn.FITTING:
            super().on_validation_epoch_end(trainer, pl_module)

    def _swap_models(self, pl_module: LightningModule) -> None:
        super()._swap_models(pl_module)
        self._swapped = not self._swapped

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Put the trained weights back where a validation was stopped; a checkpoint may follow."""
        if self._swapped:
            self._swap_models(pl_module)

    @torch.no_grad()
    def average(self, averages: Sequence[Tensor], weights: Sequence[Tensor], step: Tensor) -> None:
        """Update the averages of weights of one type on one device."""
        step = step.float()
        share = (1 - ((1 + step) / (self.warmup + step)).clamp(max=self.decay)).to(averages[0].dtype)
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight, share)
