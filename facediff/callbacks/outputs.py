"""Lines for each epoch of training, what ``facediff test`` prints and writes, and the files of ``facediff predict``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter, ModelCheckpoint
from lightning.pytorch.loggers import WandbLogger

from facediff.callbacks.dashboard import measure_clips, provenance_of, wandb_media, worst_clips
from facediff.data import SpeechMotionDataModule
from facediff.models import AnimationModel
from facediff.models.evaluation import METHODS
from facediff.models.inference import Prediction
from facediff.utils.files import atomic
from facediff.utils.hints import checks_arguments
from facediff.utils.plain_files import write_json, write_rows
from facediff.utils.ranges import Range
from facediff.utils.tables import format_table

METHOD_NAMES = {name: label.format(model="model") for name, label in METHODS.items()}


class EpochLines(Callback):
    """Prints a line after each epoch of training, where no terminal would show a progress bar.

    The line has the training loss, what is monitored in validation (names that a run logs, see ``docs/monitoring.md``)
    where that has been measured in this epoch, and the seconds since training began. It goes to standard error.
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


class ScoreTable(Callback):
    """Prints the test scores with their protocol, regions and counts, and writes them as CSV.

    Next to the model are scored a face that never moves, the mean face of each speaker's training clips, which does not
    move either, and the model given another sentence's speech. Weights & Biases gets the table of sequences as
    ``test/sequences``, with sound and a picture of the errors for the worst clips, and the protocol's definition in the
    run's config. Which training run is scored (its seed, the checkpoint's SHA-256, the components) stands in every row
    of the scores, and in ``provenance.json``.

    Args:
        file: name of the CSV file in the run's folder; None writes none.
        groups_file: name of the CSV file with the scores by ``model.score_by``; None writes none.
        sequences_file: name of the CSV file with one row per clip and method; None writes none.
        media_clips: how many clips get sound and picture, the worst by LVE of all processes. They are predicted once
            more, by the first process alone, one at a time; nothing is kept in memory during the test.
        report_file: name of the JSON file with all of it for programs, such as ``facediff benchmark``: scores,
            sequences, what each column means, and the training run; None writes none.
    """

    @checks_arguments
    def __init__(
        self,
        file: str | None = "test_scores.csv",
        sequences_file: str | None = "test_sequences.csv",
        media_clips: Annotated[int, Range(0, 10_000)] = 8,
        groups_file: str | None = "test_scores_by.csv",
        report_file: str | None = "test_report.json",
    ) -> None:
        self.file = file
        self.report_file = report_file
        self.sequences_file = sequences_file
        self.media_clips = media_clips
        self.groups_file = groups_file

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print and write; runs before the model logs and empties its metrics."""
        if not isinstance(pl_module, AnimationModel) or trainer.sanity_checking:
            return
        evaluation = pl_module.evaluation
        rows = [row for split in evaluation.splits for row in evaluation.rows(split)]
        groups = [row for split in evaluation.splits for row in evaluation.groups(split)]
        sequences = evaluation.sequences()
        folder = trainer.log_dir  # asked for on every process: the answer is broadcast
        if not trainer.is_global_zero:
            return
        assets = pl_module.assets
        chosen = list(evaluation.requests)
        print(describe_scores(rows, assets.corpus, synthetic=assets.synthetic, metrics=chosen))
        if groups:
            print(describe_groups(groups, evaluation.score_by))
        print(evaluation.describe())
        if groups and self.groups_file and folder:
            write_rows(Path(folder) / self.groups_file, groups)
            print(f"written: {Path(folder) / self.groups_file}")
        provenance = None
        if folder and (self.file or self.report_file):
            provenance = provenance_of(trainer, pl_module, trainer.datamodule)  # type: ignore[attr-defined]
            provenance.write(Path(folder))
        if self.file and folder and provenance is not None:
            # Regions become the columns <region>_vertices and <region>_hash.
            flat = []
            for row in rows:
                line = {key: value for key, value in row.items() if key != "regions"}
                for part, region in row["regions"].items():
                    line |= {f"{part}_vertices": region["count"], f"{part}_hash": region["hash"]}
                flat.append(line | provenance.columns())
            write_rows(Path(folder) / self.file, flat)
            print(f"written: {Path(folder) / self.file}")
        if self.sequences_file and folder:
            write_rows(Path(folder) / self.sequences_file, sequences)
            print(f"written: {Path(folder) / self.sequences_file}")
        if self.report_file and folder and provenance is not None:
            everything = {
                "format": 1,
                "provenance": provenance.as_dict(),
                "synthetic": assets.synthetic,
                "definition": evaluation.describe(),
                "columns": evaluation.columns(),
                "scores": rows,
                "sequences": sequences,
            }
            write_json(Path(folder) / self.report_file, everything)
        sys.stdout.flush()
        loggers = [logger for logger in trainer.loggers if isinstance(logger, WandbLogger)]
        if loggers:
            worst = worst_clips(sequences, self.media_clips)
            media = wandb_media(pl_module, measure_clips(trainer, pl_module, worst))
            for logger in loggers:
                log_sequences(logger, sequences, evaluation.describe(), media)


def log_sequences(
    logger: WandbLogger, sequences: list[dict[str, Any]], definition: str, media: dict[tuple[str, str, str], list[Any]]
) -> None:
    """Give Weights & Biases the table of sequences, a row per clip and method, and the words that define its numbers.

    Media are sound and picture by split, clip and identity; the model's rows that have them come first, in this order.
    """
    columns = list(sequences[0])
    places = {key: place for place, key in enumerate(media)}
    data: list[tuple[int, list[Any]]] = []
    for row in sequences:
        key = (row["split"], row["clip"], row["identity"])
        shown = row["method"] == "model" and key in media
        values = [*(row[name] for name in columns), *(media[key] if shown else (None, None))]
        data.append((places[key] if shown else len(places), values))
    data.sort(key=lambda entry: entry[0])  # stable: all others stay in their order
    logger.log_table("test/sequences", columns=[*columns, "audio", "error"], data=[values for _, values in data])
    logger.experiment.config.update({"protocol_definition": definition}, allow_val_change=True)


def describe_scores(rows: list[dict[str, Any]], corpus: str, *, synthetic: bool, metrics: Sequence[str] = ()) -> str:
    """The scores as text, one row per split and method, with what they were taken over."""
    names = [name for name in ("mve", "lve", "fdd", "fdd_absolute") if name in rows[0]]
    kind = "SYNTHETIC corpus" if synthetic else "corpus"
    lines = [f"\n{kind} {corpus}, protocol {rows[0]['protocol']}, unseen speakers: {rows[0]['unseen_identity']}"]
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


def describe_groups(rows: list[dict[str, Any]], by: Sequence[str]) -> str:
    """The scores of groups of clips as text, one row per split, group and method."""
    names = [name for name in ("mve", "lve", "fdd", "fdd_absolute") if name in rows[0]]
    head = ["split", *by, "method", *map(str.upper, names), "frames", "clips"]
    order = sorted(rows, key=lambda row: (row["split"], *(row[name] for name in by)))  # stable: methods keep theirs
    body = [
        [
            row["split"],
            *(row[name] or "-" for name in by),
            METHOD_NAMES[row["method"]],
            *(None if row[name] is None else f"{row[name]:.4e}" for name in names),
            row["frames"],
            row["sequences"],
        ]
        for row in order
    ]
    return f"\nby {', '.join(by)}\n{format_table(head, body, left=2 + len(by))}"


class PredictionWriter(BasePredictionWriter):
    """Writes every predicted clip as ``<clip>_condition_<identity>.npy``, (T, 3V) absolute vertices, float32.

    The name and the shape are those of the field's released projects, so that their scripts read the files.

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
        """Say which training run the files are of, and print where they are."""
        if trainer.is_global_zero and not trainer.fast_dev_run:  # type: ignore[attr-defined]
            data = trainer.datamodule  # type: ignore[attr-defined]
            if isinstance(pl_module, AnimationModel) and isinstance(data, SpeechMotionDataModule):
                provenance_of(trainer, pl_module, data).write_next_to(self.folder)
            print(f"written: {self.folder}")
