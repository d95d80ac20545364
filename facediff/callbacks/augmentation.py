"""Training clips of speakers who do not exist, so that the reference alone says how a stranger moves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from lightning.pytorch.callbacks import Callback

from facediff.registry import checks_arguments
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from lightning.pytorch import LightningModule, Trainer
    from torch import Tensor

    from facediff.data import Batch, SpeechMotionDataModule


class InventedSpeakers(Callback):
    """Turns a share of the training clips into clips of speakers who do not exist.

    A corpus has a handful of speakers. A style encoder that has seen only these learns to recognise them, and answers a
    stranger with one of them. Here all of a clip's motion is multiplied by one random gain and each of its principal
    components by another, its style reference gets the very same gains, and the identity is hidden: how wide this
    speaker opens the jaw or raises the brows can be told from the reference only. Timing, and the shapes of movements,
    stay those of the speaker. Validation and test are not touched.

    Large gains cost more than they bring: with 0.15 for both, sentences of the trained speakers were scored four times
    as bad (docs/generation.md).

    Args:
        share: of the training clips.
        deviation: standard deviation of the logarithm of the gain on all motion.
        component_deviation: standard deviation of the logarithms of the components' gains.
        count: principal components that get gains of their own.
    """

    @checks_arguments
    def __init__(
        self,
        share: Annotated[float, Range(0, 1)] = 0.3,
        deviation: Annotated[float, Range(0, 1)] = 0.1,
        component_deviation: Annotated[float, Range(0, 1)] = 0.05,
        count: Annotated[int, Range(1, 4096)] = 64,
    ) -> None:
        self.share = share
        self.deviation = deviation
        self.component_deviation = component_deviation
        self.count = count
        self._components: tuple[Tensor, Tensor] | None = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take the principal components of the training motion."""
        data: SpeechMotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
        mean, shapes = data.principal_motion(self.count)
        unit = shapes / torch.linalg.vector_norm(shapes, dim=1, keepdim=True)
        self._components = mean.to(pl_module.device), unit.to(pl_module.device)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Batch, batch_idx: int) -> None:
        """Change some of the batch's clips, in place."""
        device = batch.motion.device
        chosen = torch.rand(len(batch), device=device) < self.share
        if self._components is None or not chosen.any():
            return
        mean, unit = self._components
        clips = int(chosen.sum())
        every = (torch.randn(clips, 1, 1, device=device) * self.deviation).exp()
        own = (torch.randn(clips, 1, len(unit), device=device) * self.component_deviation).exp()
        for motion in (batch.motion, batch.reference):
            centred = motion[chosen].flatten(2) - mean
            centred = centred + (centred @ unit.T * (own - 1)) @ unit
            motion[chosen] = (every * centred + mean).view(clips, motion.shape[1], -1, 3)
        batch.identity.masked_fill_(chosen, -1)
