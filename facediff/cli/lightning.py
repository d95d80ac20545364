"""``facediff fit | validate | test | predict``: the arguments are checked and completed, then LightningCLI runs.

Nothing heavy is imported before the arguments have been checked, so that a wrong option or a missing file is reported
within a second; :mod:`facediff.cli.lightning_cli` runs then.
"""

from __future__ import annotations

import ctypes
import importlib
import inspect
import json
import os
import re
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff import registry
from facediff.cli.configs import (
    as_parts,
    bundled_config,
    change_values,
    check_config,
    class_of,
    classes_in,
    keys_of,
    name_of,
    refuse_early,
    value_of,
    values_in,
)
from facediff.cli.process import StoppedBySignal, tell
from facediff.errors import FaceDiffError, choices, import_failure
from facediff.hyperparameters import plain
from facediff.utils.files import config_dir
from facediff.utils.hints import defaults
from facediff.utils.hub import check_model_source, check_training_source, local_model

if TYPE_CHECKING:
    from facediff.cli.lightning_cli import FaceDiffCLI, Parsed
    from facediff.data import SpeechMotionDataModule

HELP = """usage: facediff {name} [--config FILE] [--OPTION=VALUE ...]

{summary}, by Lightning's command line (LightningCLI).

  -c, --config FILE       options in YAML; later files and flags override earlier ones
  --model, --data         class of the model and of the corpus, and their options: --model.dim=64
  --trainer.OPTION        options of Lightning's Trainer: --trainer.max_epochs=20, --trainer.callbacks+=EarlyStopping
  --optimizer, --lr_scheduler
                          class and options in place of the model's: --optimizer=SGD --optimizer.lr=0.1
  --ckpt_path FILE        checkpoint to {purpose}; last or best of the newest run of the config
  --name NAME             name of the experiment, and of the folder below runs/
  --seed_everything SEED  seed of all random numbers
  --print_config          print the whole configuration, and stop

  --model.help=NAME, --data.help=NAME, --model.decoder.help=NAME
                          list the options of a class; `facediff components` lists the names
  --trainer.help          list the options of everything else

examples: facediff fit --config configs/experiment/puppet.yaml --trainer.max_epochs=20
          facediff test --ckpt_path runs/puppet/version_0/checkpoints/best.ckpt
"""
"""Without the import of Lightning, which takes seconds."""

SUMMARIES = {
    "fit": ("Train a model", "continue from"),
    "validate": ("Validate a checkpoint", "validate"),
    "test": ("Score a checkpoint on the test splits", "score"),
    "predict": ("Predict the clips of a split", "predict with"),
}

REPEATABLE = ("-c", "--config", "--trainer.callbacks", "--trainer.logger", "--trainer.plugins", "--print_config")
"""Options that may be repeated, since they add to earlier ones; prefixes."""

FREE = (
    *("sampler", "sampling_space", "expressivity", "unseen_identity", "protocol", "metrics"),
    *("validation_samples", "test_samples"),
)
"""Constructor arguments of a model that may differ from its checkpoint's; no weights depend on them."""


def lightning(name: str, arguments: Sequence[str]) -> int:
    """Run one of Lightning's subcommands; the exit status."""
    if list(arguments) in (["-h"], ["--help"]):
        summary, purpose = SUMMARIES[name]
        tell(*HELP.format(name=name, summary=summary, purpose=purpose).splitlines())
        return 0
    arguments = ["--help" if word == "--trainer.help" else word for word in arguments]
    refuse_repeated(arguments)
    run_cli(name, arguments)
    return 0


def run_cli(name: str, arguments: Sequence[str]) -> FaceDiffCLI:
    """Run one of Lightning's subcommands; the object holds its trainer, model and data module."""
    options = checked_words(name, arguments)
    checkpoint = value_of(options, "--ckpt_path")
    if checkpoint not in (None, "last", "best"):  # which depend on the config
        check_model_source(checkpoint, "--ckpt_path")
        if name == "fit":
            check_training_source(checkpoint)
        path = local_model(checkpoint)
        options = change_values(options, lambda flag, value: str(path) if flag == "--ckpt_path" else value)
        options = [*words_of_checkpoint(name, path, options), *options]
    if name == "test":
        # ScoreTable prints the scores; Lightning's table repeats them for each loader.
        options = ["--verbose=false", *options]
    if name == "predict":
        options = ["--return_predictions=false", *options]  # they are on disk, and a corpus of them fills the memory

    from facediff.cli.lightning_cli import run_lightning_cli

    keep_freed_memory()
    load_components()
    with exit_statuses():
        return run_lightning_cli(name, options, experiment_name(options) or name)


def keep_freed_memory() -> None:
    """Have glibc reuse the memory of freed tensors.

    By default it returns large blocks to the system, which hands them out again page by page: at 6 000 vertices a
    quarter of a training step on a processor (0.24 of 0.91 processor seconds).
    """
    mmap_max, trim_threshold = -4, -1  # of malloc.h
    with suppress(OSError, AttributeError):  # another system, or another C library
        tell_malloc = ctypes.CDLL("libc.so.6").mallopt
        tell_malloc(mmap_max, 0)
        tell_malloc(trim_threshold, 2**31 - 1)


def parse_fit(arguments: Sequence[str]) -> tuple[Parsed, Parsed]:
    """Check the words of ``facediff fit`` without running it; class and options of the model, and of the data."""
    options = checked_words("fit", arguments)
    from facediff.cli.lightning_cli import parse_lightning_cli

    load_components()
    return parse_lightning_cli(options)


def checked_words(name: str, arguments: Sequence[str]) -> list[str]:
    """The words of a subcommand with the files of their configs, once there are enough of them."""
    if not any(re.match(r"-c|-h|--(config|model|data|help|ckpt_path)\b", word) for word in arguments):
        needs = {"fit": "--config FILE, such as configs/experiment/puppet.yaml, or --model=NAME and --data=NAME"}
        scoring = "--ckpt_path CHECKPOINT, a file of `facediff fit`, which holds everything else"
        raise FaceDiffError(f"`facediff {name}` needs {needs.get(name, scoring)}")
    checkpoint = value_of(arguments, "--ckpt_path")
    if checkpoint in ("last", "best") and not any(re.match(r"-c|-h|--(config|model|help)\b", w) for w in arguments):
        raise FaceDiffError(
            f"--ckpt_path {checkpoint}: the config says where the runs are; add the run's --config, or give the path "
            f"of its checkpoints/{checkpoint}.ckpt"
        )
    words = as_parts(change_values(arguments, find_config))
    refuse_early(words)
    return change_values(words, fresh_component)


def load_components() -> None:
    """Register everything that can be chosen by name; a corpus or a component may be a file of the working folder."""
    for kind in registry.KINDS.values():
        kind.load()
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


@contextmanager
def exit_statuses() -> Iterator[None]:
    """Exit as a shell expects after a stop, with 130 on Ctrl-C and 143 on SIGTERM; Lightning has 1 and 0.

    Lightning also goes on to ignore Ctrl-C, which the rest of this process may need.
    """
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from stop
        if type(stop).__name__ == "SIGTERMException":
            raise StoppedBySignal(signal.SIGTERM) from stop
        raise
    finally:
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
            signal.signal(signal.SIGINT, interrupt)


def refuse_repeated(arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice with different values: the last one would win without a word."""
    values: dict[str, str] = {}
    for flag, value in values_in(arguments):
        option = flag.replace(".init_args", "")
        if values.setdefault(option, value) != value and not option.startswith(REPEATABLE):
            raise FaceDiffError(f"{option} is given twice, as {values[option]} and as {value}; give it once")


def import_corpus(
    path: Path, checkpoint: Mapping[str, Any], corpus: str | None, option: str
) -> type[SpeechMotionDataModule] | None:
    """Import the corpus's class by the import path that the user gives; it may be a file of the working folder.

    It is never imported because a checkpoint names it; the error then says how the user can. ``option`` is the
    command's, for that error.
    """
    from facediff.cli.data import find_own_module
    from facediff.data import SpeechMotionDataModule
    from facediff.data.batch import DATA_SOURCE_KEY
    from facediff.data.check.layouts import by_name
    from facediff.utils.hints import is_path

    if corpus is not None:
        if "." not in corpus:
            return None
        find_own_module(corpus)
        return by_name(corpus, None, option.rstrip(" ="))
    trained = (checkpoint.get(DATA_SOURCE_KEY) or {}).get("class_path")
    if is_path(trained) and registry.find_class(registry.corpus, trained, SpeechMotionDataModule) is None:
        raise FaceDiffError(
            f"{path}: was trained on the corpus {trained}, which is not known here and was not imported. If it is your "
            f"own, add  {option}{trained}  and run the command in the folder of its file; docs/own_data.md says how "
            f"to register it once and for all"
        )
    return None


def import_classes(arguments: Sequence[str]) -> list[tuple[str, str]]:
    """Import the classes of the model and its components that the user names by flags or in a config.

    They may be files of this folder. Like a corpus's, none is imported because a checkpoint names it.

    Returns:
        each option and its import path, such as ``("model.decoder", "my_decoder.Mine")``.
    """
    from facediff.cli.data import find_own_module
    from facediff.utils.hints import is_path

    named: list[tuple[str, str]] = []
    for flag, value in values_in(arguments):
        option = "" if flag in ("-c", "--config") else flag.lstrip("-")
        named.extend(classes_in(option, value, Path.cwd()))
    options = {"model", *(f"model.{kind}" for kind in registry.COMPONENTS)}
    classes = [pair for pair in named if pair[0] in options and is_path(pair[1])]
    for option, name in classes:
        if name.startswith("facediff."):
            continue
        find_own_module(name)
        try:
            importlib.import_module(name.rpartition(".")[0])
        except Exception as error:  # a module can fail in any way while it is imported
            raise FaceDiffError(
                f"--{option} {name}: cannot be imported ({import_failure(error)}); expected package.module.Class"
            ) from error
    return classes


def tell_folder(path: Path, options: Mapping[str, Any]) -> None:
    """Report the folder that is read because a checkpoint, which may come from a stranger, names it."""
    if options.get("root") is not None:
        tell(f"{path}: names the corpus folder {options['root']}, which is read")


def corpus_and_folder(
    path: Path, checkpoint: Mapping[str, Any], corpus: str | None, root: Path | None
) -> tuple[type[SpeechMotionDataModule], dict[str, Any]]:
    """The data module's class that a checkpoint was trained with, and its options."""
    from facediff.models.checkpoint import corpus_of

    import_corpus(path, checkpoint, corpus, "--corpus ")
    module, options = corpus_of(path, checkpoint)
    if root is not None:
        options["root"] = str(root)
    else:
        tell_folder(path, options)
    return module, options


def prepared(data: SpeechMotionDataModule) -> SpeechMotionDataModule:
    """A data module with its corpus on this machine."""
    data.prepare_data()
    _ = data.corpus
    return data


def find_config(flag: str, value: str) -> str:
    """The file of a --config; bundled ones are named ``configs/experiment/biwi.yaml`` or ``experiment/biwi``."""
    is_config = flag in ("-c", "--config")
    if os.path.isfile(value) and (is_config or value.endswith((".yaml", ".yml"))):  # noqa: PTH113
        check_config(value)
        return value
    bundled = bundled_config(value) if is_config or value.startswith("configs/") else None
    if bundled is not None:
        return str(bundled)
    if not is_config or re.search(r"[\n{]|: ", value):
        return value
    names = [f"configs/{path.relative_to(config_dir()).as_posix()}" for path in config_dir().rglob("*.yaml")]
    raise FaceDiffError(f"--config {value}: no such file; {choices(value, names)}")


def experiment_name(arguments: Sequence[str]) -> str | None:
    """The name of the runs: the option ``name``, or the file name of the first config of an experiment.

    Configs of callbacks or loggers alone, which are given in addition to an experiment's, do not name it; None then.
    """
    files = config_files(arguments)
    stated = [value_of(arguments, "--name"), *(name_of(file) for file in reversed(files))]
    stems = (Path(file).stem for file in files if {"model", "data"} & keys_of(file))
    return next((name for name in stated if name is not None), next(stems, None))


def config_files(arguments: Sequence[str]) -> list[str]:
    """The files of all ``--config`` options."""
    configs = (value for flag, value in values_in(arguments) if flag in ("-c", "--config"))
    return [value for value in configs if os.path.isfile(value)]  # noqa: PTH113 - a text may be no path at all


def fresh_component(flag: str, value: str) -> str:
    """Let a component that is chosen by name start from its own defaults.

    jsonargparse hands options of the same name on from the previous component, even if those were mere defaults:
    ``--model.sampler=ddpm`` would silently keep the 25 steps of ``ddim``.
    """
    option = flag.removesuffix(".help").rpartition(".")[2] if flag.startswith("--model.") else ""
    kind = registry.COMPONENTS.get(option)
    if kind is not None and flag.endswith(".help") and value in kind.names():
        return f"facediff.registry.{kind.kind}.{value}"
    if kind is None or not re.fullmatch(r"[a-z]\w*", value) or Path(value).is_file() or value == "null":
        return value
    return json.dumps(
        {"class_path": f"facediff.registry.{kind.kind}.{value}", "init_args": plain(defaults(kind.get(value)))}
    )


def words_of_checkpoint(name: str, path: Path, arguments: Sequence[str]) -> list[str]:
    """A checkpoint's model and data module as a config, for validate, test and predict; ``fit`` resumes by itself."""
    import yaml

    from facediff.cli.lightning_cli import LINKS
    from facediff.data import SpeechMotionDataModule
    from facediff.data.batch import DATA_SOURCE_KEY
    from facediff.models.base import build_model
    from facediff.models.checkpoint import corpus_of, read_checkpoint

    named = import_classes(arguments)
    checkpoint = read_checkpoint(path)
    build_model(path, checkpoint)  # reports a damaged checkpoint before Lightning starts
    if name == "fit":
        return []
    hparams = checkpoint["hyper_parameters"]
    # The checkpoint's own classes only permit the import of their code.
    own = {f"model.{kind}": hparams[kind]["class_path"] for kind in registry.COMPONENTS if hparams.get(kind)}
    own["model"] = hparams["_class_path"]
    same = [word for option, name in named if own.get(option) == name for word in (f"--{option}", f"--{option}={name}")]
    changes = [word for word in arguments if re.match(rf"--model(?!\.(init_args\.)?({'|'.join(FREE)})\b)\b", word)]
    changes = [word for word in changes if word not in same]
    if changes:
        raise FaceDiffError(
            f"{changes[0]}: the checkpoint {path} decides the model, and its weights fit no other; omit the option "
            f"(only {', '.join(f'--model.{option}' for option in FREE)} may change)"
        )
    options = {key: value for key, value in hparams.items() if not key.startswith("_") and key not in LINKS}
    config = {"seed_everything": 0, "model": {"class_path": hparams["_class_path"], "init_args": options}}
    data = value_of(arguments, "--data")
    if data is not None and data.endswith((".yaml", ".yml")) and Path(data).is_file():
        data = class_of(data)
    imported = import_corpus(path, checkpoint, data, "--data=")
    trained = str((checkpoint.get(DATA_SOURCE_KEY) or {}).get("class_path"))
    if imported is not None and imported is registry.find_class(registry.corpus, trained, SpeechMotionDataModule):
        data = trained
    if data in (None, trained, trained.rpartition(".")[2]):
        corpus, corpus_options = corpus_of(path, checkpoint)
        if not any(word.startswith(("--data.root", "--data.init_args.root")) for word in arguments):
            root = inspect.signature(corpus).parameters.get("root")  # a corpus may hand it on with its other options
            needed = root is None or root.default is inspect.Parameter.empty
            if needed and corpus_options.get("root") is None:
                raise FaceDiffError(f"{path}: does not say where the corpus is; add --data.root=FOLDER")
            tell_folder(path, corpus_options)
        config["data"] = {"class_path": f"{corpus.__module__}.{corpus.__qualname__}", "init_args": corpus_options}
    return ["--config", yaml.safe_dump(config, sort_keys=False)]
