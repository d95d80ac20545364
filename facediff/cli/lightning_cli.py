"""LightningCLI as facediff uses it: components by name, one-sentence errors, callbacks that every run has, and wandb.

Importing Lightning and jsonargparse takes seconds, so :mod:`facediff.cli.lightning` imports this module only once the
arguments have been checked.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
import threading
import urllib.error
import urllib.request
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from typing import Annotated, Any, NoReturn, get_args, get_type_hints

import yaml
from jsonargparse import set_parsing_settings
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import LearningRateMonitor, WeightAveraging
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from facediff import registry
from facediff.callbacks import EpochLines, GradientNorm, LastCheckpoint, PredictionWriter, RunDescription, ScoreTable
from facediff.callbacks.checkpoints import AtomicCheckpointIO, requeue_on_signal
from facediff.callbacks.runs import continue_run, find_checkpoint, find_scored, locked_run, resumable, share_folder
from facediff.cli.configs import PARTS, guard_configs
from facediff.cli.trainer_options import IDLE_WARNINGS, explained, raised_in, sentence_of, without_warnings
from facediff.data import SpeechMotionDataModule
from facediff.errors import ArgumentError, FaceDiffError, MissingExtraError, choices, lacking
from facediff.models import AnimationModel
from facediff.models.checkpoint import read_checkpoint
from facediff.spaces import Space
from facediff.utils.files import atomic
from facediff.utils.hints import defaults, mismatch
from facediff.utils.limits import brief
from facediff.utils.progress import on_terminal
from facediff.utils.ranges import Range

LINKS = ("n_vertices", "identities", "frame_rate", "space", "faces")
"""Constructor arguments of a model that the data module knows; not every model has ``faces``."""


def run_lightning_cli(name: str, arguments: Sequence[str], experiment: str) -> FaceDiffCLI:
    """Run a subcommand whose words are checked and complete; see :func:`facediff.cli.lightning.run_cli`.

    Args:
        name: of the subcommand.
        arguments: its options.
        experiment: what runs are called unless the option ``name`` says otherwise.
    """
    options = {"save_dir": "runs", "name": "${experiment_name:}"}
    logger = {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": options}
    try:
        with (
            parsing([name, *arguments], lambda *, _root_: _root_[name]["name"]),
            without_warnings(*IDLE_WARNINGS, *(() if name == "fit" else RESUME_WARNINGS)),
            ExitStack() as until_end,
        ):
            return FaceDiffCLI(
                **PARSED,
                trainer_defaults={"callbacks": built_in_callbacks(name), "logger": logger},
                save_config_callback=RunConfig,
                save_config_kwargs={"overwrite": True},
                command=name,
                experiment=experiment,
                until_end=until_end,
            )
    except Exception as error:
        # jsonargparse wraps what a constructor raises; our own sentence is the useful one.
        ours = next((cause for cause in causes(error) if isinstance(cause, FaceDiffError)), None)
        if type(error).__module__.startswith("wandb.errors"):
            raise FaceDiffError(
                f"wandb could not start the run ({error}); correct the key with `wandb login --relogin`, or set "
                f"WANDB_MODE=offline and upload the run later"
            ) from error
        if isinstance(error, OSError) and not isinstance(error, BrokenPipeError) and ours is None:
            raise FaceDiffError(
                f"{error.filename or 'the folder of the run'}: {error.strerror or error}; expected a folder that can "
                f"be written and has room. `facediff fit` continues with --ckpt_path last"
            ) from error
        if ours is None and any(restores(cause) for cause in causes(error)):
            raise FaceDiffError(
                f"--ckpt_path: training cannot continue from this checkpoint ({brief(error)}); it is damaged, or of "
                f"another model or trainer. Give the config of its run, or train from the beginning"
            ) from error
        if ours is None and any(isinstance(cause, UnicodeDecodeError) for cause in causes(error)):
            raise FaceDiffError("--config: a file that the config names is not UTF-8; save it as UTF-8") from error
        if isinstance(error, MisconfigurationException | ValueError) and ours is None and raised_in(error, "lightning"):
            raise FaceDiffError(f"`facediff {name}`: {sentence_of(error)}") from error
        if isinstance(ours, ArgumentError) and not any(name[0].isupper() for name in ours.values):
            raise FaceDiffError(ours.sentence("--")) from error
        if ours is None or ours is error:
            raise
        raise ours from error


@contextmanager
def parsing(arguments: Sequence[str], experiment: Callable[..., str]) -> Iterator[None]:
    """Have Lightning parse some words; ``experiment`` is what a config's ``${experiment_name:}`` stands for."""
    set_parsing_settings(omegaconf_absolute_to_relative_paths=True)
    guard_configs("omegaconf+")
    # In place of ${name}, which jsonargparse makes relative to the file that it stands in, and then does not find.
    OmegaConf.register_resolver("experiment_name", experiment, replace=True)
    # Lightning starts the other processes of a distributed run with the words of this one.
    argv, sys.argv = sys.argv, [sys.argv[0], *arguments]
    try:
        yield
    except OmegaConfBaseException as error:  # a key, a variable or a grammar that is not there
        option, reason = str(error.full_key or "").partition(".")[2], str(error).partition("\n")[0]
        raise FaceDiffError(
            f"--config: ${{…}} of {option or 'an option'} cannot be resolved ({reason}); expected ${{KEY}} with a key "
            f"of the config, or ${{oc.env:NAME}}"
        ) from error
    finally:
        sys.argv = argv


def parse_lightning_cli(arguments: Sequence[str]) -> tuple[str, str, dict[str, Any]]:
    """Parse the words of ``fit`` and make nothing of them; class of the model, class and options of the data module."""
    try:
        with parsing(arguments, lambda *, _root_: "benchmark"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parsed = ParsedCLI(**PARSED, save_config_callback=None, command="fit", experiment="benchmark", run=False)
    except Exception as error:
        ours = next((cause for cause in causes(error) if isinstance(cause, FaceDiffError)), None)
        if ours is None or ours is error:
            raise
        raise ours from error
    data = parsed.config["data"]
    return str(parsed.config["model"]["class_path"]), str(data["class_path"]), dict(data.get("init_args") or {})


def restores(error: BaseException) -> bool:
    """Whether an error comes from restoring a checkpoint: of loops, optimisers, schedules or callbacks."""
    frames = [frame.f_code for frame, _ in walk_tb(error.__traceback__)]
    return any(
        code.co_name in RESTORING
        or code.co_filename.replace(os.sep, "/").endswith("connectors/checkpoint_connector.py")
        for code in frames
    )


RESTORING = ("load_state_dict", "_load_state_dicts", "on_load_checkpoint", "restore_random_states")
"""Functions that put back what a checkpoint holds, also later than Lightning's own restoring."""


def built_in_callbacks(name: str) -> list[Callback]:
    """The callbacks that every run of a subcommand has in addition to those of its config."""
    callbacks: list[Callback] = [ScoreTable(), RunDescription()]
    if name == "fit":
        callbacks += [GradientNorm(), LastCheckpoint()]
    if name == "predict":
        callbacks.append(PredictionWriter())
    return callbacks


RESUME_WARNINGS = (".*callbacks used to create the checkpoint need to be provided", "The dirpath has changed from")
"""They matter to training that goes on; scoring a checkpoint needs none of its callbacks."""


class Parser(LightningArgumentParser):
    """Reports an error in one sentence, in place of the hundred lines of usage that would hide it."""

    def __init__(self, *values: Any, **options: Any) -> None:  # noqa: ANN401 - the base class's
        # Abbreviations are guesses: the option that one stands for changes when another option is added.
        super().__init__(*values, **{"allow_abbrev": False, **options})

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Raise a usage error as one sentence."""
        if not self.exit_on_error:  # jsonargparse tries something, and looks at the error itself
            super().error(message, ex)
        raise FaceDiffError(explain(message)) from ex


def explain(message: str) -> str:
    r"""One sentence for what jsonargparse reports as a tree of the types that it tried.

    >>> explain('Parser key "model":\n- Parser key "dim":\n Expected a <class \'int\'>. Got value: x').partition(";")[0]
    '--model.dim x: expected int'
    """
    # The option is what the keys of the tree spell; a flag of several parts stands in a NestedArg below the first key.
    keys = list(dict.fromkeys(re.findall(r'Parser key "([\w.]+)"', message)))
    flag = re.search(r"NestedArg\(key='([\w.]+)'", message)
    option = ".".join([keys[0], flag[1]] if keys and flag else keys)
    owner, _, last = option.rpartition(".")
    match = re.search(NO_CLASS, message)
    path = match[match.lastindex or 0] if match else ""
    if path and not path.endswith((".yaml", ".yml")):
        name = path.rpartition(".")[2]
        if last in registry.COMPONENTS:
            return registry.COMPONENTS[last].unknown(path)
        bases: dict[str, tuple[str, type]] = {
            "model": ("model", AnimationModel),
            "data": ("corpus", SpeechMotionDataModule),
        }
        if last not in bases:
            names = [entry for base in trainer_classes(last) for entry in subclasses(base)]
            named = f", or a name: {choices(name, dict.fromkeys(names))}" if names else ""
            return f"--{option} {path}: there is no such class; expected its import path{named}"
        kind, base = bases[last]
        return f'there is no {kind} "{path}": {choices(name, subclasses(base))}'
    chosen = owner if owner.startswith(("model", "data")) else ""
    see = f"`--{chosen}.help=NAME` lists the options" if chosen else "`facediff fit --help` lists the options"
    if match := re.search(NO_OPTION, message):
        outer, inner = (match[1], match[2]) if match[2] else (match[3].split(".") + [""])[:2]
        if outer == "trainer":
            names = list(inspect.signature(Trainer.__init__).parameters)[1:]
            return f"--trainer.{inner}: there is no such option; {choices(inner, names)}"
        if outer not in PARTS:
            return f"--{outer}: there is no such option; {choices(outer, (*PARTS, 'name', 'seed_everything'))}"
    if match := re.search(r"Option '([\w.]+)' is not accepted", message):
        names = component_options(message)
        wrong = option if flag else f"{option}.{match[1]}"
        return f"--{wrong}: there is no such option; {choices(match[1], names) if names else see}"
    if match := re.search(r"arguments? (?:is|are) required: (.*)", message):
        missing = [f"--{option}.{name}" if option else f"--{name.partition('.')[2]}" for name in match[1].split(", ")]
        return f"{' and '.join(missing)} must be given, as an option or in a file with --config; {see}"
    if match := re.search(r"Expected a path but (\S+) either not accessible or invalid", message):
        module, _, name = match[1].rpartition(".")
        if fault := lacking(getattr(sys.modules.get(module), name, None)):
            return f"--{option} {match[1]}: {fault}"
        if extended := re.search(r"(?:to a subclass of |be a subclass of <class ')(\w+)", message):
            return f"--{option} {match[1]}: no class that extends {extended[1]}, which it has to"
        return f"--{option} {match[1]}: no file, no name that `facediff components` lists, and no class of this kind"
    types = re.findall(r"Expected (?:a |an )?<class '([\w.]+)'>|Literal\[(.*?)\]", message)
    expected = [word for pair in dict.fromkeys(types) for word in pair if word not in ("", "NoneType")]
    if expected:
        typed = re.search(r"val='(.*?)'\)|value: (?!Namespace|NestedArg)([^\s.]+)", message)
        value = f" {typed[1] or typed[2]}" if typed else ""
        return f"--{option}{value}: expected {' or '.join(expected)}; {see}"
    return f"{' '.join(message.split())}; {see}"


NO_OPTION = (
    r"Group '(\w+)' does not accept option '(\w+)|"
    r"(?:nrecognized arguments: --|^Subcommand '\w+' does not accept option '|^Option ')([\w.]+)"
)
"""What jsonargparse says of an option, on the command line or in a config, that is none of model, data or trainer."""

NO_CLASS = (
    r"dot import path string: (\S+)|class_path '(\S+)':\s+(?:module \S+ has no attribute|No module named)"
    r"|Import path (\S+) does not correspond to a subclass"
)
"""What jsonargparse says of a name or an import path that leads to no class of the right kind."""


def trainer_classes(option: str) -> list[type]:
    """The classes that an option of the trainer takes, by its type; empty for other options."""

    def inside(hint: Any) -> list[type]:  # noqa: ANN401
        if parts := get_args(hint):
            return [base for part in parts for base in inside(part)]
        return [hint] if inspect.isclass(hint) and hint.__module__.startswith("lightning.") else []

    return inside(get_type_hints(Trainer.__init__).get(option))


def component_options(message: str) -> list[str]:
    """The options of the classes that refuse one, as an error of jsonargparse says; empty if none has options.

    A list's last entry and the base class of its entries both refuse an option of the command line.
    """
    refusing = re.findall(r"class_path '([\w.]+)':\s+Option '", message)
    refusing = refusing or re.findall(r"class_path(?: |=)'([\w.]+)'", message)[-1:]
    return list(dict.fromkeys(option for path in refusing for option in options_of(path)))


def options_of(path: str) -> list[str]:
    """The options of a class by its import path; empty if it is not imported."""
    module, _, name = path.rpartition(".")
    if module.startswith("facediff.registry."):
        kind = registry.COMPONENTS[module.rpartition(".")[2]]
        return list(defaults(kind.get(name)))
    component = getattr(sys.modules.get(module), name, None)
    return list(defaults(component)) if isinstance(component, type) else []


def subclasses(base: type) -> list[str]:
    """Names of all concrete public subclasses that are imported."""
    names: list[str] = []
    cls: type
    for cls in base.__subclasses__():
        hidden = getattr(cls, "__abstractmethods__", None) or cls.__name__.startswith("_")
        names += [] if hidden else [cls.__name__]
        names += subclasses(cls)
    return names


PARSED: dict[str, Any] = {
    "model_class": AnimationModel,
    "datamodule_class": SpeechMotionDataModule,
    "subclass_mode_model": True,
    "subclass_mode_data": True,
    "auto_configure_optimizers": False,
    "parser_class": Parser,
    "parser_kwargs": {"parser_mode": "omegaconf+"},
}
"""How words are parsed, whether they are run or not."""


class FaceDiffCLI(LightningCLI):
    """LightningCLI whose experiment has a name, and whose model takes its sizes from the data module."""

    def __init__(
        self,
        *values: Any,  # noqa: ANN401 - as upstream
        command: str,
        experiment: str,
        until_end: ExitStack | None = None,
        **options: Any,  # noqa: ANN401 - as upstream
    ) -> None:
        self.until_end = until_end or ExitStack()  # what lasts as long as the subcommand
        self.command = command
        self.experiment = experiment
        super().__init__(*values, **options)

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override] # the base class's is static
        """The one that runs: parsers for the other three would take a tenth of the processor time of a start."""
        return {self.command: LightningCLI.subcommands()[self.command]}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the experiment's name, and let the model take its sizes from the data module."""
        parser.add_argument(
            "--name",
            type=str,
            default=self.experiment,
            help="name of the experiment, and of the folder below runs/ that its runs are in",
        )
        for name in LINKS:
            plain = Space.state if name == "space" else None
            parser.link_arguments(f"data.{name}", f"model.init_args.{name}", plain, apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        """Check the experiment's name and the corpus, and decide whether wandb uploads before anything starts it.

        Raises:
            ArgumentError: if the name is not that of a folder below that of all runs.
            FaceDiffError: if the corpus is not there.
            MissingExtraError: if a logger's package is not installed.
        """
        name = self._get(self.config, "name")
        if not name or not name.isprintable() or os.path.isabs(name) or ".." in Path(name).parts:
            raise ArgumentError({"name": name}, "expected the name of a folder for the runs", located=True)
        trainer = self.config[str(self.subcommand)].trainer
        if logger_options(trainer, "TensorBoardLogger") is not None and not find_spec("tensorboard"):
            raise MissingExtraError("tensorboard", "tensorboard", "logging to TensorBoard")
        settle_wandb_mode(trainer)
        refuse_missing_corpus(self.config[str(self.subcommand)].data)

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:  # noqa: ANN401
        """Make the trainer; a callback of the config replaces the built-in one of its class."""
        chosen = self._get(self.config_init, "trainer", default={})
        bar_in_a_pipe = chosen.get("enable_progress_bar") is None and not on_terminal()
        if bar_in_a_pipe:
            kwargs["enable_progress_bar"] = False
        part = {"fit": "train", "validate": "val"}.get(str(self.subcommand), self.subcommand)
        if chosen.get(limit := f"limit_{part}_batches") == 0:
            wanting = "leaves no batch; give 1 or more, or fast_dev_run for a trial"
            raise ArgumentError({f"trainer.{limit}": 0}, wanting, located=True)
        with explained({**chosen, **kwargs}):
            trainer = super().instantiate_trainer(**kwargs)
        requeue_on_signal(trainer)
        built_in = self.trainer_defaults["callbacks"]
        callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
        named = {type(callback) for callback in callbacks if callback not in built_in}
        if self.subcommand != "fit":  # a checkpoint's weights are the average, and this one would refuse to load them
            callbacks[:] = [callback for callback in callbacks if not isinstance(callback, WeightAveraging)]
        if self._get(self.config_init, "trainer").get("enable_checkpointing") is False:
            named.add(LastCheckpoint)
        if not trainer.loggers:  # which bundled configs have it for; Lightning refuses it alone
            callbacks[:] = [callback for callback in callbacks if not isinstance(callback, LearningRateMonitor)]
        callbacks[:] = [c for c in callbacks if c not in built_in or type(c) not in named]
        if type(trainer.strategy.checkpoint_io) is TorchCheckpointIO:  # written whole, read by the one door
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()
        if bar_in_a_pipe and self.subcommand == "fit":
            callbacks.append(EpochLines())
        if self.subcommand != "fit":  # for fit, as soon as it is known whether a run continues
            trainer.loggers = resumable(trainer.loggers)
        return trainer

    def before_fit(self) -> None:
        """Let a run that was stopped continue in its folder."""
        trainer: Trainer = self.trainer
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        path = find_checkpoint(trainer, self._get(self.config_init, "ckpt_path"))
        content = read_checkpoint(path) if path is not None and path.is_file() else {}
        self.model.check_training(resumed=bool(content))
        continues = continue_run(trainer, path, content, sys.argv)
        self.until_end.enter_context(locked_run(trainer, new=not continues))
        if continues:
            self.config[str(self.subcommand)].ckpt_path = None  # the config that is saved describes the whole run
        else:
            share_folder(trainer.loggers)
        if path is not None:
            warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
            self.config_init[str(self.subcommand)].ckpt_path = str(path) if content else None

    def before_validate(self) -> None:
        """Find the checkpoint, where it is named by a word or by a config."""
        path = find_scored(self.trainer, self._get(self.config_init, "ckpt_path"))
        if path is not None:
            self.config_init[str(self.subcommand)].ckpt_path = str(path)

    before_test = before_predict = before_validate

    def _set_seed(self) -> None:
        """Set the seed.

        Raises:
            ArgumentError: if it is no seed.
        """
        seed = self._get(self.config, "seed_everything")
        expected = mismatch(bool | Annotated[int, Range(0, 2**32 - 1)] | None, seed)
        if expected is not None:
            raise ArgumentError({"seed_everything": seed}, f"expected {expected}", located=True)
        super()._set_seed()

    def _parse_ckpt_path(self) -> None:
        """Do nothing: upstream would let a checkpoint override the flags; ``words_of_checkpoint`` does the opposite."""


def refuse_missing_corpus(data: Mapping[str, Any]) -> None:
    """Refuse a folder without a corpus before the model is built, which may fetch an audio encoder for minutes."""
    module, _, name = str(data["class_path"]).rpartition(".")
    kind: type[SpeechMotionDataModule] = getattr(import_module(module), name)
    root = (data.get("init_args") or {}).get("root")
    if root is not None:
        kind.check_root(str(root))


class ParsedCLI(FaceDiffCLI):
    """Parses, and makes nothing of what it has parsed."""

    def before_instantiate_classes(self) -> None:
        """Leave wandb alone."""

    def instantiate_classes(self) -> None:
        """Make nothing."""

    def _set_seed(self) -> None:
        """Leave the random numbers alone."""


class RunConfig(SaveConfigCallback):
    """Saves the config as ``config.yaml`` in the run's folder, and as ``config`` in a wandb run's config.

    A run without a logger has no folder of its own; a ``config.yaml`` in the working folder may be the user's and
    is left alone.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Save the config where the run's files lie, unless that is merely the working folder."""
        self.save_to_log_dir = False  # Lightning would write it in place, where a kill leaves half of it
        if trainer.loggers or Path(trainer.default_root_dir).resolve() != Path.cwd():
            self.folder = trainer.log_dir  # asked for on every process: the answer is broadcast
        super().setup(trainer, pl_module, stage)

    folder: str | None = None

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write the file, and give wandb the config; called on one process only."""
        if self.folder is not None:
            with atomic(Path(self.folder) / self.config_filename) as temporary:
                self.parser.save(self.config, temporary, skip_none=False, overwrite=True, multifile=False)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                config = yaml.safe_load(self.parser.dump(self.config, skip_none=False))
                logger.log_hyperparams({"config": config})


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and what it came from, outermost first."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


# Weights & Biases without questions and waiting: offline where there is no key or the server does not answer.

PATIENCE = 5.0
"""Seconds that the server has for its first answer."""


def settle_wandb_mode(trainer: Mapping[str, Any]) -> None:
    """Let a run that logs to Weights & Biases record offline where it could not upload.

    Without a key wandb asks a question and waits for an answer, and without a network it waits for a minute and a half
    and then fails. Here one line says why the run is offline and how it is uploaded later. Whoever has chosen a mode
    (``WANDB_MODE``, or ``offline: true``) keeps it.

    Args:
        trainer: the trainer's options as parsed, before anything is made of them.
    """
    from lightning.pytorch.utilities import rank_zero_only

    options = logger_options(trainer, "WandbLogger")
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
            f"wandb: {error}; correct the key (`wandb login --relogin`), or set WANDB_MODE=offline"
        ) from error
    wandb.teardown()  # the logger then reads the environment again
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


def logger_options(trainer: Mapping[str, Any], kind: str) -> Mapping[str, Any] | None:
    """Options of the first logger whose class has this name; None if there is none."""
    loggers = trainer.get("logger")
    for logger in loggers if isinstance(loggers, list) else [loggers]:
        if str(getattr(logger, "class_path", "")).endswith(kind):
            return dict(getattr(logger, "init_args", None) or {})
    return None


def why_offline() -> str | None:
    """Why a run cannot be uploaded: no key, or no answer; None if it can."""
    import wandb

    if not wandb.login(prompt=False, verify=False):
        return "no API key found (`wandb login`, WANDB_API_KEY)"
    address = str(wandb.setup().settings.base_url)
    return None if answers(address) else f"{address} does not answer"


def answers(address: str, patience: float = PATIENCE) -> bool:
    """Whether a web server answers, with anything but a server error; proxies of the environment are used.

    In a thread of its own, since looking up a name may take longer than any time limit of the connection.
    """
    answered = threading.Event()

    def ask() -> None:
        try:
            urllib.request.urlopen(address, timeout=patience).close()  # noqa: S310 (the user's own setting)
        except urllib.error.HTTPError as error:
            if error.code >= 500:  # a gateway whose server is down; "not found" is an answer
                return
        except (OSError, ValueError):
            return
        answered.set()

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(patience)
    return answered.is_set()
