"""Teach an audio encoder the sounds of many people beside the motion of a corpus."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import nn

from facediff.callbacks.runs import require_facediff
from facediff.data.spoken_sounds import IGNORED, SOUNDS, SpokenSounds
from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.utils.hints import checks_arguments
from facediff.utils.ranges import Range

RARE = {1: 3.0, 2: 2.0, 3: 2.0}
"""Weights of the sounds that are short and seen best: bilabial, labiodental, rounded."""


class SpokenSoundsTerm(Callback):
    """Adds to the gradient that of telling visible sounds from the audio encoder's features, in people's recordings.

    A corpus of few synthetic voices teaches its encoder these voices. People's recordings have no motion; which sound
    is spoken when can be had of them by `facediff data align`. In each training step a linear map, which is used in
    training only, tells the sounds of a few pieces, half of them people's and half of them the corpus's; cross-entropy
    is added to the model's loss.

    Args:
        recordings: folder of `facediff data align`.
        weight: of the cross-entropy.
        batch_size: pieces in a step.
        seconds: longest piece.
        learning_rate: of the linear map.
    """

    @checks_arguments
    def __init__(
        self,
        recordings: str,
        *,
        weight: Annotated[float, Range(0, 100)] = 0.3,
        batch_size: Annotated[int, Range(2, 1024)] = 16,
        seconds: Annotated[float, Range(0.2, 30)] = 3.0,
        learning_rate: Annotated[float, Range(0, 1)] = 1e-3,
    ) -> None:
        self.recordings, self.weight = recordings, weight
        self.batch_size, self.seconds, self.learning_rate = batch_size, seconds, learning_rate
        self.head: nn.Linear | None = None
        self._state: dict[str, Any] = {}

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Know nothing of earlier runs; the state of a run that is continued is loaded after it."""
        self.head, self._state = None, {}

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Read the recordings."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if trainer.world_size > 1 or trainer.precision == "16-mixed":
            raise FaceDiffError(
                "SpokenSoundsTerm: its gradient is neither shared between processes nor scaled; train with one "
                "process, in 32 bits or bf16-mixed"
            )
        require_facediff(self, pl_module, data)
        self._sounds = SpokenSounds(Path(self.recordings).expanduser(), data)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:  # noqa: ANN401, ARG002
        """Draw by epoch and batch, so that a resumed training draws the same pieces."""
        self._random = np.random.default_rng([trainer.current_epoch, batch_idx])

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Add the gradient of the term."""
        batch, device = self._sounds.draw(self.batch_size, self.seconds, self._random), pl_module.device
        lengths = batch.audio_lengths.to(device), batch.frame_lengths.to(device)
        # The model's random numbers go on as without this term.
        with (
            torch.random.fork_rng([] if device.type == "cpu" else [device]),
            trainer.precision_plugin.forward_context(),
        ):
            torch.manual_seed(int(self._random.integers(2**31)))
            features = cast(AnimationModel, pl_module).speech_encoder(batch.audio.to(device), *lengths)
            head, optimiser = self._map(features)
        weights = torch.tensor([RARE.get(sound, 1.0) for sound in range(len(SOUNDS))], device=device)
        loss = nn.functional.cross_entropy(
            head(features.float()).flatten(0, 1), batch.sounds.to(device).flatten(), weights, ignore_index=IGNORED
        )
        optimiser.zero_grad()
        (self.weight / trainer.accumulate_grad_batches * loss).backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        pl_module.log("train/spoken_sounds", loss.detach(), batch_size=self.batch_size)

    def _map(self, features: torch.Tensor) -> tuple[nn.Linear, torch.optim.Optimizer]:
        """The linear map and its optimiser, made by the first features."""
        if self.head is None:
            self.head = nn.Linear(features.shape[-1], len(SOUNDS), device=features.device)
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)
            self._optimiser = torch.optim.AdamW(self.head.parameters(), lr=self.learning_rate, weight_decay=0.0)
            if self._state:
                self.head.load_state_dict(self._state["head"])
                self._optimiser.load_state_dict(self._state["optimiser"])
        return self.head, self._optimiser

    def state_dict(self) -> dict[str, Any]:
        """The linear map, for a training that continues."""
        if self.head is None:
            return self._state
        return {"head": self.head.state_dict(), "optimiser": self._optimiser.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue with it."""
        self._state = state_dict
