"""Writing what ``facediff predict`` predicts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter

from facediff.files import atomic
from facediff.systems.animation import Prediction


class PredictionWriter(BasePredictionWriter):
    """Writes every predicted clip as ``<clip>_condition_<identity>.npy``, (T, 3V) absolute vertices, float32.

    The name and the shape are those of the field's released projects, so that their scripts read the files.

    Args:
        output_dir: the folder; ``predictions`` in the run's folder if None.
    """

    def __init__(self, output_dir: str | None = None) -> None:
        super().__init__(write_interval="batch")
        self.output_dir = output_dir
        self.folder = Path()

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Settle the folder on every process at once: where the run's folder is, is broadcast."""
        run = trainer.log_dir or trainer.default_root_dir
        self.folder = Path(self.output_dir or Path(run) / "predictions")

    def write_on_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        prediction: Any,  # noqa: ANN401
        batch_indices: Sequence[int] | None,
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int,
    ) -> None:
        """Write a batch's clips, each file whole or not at all."""
        clips: list[Prediction] = prediction
        for clip in clips:
            path = self.folder / f"{clip.name}_condition_{clip.identity}.npy"
            with atomic(path) as temporary:
                np.save(temporary, clip.vertices.flatten(1).numpy())

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say where the files are."""
        if trainer.is_global_zero:
            print(f"written: {self.folder}")
