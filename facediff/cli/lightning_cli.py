"""LightningCLI as facediff uses it: sizes of the model from the data, callbacks that every run has, runs that continue.

Importing Lightning and jsonargparse takes seconds, so :mod:`facediff.cli.lightning` imports this module only once the
arguments have been checked.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from enum import Enum
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
import yaml
from jsonargparse import ArgumentError as ParsingError
from jsonargparse import set_parsing_settings
from jsonargparse.typing import register_type
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, WeightAveraging
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from omegaconf import OmegaConf

from facediff.callbacks import EpochLines, LastCheckpoint, defaults
from facediff.callbacks.checkpoints import AtomicCheckpointIO, requeue_on_signal, slurm_plugins
from facediff.callbacks.runs import continued_run, entered_run, find_checkpoint, find_scored, run_loggers
from facediff.cli.configs import explain, guard_configs
from facediff.cli.process import chain
from facediff.data import SpeechMotionDataModule
from facediff.errors import ArgumentError, FaceDiffError
from facediff.hyperparameters import plain
from facediff.models import AnimationModel
from facediff.models.checkpoint import read_checkpoint
from facediff.models.optimizers import configure, schedule_changed
from facediff.spaces import Space
from facediff.utils.files import atomic
from facediff.utils.limits import brief
from facediff.utils.progress import on_terminal

LINKS = ("n_vertices", "identities", "frame_rate", "space", "faces")
"""Constructor arguments of a model that the data module knows; not every model has ``faces``."""


def run_lightning_cli(name: str, arguments: Sequence[str], experiment: str) -> FaceDiffCLI:
    """Run a subcommand of complete arguments; see :func:`facediff.cli.lightning.run_cli`."""
    logger = {"class_path": LOGGERS[0], "init_args": {"save_dir": "runs", "name": experiment}}
    with (
        parsing([name, *arguments], experiment),
        without_warnings(*IDLE_WARNINGS, *(() if name == "fit" else RESUME_WARNINGS)),
        ExitStack() as until_end,
    ):
        return FaceDiffCLI(
            command=name,
            experiment=experiment,
            until_end=until_end,
            trainer_defaults={"callbacks": defaults(), "logger": logger},
            save_config_callback=RunConfig,
            save_config_kwargs={"overwrite": True},
        )


@contextmanager
def parsing(arguments: Sequence[str], experiment: str) -> Iterator[None]:
    """Have Lightning parse some words; an error of ours that a library has wrapped comes out as it was.

    ``experiment`` replaces ``${experiment_name:}`` in configs of 1.x.
    """
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    guard_configs()
    OmegaConf.register_resolver("experiment_name", lambda: experiment, replace=True)
    # Where a config holds ${…}, jsonargparse dumps the defaults of all options.
    register_type(torch.device, str, torch.device, fail_already_registered=False)
    yaml.SafeDumper.add_multi_representer(Enum, lambda dumper, member: dumper.represent_data(member.value))
    # Lightning starts the other processes of a distributed run with the words of this one.
    argv, sys.argv = sys.argv, [sys.argv[0], *arguments]
    try:
        yield
    except ParsingError as error:
        reason = " ".join(line.strip()[:160] for line in str(error).splitlines())
        raise FaceDiffError(explain(arguments) or reason) from error
    except Exception as error:
        cause = next((cause for cause in chain(error) if isinstance(cause, FaceDiffError)), None)
        if isinstance(cause, ArgumentError) and not any(name[0].isupper() for name in cause.values):
            cause = FaceDiffError(cause.sentence("--"))
        if cause is None and any(restores(reason) for reason in chain(error)):
            cause = FaceDiffError(
                f"--ckpt_path: training cannot continue from this checkpoint ({brief(error)}); it is damaged, or of "
                f"another model or trainer. Give the config of its run, or train from the beginning"
            )
        if cause is None or cause is error:
            raise
        raise cause from error
    finally:
        sys.argv = argv


Parsed = tuple[str, dict[str, Any]]
"""Class path and options of a component."""


def parse_lightning_cli(arguments: Sequence[str]) -> tuple[Parsed, Parsed]:
    """Parse the words of ``fit``, and instantiate nothing; the model and the data."""
    with parsing(arguments, "benchmark"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parsed = ParsedCLI(save_config_callback=None, command="fit", experiment="benchmark", run=False)
    parts = (parsed.options[name] for name in ("model", "data"))
    model, data = ((str(part["class_path"]), dict(part.get("init_args") or {})) for part in parts)
    return model, data


def restores(error: BaseException) -> bool:
    """Whether an error comes from Lightning's restoring of a checkpoint."""
    trace = error.__traceback__
    while trace is not None:
        if Path(trace.tb_frame.f_code.co_filename).name == "checkpoint_connector.py":
            return True
        trace = trace.tb_next
    return False


RESUME_WARNINGS = (".*callbacks used to create the checkpoint need to be provided", "The dirpath has changed from")
"""They matter to resumed training; scoring a checkpoint needs none of its callbacks."""

LOGGERS = tuple(f"lightning.pytorch.loggers.{name}Logger" for name in ("CSV", "TensorBoard", "Wandb"))
"""Loggers that are called after the experiment where they are not given a name."""


class FaceDiffCLI(LightningCLI):
    """LightningCLI with a name for the experiment, and a model that takes its sizes from the data module."""

    def __init__(
        self,
        *,
        command: str,
        experiment: str,
        until_end: ExitStack | None = None,
        **options: Any,  # noqa: ANN401 - as upstream
    ) -> None:
        self.until_end = until_end or ExitStack()
        self.command = command
        self.experiment = experiment
        self.checkpoint: str | None = None
        # Abbreviations are guesses: they change their meaning when another option is added.
        parser = {"parser_mode": "omegaconf+", "exit_on_error": False, "allow_abbrev": False}
        super().__init__(
            AnimationModel,
            SpeechMotionDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            auto_configure_optimizers=False,
            parser_kwargs={**parser, command: parser},
            **options,
        )

    @property
    def options(self) -> Any:  # noqa: ANN401 - jsonargparse's Namespace
        """The options of the subcommand, as parsed."""
        return self.config.get(self.command, self.config)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override] # the base class's is static
        """The one that runs: parsers for the other three would take a tenth of the processor time of a start."""
        return {self.command: LightningCLI.subcommands()[self.command]}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the experiment's name and the optimiser, and let the model take its sizes from the data module."""
        parser.add_argument(
            "--name",
            type=str,
            default=self.experiment,
            help="name of the experiment, and of the folder below runs/ that its runs are in",
        )
        # Not Lightning's automatic ones, which are made before the model has all of its parameters.
        parser.add_optimizer_args((torch.optim.Optimizer,))
        parser.add_lr_scheduler_args()
        for name in LINKS:
            plain = Space.state if name == "space" else None
            parser.link_arguments(f"data.{name}", f"model.init_args.{name}", plain, apply_on="instantiate")

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:  # noqa: ANN401
        """Parse, and keep the checkpoint from Lightning, which would let it override the options."""
        super().parse_arguments(parser, args)
        options = self.options
        self.checkpoint, options["ckpt_path"] = options.get("ckpt_path"), None
        for entry in self.loggers():
            if str(entry.class_path) in LOGGERS and entry.init_args.get("name") in (None, "lightning_logs"):
                entry.init_args.name = options.name

    def loggers(self) -> list[Any]:
        """Class and options of the trainer's loggers; empty where they are not stated one by one."""
        stated = self.options.trainer.get("logger")
        return [entry for entry in (stated if isinstance(stated, list) else [stated]) if hasattr(entry, "class_path")]

    def before_instantiate_classes(self) -> None:
        """Check the experiment's name, the trainer and the corpus."""
        name = self.options.name
        if not name or not name.isprintable() or os.path.isabs(name) or ".." in Path(name).parts:
            raise ArgumentError({"name": name}, "expected the name of a folder for the runs", located=True)
        check_trainer(self.options.trainer, self.command)
        refuse_missing_corpus(self.options.data)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:  # noqa: ANN401
        """Make the trainer; a callback of the config replaces the built-in one of its class."""
        stated = self.config_init[self.command].trainer
        bar_in_a_pipe = stated.get("enable_progress_bar") is None and not on_terminal()
        if bar_in_a_pipe:
            kwargs["enable_progress_bar"] = False
        trainer = super().instantiate_trainer(**kwargs, plugins=slurm_plugins(stated.get("plugins")))
        requeue_on_signal(trainer)
        built_in = self.trainer_defaults["callbacks"]
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        stated_types = {type(callback) for callback in callbacks if callback not in built_in}
        if self.command != "fit":  # a checkpoint's weights are the average
            callbacks[:] = [callback for callback in callbacks if not isinstance(callback, WeightAveraging)]
        if stated.get("enable_checkpointing") is False:
            stated_types.add(LastCheckpoint)
        if not trainer.loggers:  # Lightning refuses LearningRateMonitor without a logger
            callbacks[:] = [callback for callback in callbacks if not isinstance(callback, LearningRateMonitor)]
        callbacks[:] = [c for c in callbacks if c not in built_in or type(c) not in stated_types]
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:  # written whole, read by the one door
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()
        if bar_in_a_pipe and self.command == "fit":
            callbacks.append(EpochLines())
        if self.command != "fit":  # for fit, as soon as it is known whether a run continues
            trainer.loggers = run_loggers(trainer.loggers, self.entries())
        return trainer

    def entries(self) -> list[dict[str, Any]]:
        """The loggers as plain data."""
        return [entry.as_dict() for entry in self.loggers()]

    def after_instantiate_classes(self) -> None:
        """Give the model the optimiser and the schedule that the options state."""
        optimizer, schedule = (self._stated(name) for name in ("optimizer", "lr_scheduler"))
        if optimizer or schedule:
            self.model.configure_optimizers = partial(configure, self.model, optimizer, schedule)

    def _stated(self, name: str) -> dict[str, Any] | None:
        """A class and its options as plain data; None if not stated."""
        return plain(self.options[name].as_dict()) if self.options.get(name) else None

    def before_fit(self) -> None:
        """Let a run that was stopped continue in its folder."""
        trainer: Trainer = self.trainer
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        path = find_checkpoint(trainer, self.entries(), self.checkpoint)
        content = read_checkpoint(path) if path is not None and path.is_file() else {}
        self.model.check_training(resumed=bool(content))
        if content and schedule_changed(content, self._stated("lr_scheduler")):
            raise FaceDiffError(
                f"--lr_scheduler: differs from the one of {path}, and its state cannot be restored; give the config of "
                f"its run, or start a new training"
            )
        run = continued_run(trainer, self.entries(), path, content, sys.argv)
        self.until_end.enter_context(entered_run(trainer, self.entries(), run, content))
        if path is not None:
            warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
            self.config_init[self.command].ckpt_path = str(path) if content else None
            # The config that is saved describes the whole run.
            self.options.ckpt_path = None if run is not None else str(path)

    def before_validate(self) -> None:
        """Find the checkpoint, where it is named by a word or by a config."""
        path = find_scored(self.trainer, self.entries(), self.checkpoint)
        if path is not None:
            self.options.ckpt_path = self.config_init[self.command].ckpt_path = str(path)

    before_test = before_predict = before_validate


def refuse_missing_corpus(data: Mapping[str, Any]) -> None:
    """Refuse a folder without a corpus before the model is built, which may fetch an audio encoder for minutes."""
    module, _, name = str(data["class_path"]).rpartition(".")
    kind: type[SpeechMotionDataModule] = getattr(import_module(module), name)
    root = (data.get("init_args") or {}).get("root")
    if root is not None:
        kind.check_root(str(root))


class ParsedCLI(FaceDiffCLI):
    """Parses, and instantiates nothing."""

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:  # noqa: ANN401
        """Parse, and leave the random numbers alone."""
        super().parse_arguments(parser, args)
        self.config["seed_everything"] = False

    def before_instantiate_classes(self) -> None:
        """Check nothing."""

    def instantiate_classes(self) -> None:
        """Make nothing."""

    def after_instantiate_classes(self) -> None:
        """Have nothing."""


class RunConfig(SaveConfigCallback):
    """Saves the config as ``config.yaml`` in the run's folder, and as ``config`` in a wandb run's config.

    A run without a logger has no folder of its own; a ``config.yaml`` in the working folder may be the user's and
    is left alone. Training saves it once the checkpoint that it continues from has been accepted.
    """

    folder: str | None = None

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Save the config where the run's files lie, unless that is merely the working folder."""
        if stage != "fit":
            self.save_for(trainer, pl_module, stage)

    def on_sanity_check_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the config of a training."""
        self.save_for(trainer, pl_module, "fit")

    on_train_start = on_sanity_check_start

    def save_for(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Save the config, once."""
        self.save_to_log_dir = False  # Lightning would write it in place, where a kill leaves half of it
        if trainer.loggers or Path(trainer.default_root_dir).resolve() != Path.cwd():
            self.folder = trainer.log_dir  # asked for on every process: the answer is broadcast
        super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write the file, and give wandb the config; called on one process only."""
        if self.folder is not None:
            with atomic(Path(self.folder) / self.config_filename) as temporary:
                self.parser.save(self.config, temporary, skip_none=False, overwrite=True, multifile=False)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                config = yaml.safe_load(self.parser.dump(self.config, skip_none=False))
                logger.log_hyperparams({"config": config})


# Options of the trainer that fail silently, and warnings that are not shown.

HALF = ("bf16-true", "16-true", "transformer-engine", "transformer-engine-float16")
"""Lightning's precisions with weights of 16 bits."""


def check_trainer(options: Mapping[str, Any], command: str = "fit") -> None:
    """Refuse options that Lightning accepts and that make a run worthless; ``command`` is fit, validate and so on."""
    limit = f"limit_{ {'fit': 'train', 'validate': 'val'}.get(command, command) }_batches"
    precision, clipping = options.get("precision"), options.get("gradient_clip_val") or 0
    refused = {
        "precision": (precision in HALF, "losses and the last map of a model need float32; expected bf16-mixed, "
                      "16-mixed or 32-true"),
        "gradient_clip_val": (not 0 <= clipping < float("inf"), "expected a number of at least 0"),
        limit: (options.get(limit) == 0, "leaves no batch; give 1 or more, or fast_dev_run for a trial"),
    }  # fmt: skip
    for name, (is_wrong, reason) in refused.items():
        if is_wrong:
            raise ArgumentError({f"trainer.{name}": options[name]}, reason, located=True)


IDLE_WARNINGS = (
    # Reading is cheap (memory-mapped motion), so worker processes would only add their start-up time.
    ".*does not have many workers",
    # Lightning 2.6.6 calls a spelling that torch 2.13 deprecates.
    ".*isinstance.treespec, LeafSpec.*",
    # The throughput monitor is there for clips a second.
    ".*define a `flops_per_batch` attribute",
    # A config without a seed gets 0, and its run folder says so.
    "No seed found, seed set to 0",
    # Frozen layers are in evaluation mode on purpose: no dropout.
    r"Found \d+ module\(s\) in eval mode at the start of training",
)
"""Warnings of Lightning that need no action."""


@contextmanager
def without_warnings(*messages: str) -> Iterator[None]:
    """A context without warnings that begin with one of these patterns, and without Lightning's advertisements."""
    log = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    log.addFilter(_no_advertisement)
    with warnings.catch_warnings():
        for message in messages:
            warnings.filterwarnings("ignore", message)
        try:
            yield
        finally:
            log.removeFilter(_no_advertisement)


def _no_advertisement(record: logging.LogRecord) -> bool:
    return "try installing [lit" not in record.getMessage()
