"""``facediff fit | validate | test | predict``: LightningCLI with components by name."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml
from jsonargparse import set_parsing_settings
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import WandbLogger

from facediff import registry
from facediff.callbacks import GradientNorm, PredictionWriter, RunDescription, ScoreTable
from facediff.commands.wandb_mode import settle_wandb_mode
from facediff.commands.words import LINKS, rewrite
from facediff.data import SpeechMotionDataModule
from facediff.errors import FaceDiffError, choices
from facediff.systems import SpeechAnimator

TIP = (
    "tip: `facediff components` lists what can be chosen by name, `facediff fit --help` the options, and "
    "`facediff fit --config C --model.decoder.help=NAME` the options of a component"
)

IDLE_WARNINGS = (
    # Reading is cheap (memory-mapped motion), so worker processes would only add their start-up time.
    ".*does not have many workers",
    # Lightning 2.6.6 calls a spelling that torch 2.13 deprecates.
    ".*isinstance.treespec, LeafSpec.*",
    # The throughput monitor is there for clips a second.
    ".*define a `flops_per_batch` attribute",
    # Frozen layers are in evaluation mode on purpose: no dropout.
    r"Found \d+ module\(s\) in eval mode at the start of training",
)
"""Warnings of Lightning's that nobody needs to act on."""

RESUME_WARNINGS = (".*callbacks used to create the checkpoint need to be provided", "The dirpath has changed from")
"""They matter to training that goes on; scoring a checkpoint needs none of its callbacks."""


class Parser(LightningArgumentParser):
    """Reports errors in a few lines, with the names that exist where a name is wrong."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Report a usage error without the hundred lines of usage that would hide it; exits with status 2."""
        if not self.exit_on_error:
            super().error(message, ex)
        print(f"facediff: error: {explain(message)}\n{TIP}", file=sys.stderr)
        raise SystemExit(2)


def explain(message: str) -> str:
    """Lead an error about an unknown component name by one sentence with the right names.

    jsonargparse reports an unknown name as an import path that it could not make sense of.
    """
    pattern = r'Parser key "(?:[\w.]*\.)?(\w+)":(?:(?!Parser key).)*?dot import path string: (\S+)'
    for kind, name in re.findall(pattern, message, re.DOTALL):
        if kind in registry.KINDS:
            return f"{registry.KINDS[kind].unknown(name)}\n\n{message}"
        if kind in ("model", "data"):
            known = subclasses(SpeechAnimator if kind == "model" else SpeechMotionDataModule)
            return f'there is no {kind} "{name}": {choices(name, known)}\n\n{message}'
    return message


def subclasses(base: type) -> list[str]:
    """Names of all concrete subclasses that are imported."""
    found: list[str] = []
    cls: type
    for cls in base.__subclasses__():
        found += [] if getattr(cls, "__abstractmethods__", None) else [cls.__name__]
        found += subclasses(cls)
    return found


class FaceDiffCLI(LightningCLI):
    """LightningCLI whose system takes its sizes from the data module."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Let the system take its sizes from the data module."""
        for name in LINKS:
            parser.link_arguments(f"data.{name}", f"model.init_args.{name}", apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        """Settle whether wandb uploads before anything starts it."""
        settle_wandb_mode(self.config[str(self.subcommand)].trainer)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:  # noqa: ANN401
        """Make the trainer; a callback that the config names stands in for the built-in one of its kind."""
        trainer = super().instantiate_trainer(**kwargs)
        built_in = self.trainer_defaults["callbacks"]
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        named = {type(callback) for callback in callbacks if callback not in built_in}
        callbacks[:] = [c for c in callbacks if c not in built_in or type(c) not in named]
        return trainer

    def _parse_ckpt_path(self) -> None:
        """Upstream merges a checkpoint's hyper-parameters over the flags; the module ``words`` does it under them."""


class RunConfig(SaveConfigCallback):
    """Saves the config as ``config.yaml`` in the run's folder, and as ``config`` in a wandb run's config.

    A run without a logger has no folder of its own; a ``config.yaml`` in the working folder may be the user's and
    is left alone.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Save the config where the run's files lie, unless that is merely the working folder."""
        if not trainer.loggers and Path(trainer.default_root_dir).resolve() == Path.cwd():
            self.save_to_log_dir = False
        super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Give wandb the config; called on one process only."""
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                config = yaml.safe_load(self.parser.dump(self.config, skip_none=False))
                logger.log_hyperparams({"config": config})


def built_in_callbacks(name: str) -> list[Callback]:
    """What every run of a subcommand has beside the callbacks of its config."""
    callbacks: list[Callback] = [ScoreTable(), RunDescription()]
    if name == "fit":
        callbacks.append(GradientNorm())
    if name == "predict":
        callbacks.append(PredictionWriter())
    return callbacks


def run(name: str, arguments: Sequence[str]) -> int:
    """Run one of Lightning's subcommands from the command line."""
    run_cli(name, arguments)
    return 0


def run_cli(name: str, arguments: Sequence[str]) -> FaceDiffCLI:
    """Run one of Lightning's subcommands and hand back what it made: trainer, model, data module."""
    for kind in registry.KINDS.values():
        kind.load()
    if os.getcwd() not in sys.path:  # a corpus or a component may be a file of the working folder
        sys.path.append(os.getcwd())
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    words = rewrite(name, list(arguments))
    if name == "test":
        words = ["--verbose=false", *words]  # ScoreTable prints the scores; Lightning's table repeats them per loader
    if name == "predict":
        words = ["--return_predictions=false", *words]  # they are on disk, and a corpus of them fills the memory
    logger = {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "runs", "name": name}}
    # Lightning starts the other processes of a distributed run with the words of this one.
    argv, sys.argv = sys.argv, [sys.argv[0], name, *words]
    try:
        with warnings.catch_warnings():
            for message in IDLE_WARNINGS if name == "fit" else (*IDLE_WARNINGS, *RESUME_WARNINGS):
                warnings.filterwarnings("ignore", message)
            return FaceDiffCLI(
                SpeechAnimator,
                SpeechMotionDataModule,
                subclass_mode_model=True,
                subclass_mode_data=True,
                auto_configure_optimizers=False,
                trainer_defaults={"callbacks": built_in_callbacks(name), "logger": logger},
                parser_class=Parser,
                parser_kwargs={"parser_mode": "omegaconf+"},
                save_config_callback=RunConfig,
                save_config_kwargs={"overwrite": True},
            )
    except Exception as error:
        # jsonargparse wraps what a constructor raises; our own sentence is the useful one.
        ours = next((cause for cause in causes(error) if isinstance(cause, FaceDiffError)), None)
        if type(error).__module__.startswith("wandb.errors"):
            raise FaceDiffError(
                f"wandb could not start the run ({error}): put the key right with `wandb login --relogin`, or set "
                f"WANDB_MODE=offline and upload the run later"
            ) from error
        if ours is None or ours is error:
            raise
        raise ours from error
    finally:
        sys.argv = argv


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and what it came from, outermost first."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
