"""Averaged weights for a moment, when they are not in place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging


@contextmanager
def averaged_weights(trainer: Trainer, system: LightningModule) -> Iterator[None]:
    """The weights that a checkpoint would hold are in the system; its own are back afterwards.

    At the end of training, callbacks before the averaging one see the raw weights and later ones the averaged. Asked
    for as for a checkpoint, the averaged ones are had in any order.

    Args:
        trainer: its callbacks are looked at; nothing happens if none of them averages weights.
        system: the module, not wrapped by a strategy.
    """
    averaging = next((found for found in trainer.callbacks if isinstance(found, WeightAveraging)), None)  # type: ignore[attr-defined]
    checkpoint: dict[str, Any] = {"state_dict": {}}
    if averaging is not None:
        averaging.on_save_checkpoint(trainer, system, checkpoint)
    averaged: dict[str, torch.Tensor] = checkpoint["state_dict"]
    own = {name: tensor for name, tensor in system.state_dict().items() if name in averaged}
    kept = {name: tensor.clone() for name, tensor in own.items()}
    try:
        with torch.no_grad():
            for name, tensor in own.items():
                tensor.copy_(averaged[name])
        yield
    finally:
        with torch.no_grad():
            for name, tensor in own.items():
                tensor.copy_(kept[name])
