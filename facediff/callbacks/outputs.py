"""Lines for each epoch of training, the output of ``facediff test``, and the files of ``facediff predict``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter, ModelCheckpoint
from lightning.pytorch.loggers import WandbLogger

from facediff.callbacks.dashboard import provenance_of
from facediff.data import SpeechMotionDataModule
from facediff.errors import counted, note, number
from facediff.models import AnimationModel
from facediff.models.evaluation import METHODS, count_generations
from facediff.models.inference import Prediction
from facediff.utils.files import atomic
from facediff.utils.hints import checks_arguments
from facediff.utils.plain_files import write_json, write_rows
from facediff.utils.text_tables import format_table

METHOD_NAMES = {name: label.format(model="model") for name, label in METHODS.items()}


class EpochLines(Callback):
    """Prints a line after each epoch of training, where no terminal would show a progress bar.

    The line has the training loss, the monitored score of validation (names as in ``docs/monitoring.md``) if it was
    measured in this epoch, and the seconds since training began. It goes to standard error.
    """

    _validated = False

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Note that there are new scores."""
        self._validated = not trainer.sanity_checking

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember when training began."""
        self._started = time.monotonic()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the line, on one process."""
        if not trainer.is_global_zero:
            return
        monitored = [
            callback.monitor for callback in trainer.checkpoint_callbacks if isinstance(callback, ModelCheckpoint)
        ]
        names = ["train/loss", *(dict.fromkeys(monitored) if self._validated else ())]
        self._validated = False
        metrics = trainer.callback_metrics
        values = ", ".join(f"{name} {float(metrics[name]):.4g}" for name in names if name in metrics)
        last = f" of {trainer.max_epochs}" if trainer.max_epochs not in (None, -1) else ""
        seconds = time.monotonic() - self._started
        print(f"epoch {trainer.current_epoch + 1}{last}: {values}, {seconds:.0f} s", file=sys.stderr, flush=True)


MANY_STEPS = 1_000_000
"""Steps of all animations of a test above which it takes days; a thousand take some seconds on a GPU."""


class ScoreTable(Callback):
    """Prints the test scores with their protocol, regions and counts, and writes them as CSV.

    Next to the model are scored a still face, the mean face of each speaker's training clips, and the model with
    another sentence's speech. The run's folder gets ``test_scores.csv``, ``test_sequences.csv`` (a row per clip and
    method), ``test_report.json`` (all of it for programs, such as ``facediff benchmark``) and ``provenance.json``, the
    training run: its seed, components and the checkpoint's SHA-256, which are also in every row of the scores. Weights
    & Biases gets the table of sequences as ``test/sequences``, and the protocol's definition in the run's config.
    """

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say how much is generated where that takes days: a paper's own test may."""
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(pl_module, AnimationModel) or data is None or not trainer.is_global_zero:
            return
        samples = pl_module.test_samples if pl_module.samples else 1
        count = count_generations(data, pl_module.unseen_identity, samples)
        steps = int(getattr(getattr(pl_module, "sampler", None), "steps", 1))
        if count * steps > MANY_STEPS:
            note(
                f"the test generates about {number(count)} animations of {counted(steps, 'sampling step')}; fewer: "
                f"--data.test_share, --model.unseen_identity=style_only, --model.test_samples, or "
                f"--model.sampler.steps; faster: --data.batch_size"
            )

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print and write; runs before the model logs and empties its metrics."""
        if not isinstance(pl_module, AnimationModel) or trainer.sanity_checking:
            return
        evaluation = pl_module.evaluation
        rows = [row for split in evaluation.splits for row in evaluation.rows(split)]
        sequences = evaluation.sequences()
        folder = trainer.log_dir  # asked for on every process: the answer is broadcast
        if not trainer.is_global_zero:
            return
        assets = pl_module.assets
        metrics = list(evaluation.requests)
        print(describe_scores(rows, assets.corpus, synthetic=assets.synthetic, metrics=metrics))
        print(evaluation.describe())
        if folder:
            provenance = provenance_of(trainer, pl_module, trainer.datamodule)  # type: ignore[attr-defined]
            provenance.write(Path(folder))
            # Regions become the columns <region>_vertices and <region>_hash.
            flat = []
            for row in rows:
                line = {key: value for key, value in row.items() if key != "regions"}
                for part, region in row["regions"].items():
                    line |= {f"{part}_vertices": region["count"], f"{part}_hash": region["hash"]}
                flat.append(line | provenance.columns())
            for name, table in {"test_scores.csv": flat, "test_sequences.csv": sequences}.items():
                if table:
                    write_rows(Path(folder) / name, table)
                    print(f"written: {Path(folder) / name}")
            report = {
                "format": 1,
                "provenance": provenance.as_dict(),
                "synthetic": assets.synthetic,
                "definition": evaluation.describe(),
                "columns": evaluation.columns(),
                "scores": rows,
                "sequences": sequences,
            }
            write_json(Path(folder) / "test_report.json", report)
        sys.stdout.flush()
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                rows_of_values = [list(row.values()) for row in sequences]
                logger.log_table("test/sequences", columns=list(sequences[0]), data=rows_of_values)
                config = {"protocol_definition": evaluation.describe()}
                logger.experiment.config.update(config, allow_val_change=True)


def describe_scores(rows: list[dict[str, Any]], corpus: str, *, synthetic: bool, metrics: Sequence[str] = ()) -> str:
    """The scores as text, one row per split and method, with regions, frames and clips."""
    names = [name for name in ("mve", "lve", "fdd", "fdd_absolute") if name in rows[0]]
    kind = "SYNTHETIC corpus" if synthetic else "corpus"
    share = f"; {100 * rows[0]['test_share']:.4g} % of the test clips, a sub-sample" if "test_share" in rows[0] else ""
    lines = [f"\n{kind} {corpus}, protocol {rows[0]['protocol']}, unseen speakers: {rows[0]['unseen_identity']}{share}"]
    for region in rows[0]["regions"].values():
        lines.append(f"region {region['name']}: {region['count']} vertices, hash {region['hash']}")
    head = ["split", "method", *map(str.upper, names), "frames", "clips"]
    body = []
    for row in rows:
        scores = [f"{row[name]:.4e}" for name in names]
        body.append([row["split"], METHOD_NAMES[row["method"]], *scores, row["frames"], row["sequences"]])
    lines.append(format_table(head, body, left=2))
    if metrics:  # their names, with options, are long: one row for each
        methods = [f"{row['split']}: {METHOD_NAMES[row['method']]}" for row in rows]
        values = [[name, *(None if row[name] is None else f"{row[name]:.4e}" for row in rows)] for name in metrics]
        lines += ["", format_table(["metric", *methods], values)]
    return "\n".join(lines)


class PredictionWriter(BasePredictionWriter):
    """Writes every predicted clip as ``<clip>_condition_<identity>.npy``, (T, 3V) absolute vertices, float32.

    Released projects use the same names and shapes, so that their scripts read the files.

    Args:
        output_dir: the folder; ``predictions`` in the run's folder if None.
    """

    @checks_arguments
    def __init__(self, output_dir: str | None = None) -> None:
        super().__init__(write_interval="batch")
        self.output_dir = output_dir
        self.folder = Path()

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Choose the folder on every process at the same time: the path of the run's folder is broadcast."""
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
        """Write a batch's clips, each file whole or not at all; nothing of a trial with ``fast_dev_run``."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        clips: list[Prediction] = prediction
        for clip in clips:
            path = self.folder / f"{clip.name}_condition_{clip.identity}.npy"
            with atomic(path) as temporary:
                np.save(temporary, clip.vertices.flatten(1).numpy())

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the training run of the files next to them, and print their folder."""
        if trainer.is_global_zero and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            data = trainer.datamodule  # type: ignore[attr-defined]
            if isinstance(pl_module, AnimationModel) and isinstance(data, SpeechMotionDataModule):
                provenance_of(trainer, pl_module, data).write_next_to(self.folder)
            print(f"written: {self.folder}")
