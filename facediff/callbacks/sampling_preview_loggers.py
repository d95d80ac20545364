"""Where previews are shown beside the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger

from facediff.callbacks.sampling_preview_drawing import ClipPreview
from facediff.data.audio import SAMPLE_RATE


def run_folder(trainer: Trainer) -> Path:
    """The run's folder, where Lightning keeps its checkpoints too.

    Unlike ``trainer.log_dir``, which every process must ask for, this may be asked for by the first one alone.
    """
    logger = trainer.logger
    if logger is None:
        return Path(trainer.default_root_dir)
    if logger.log_dir:
        return Path(logger.log_dir)
    version = logger.version if isinstance(logger.version, str) else f"version_{logger.version}"
    return Path(logger.save_dir or trainer.default_root_dir) / str(logger.name) / version


class Showcase:
    """Gives previews to the loggers that can show them; others find the files in the run's folder."""

    def __init__(self) -> None:
        self._tables: dict[int, Any] = {}

    def show(self, logger: Logger, clips: Sequence[ClipPreview], epochs: int, step: int) -> None:
        """Show the clips of one epoch.

        Args:
            logger: any logger; only Weights & Biases and TensorBoard are given something.
            clips: what was drawn.
            epochs: epochs trained so far.
            step: optimiser steps so far.
        """
        if isinstance(logger, WandbLogger):
            self._show_wandb(logger, clips, epochs, step)
        elif isinstance(logger, TensorBoardLogger):
            for clip in clips:
                name = f"preview/{clip.name}"
                logger.experiment.add_image(name, clip.sheet, step, dataformats="HWC")
                logger.experiment.add_audio(name, clip.audio[None], step, sample_rate=SAMPLE_RATE)

    def _show_wandb(self, logger: WandbLogger, clips: Sequence[ClipPreview], epochs: int, step: int) -> None:
        """A video per clip, and a table that grows by the clips of every epoch."""
        import wandb

        def video(clip: ClipPreview) -> wandb.Video:
            return wandb.Video(str(clip.video), caption=f"{clip.name} after epoch {epochs}", format="mp4")

        columns = ["clip", "epoch", "video", *clips[0].scores]
        made = wandb.Table(columns=columns, log_mode="INCREMENTAL")
        table = self._tables.setdefault(id(logger), made)
        for clip in clips:
            table.add_data(clip.name, epochs, video(clip), *clip.scores.values())
        shown: dict[str, Any] = {f"preview/{clip.name}": video(clip) for clip in clips}
        logger.log_metrics({**shown, "preview/clips": table}, step)
