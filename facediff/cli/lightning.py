"""``facediff fit | validate | test | predict``: LightningCLI with components by name."""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import urllib.error
import urllib.request
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml
from jsonargparse import set_parsing_settings
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import WandbLogger

from facediff import registry
from facediff.callbacks import GradientNorm, PredictionWriter, RunDescription, ScoreTable
from facediff.data import SpeechMotionDataModule
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError, MissingExtraError, choices
from facediff.models import AnimationModel
from facediff.models.checkpoint import corpus_class, corpus_options, read_checkpoint
from facediff.registry import defaults, plain
from facediff.utils.files import config_dir

# Rewriting the words of ``facediff fit | validate | test | predict`` before LightningCLI parses them.

LINKS = ("n_vertices", "identities", "frame_rate")
"""Constructor arguments of a model that the data module knows."""

FREE = ("sampler", "sampling_space", "unseen_identity", "protocol", "metrics")
"""Constructor arguments of a model that may differ from its checkpoint's; no weights depend on them."""


def rewrite(name: str, words: list[str]) -> list[str]:
    """What LightningCLI gets for what was typed.

    Args:
        name: the subcommand.
        words: what follows it.

    Raises:
        FaceDiffError: if a checkpoint or a config is missing or does not go with the other words.
    """
    return resolve_configs(from_checkpoint(name, list(fresh_components(words))))


def fresh_components(words: Sequence[str]) -> Iterator[str]:
    """Let a component that is chosen by name start from its own defaults.

    jsonargparse hands options of the same name on from the component that stood there before, even where those were
    mere defaults: ``--model.sampler=ddpm`` would silently take over the 25 steps of ``ddim``.
    """
    flag = ""
    for word in words:
        if re.fullmatch(r"--model\.\w+(\.\w+)?", word):  # the value is the next word
            flag = word
            yield word
            continue
        flag, joined, value = word.partition("=") if word.startswith("--model.") else (flag, "", word)
        kind = registry.COMPONENTS.get(flag.rpartition(".")[2])
        if kind is not None and value in kind.names():
            value = json.dumps({"class_path": value, "init_args": plain(defaults(kind.get(value)))})
            word = f"{flag}={value}" if joined else value
        flag = ""
        yield word


def from_checkpoint(name: str, arguments: list[str]) -> list[str]:
    """Put a checkpoint's model and data module before the other arguments of validate, test and predict.

    Flags that would change the model are refused: the weights fit the model that they were trained in only.
    """
    path = option(arguments, "--ckpt_path")
    if (
        path is None
        and name != "fit"
        and not any(re.match(r"-c$|-h$|--(config|model|data|help)\b", w) for w in arguments)
    ):
        raise FaceDiffError(
            f"`facediff {name}` needs --ckpt_path CHECKPOINT, a file that `facediff fit` has "
            f"written; it says everything else"
        )
    if path in (None, "best", "last", "hpc", "registry"):
        return arguments
    checkpoint = read_checkpoint(Path(str(path)))
    if name == "fit":
        return arguments
    given = [word for word in arguments if re.match(rf"--model(?!\.(init_args\.)?({'|'.join(FREE)})\b)\b", word)]
    if given:
        raise FaceDiffError(
            f"{given[0]}: the checkpoint {path} decides the model, and its weights fit no other; leave the flag away "
            f"(only {', '.join(f'--model.{option}' for option in FREE)} may change)"
        )
    config = {"seed_everything": 0, "model": described(checkpoint["hyper_parameters"], drop=LINKS)}
    if option(arguments, "--data") is None:
        config["data"] = data_of(Path(str(path)), checkpoint)
    return ["--config", yaml.safe_dump(config, sort_keys=False), *arguments]


def data_of(path: Path, checkpoint: dict[str, Any]) -> dict[str, Any]:
    """The data module that a checkpoint was trained on, as a config."""
    found = corpus_class(path, checkpoint[DATA_SOURCE_KEY])
    return {"class_path": f"{found.__module__}.{found.__qualname__}", "init_args": corpus_options(checkpoint)}


def described(hparams: dict[str, Any], *, drop: Sequence[str] = ()) -> dict[str, Any]:
    """Hyper-parameters in the form of a config file."""
    arguments = {k: v for k, v in hparams.items() if not k.startswith("_") and k not in drop}
    return {"class_path": hparams.get("_class_path"), "init_args": arguments}


def option(arguments: Sequence[str], flag: str) -> str | None:
    """Value of a flag written ``--flag value`` or ``--flag=value``."""
    for i, word in enumerate(arguments):
        if word == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


def resolve_configs(arguments: list[str]) -> list[str]:
    """Let ``--config configs/…`` find the shipped configs from any folder."""
    for i, word in enumerate(arguments):
        value = arguments[i + 1] if word in ("-c", "--config") and i + 1 < len(arguments) else None
        value = word.partition("=")[2] if word.startswith("--config=") else value
        if value and value.startswith("configs/") and not Path(value).exists():
            bundled = config_dir() / value.removeprefix("configs/")
            if not bundled.is_file():
                raise FaceDiffError(f"--config {value}: no such file, neither here nor among the shipped configs")
            if word.startswith("--config="):
                arguments[i] = f"--config={bundled}"
            else:
                arguments[i + 1] = str(bundled)
    return arguments


# Weights & Biases without a question and without waiting: offline where there is no key or no answer.

PATIENCE = 5.0
"""Seconds that the server has for its first answer."""


def settle_wandb_mode(trainer: Mapping[str, Any]) -> None:
    """Let a run that logs to Weights & Biases record offline where it could not upload.

    Without a key wandb asks a question and waits for an answer, and without a network it waits for a minute and a half
    and then fails. Here one line says why the run is offline and how it is uploaded later. Whoever has chosen a mode
    (``WANDB_MODE``, or ``offline: true``) gets that mode.

    Args:
        trainer: the trainer's options as parsed, before anything is made of them.

    Raises:
        FaceDiffError: if wandb is not installed or the key is no key.
    """
    from lightning.pytorch.utilities import rank_zero_only

    options = wandb_options(trainer)
    if options is None or getattr(rank_zero_only, "rank", None):  # other processes of a run log nothing
        return
    try:
        import wandb
    except ModuleNotFoundError as error:
        raise MissingExtraError("wandb", "wandb", "logging to Weights & Biases") from error
    if os.environ.get("WANDB_MODE") or options.get("offline") or wandb.run is not None:
        return
    silent = os.environ.get("WANDB_SILENT")
    os.environ.setdefault("WANDB_SILENT", "true")  # else a login is announced, for which wandb asks the server
    try:
        reason = why_offline()
    except (wandb.Error, ValueError) as error:
        raise FaceDiffError(
            f"wandb: {error}; put the key right (`wandb login --relogin`), or set WANDB_MODE=offline"
        ) from error
    wandb.teardown()  # what comes next reads the environment anew
    if reason is None:
        if silent is None:
            del os.environ["WANDB_SILENT"]  # the run's address is worth a line
        return
    os.environ["WANDB_MODE"] = "offline"
    folder = options.get("save_dir") or options.get("dir") or "."
    print(
        f"wandb: {reason}: the run is recorded offline; upload it later with `wandb sync {folder}/wandb/offline-run-*`",
        file=sys.stderr,
        flush=True,
    )


def wandb_options(trainer: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Options of the first logger that is a WandbLogger; None if there is none."""
    loggers = trainer.get("logger")
    for logger in loggers if isinstance(loggers, list) else [loggers]:
        if str(getattr(logger, "class_path", "")).endswith("WandbLogger"):
            return dict(getattr(logger, "init_args", None) or {})
    return None


def why_offline() -> str | None:
    """What stands in the way of uploading: no key, or no answer; None if nothing does."""
    import wandb

    if not wandb.login(prompt=False, verify=False):
        return "no API key found (`wandb login`, WANDB_API_KEY)"
    address = str(wandb.setup().settings.base_url)
    return None if answers(address) else f"{address} does not answer"


def answers(address: str, patience: float = PATIENCE) -> bool:
    """Whether a web server answers, with whatever but an error of its own; proxies of the environment are used.

    In a thread of its own, since looking up a name may take longer than any time limit of the connection.
    """
    heard = threading.Event()

    def ask() -> None:
        try:
            urllib.request.urlopen(address, timeout=patience).close()  # noqa: S310 (the user's own setting)
        except urllib.error.HTTPError as error:
            if error.code >= 500:  # a gateway whose server is down; "not found" is an answer
                return
        except (OSError, ValueError):
            return
        heard.set()

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(patience)
    return heard.is_set()


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
        if kind in registry.COMPONENTS:
            return f"{registry.COMPONENTS[kind].unknown(name)}\n\n{message}"
        if kind in ("model", "data"):
            known = subclasses(AnimationModel if kind == "model" else SpeechMotionDataModule)
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
    """LightningCLI whose model takes its sizes from the data module."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Let the model take its sizes from the data module."""
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
                AnimationModel,
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
