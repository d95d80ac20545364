"""Rewriting the words of ``facediff fit | validate | test | predict`` before LightningCLI parses them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from facediff import registry
from facediff.data import SpeechMotionDataModule
from facediff.data.assets import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError
from facediff.hparams import defaults
from facediff.shipped import config_dir
from facediff.systems.checkpoint import is_imported, read_checkpoint

LINKS = ("n_vertices", "identities", "frame_rate")
"""Constructor arguments of a system that the data module knows."""

FREE = ("sampler", "sampling_space", "unseen_identity")
"""Constructor arguments of a system that may differ from its checkpoint's; no weights depend on them."""


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
        kind = registry.KINDS.get(flag.rpartition(".")[2])
        if kind is not None and value in kind.names():
            value = json.dumps({"class_path": value, "init_args": defaults(kind.get(value))})
            word = f"{flag}={value}" if joined else value
        flag = ""
        yield word


def from_checkpoint(name: str, arguments: list[str]) -> list[str]:
    """Put a checkpoint's system and data module before the other arguments of validate, test and predict.

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
            f"(only --model.sampler…, --model.sampling_space and --model.unseen_identity may change)"
        )
    config = {"seed_everything": 0, "model": described(checkpoint["hyper_parameters"], drop=LINKS)}
    if option(arguments, "--data") is None:
        config["data"] = data_of(Path(str(path)), checkpoint)
    return ["--config", yaml.safe_dump(config, sort_keys=False), *arguments]


def data_of(path: Path, checkpoint: dict[str, Any]) -> dict[str, Any]:
    """The data module that a checkpoint was trained on, as a config.

    Raises:
        FaceDiffError: if it is not imported; an import path from a file is not followed.
    """
    source = checkpoint.get(DATA_SOURCE_KEY, {})
    named = str(source.get("class_path"))
    if not is_imported(named, SpeechMotionDataModule):
        raise FaceDiffError(
            f"{path}: was trained on the data module {named}, which facediff does not know by itself; "
            f"if you trust it, add --data={named}"
        )
    hparams = checkpoint.get("datamodule_hyper_parameters") or {"root": source.get("root")}
    return {"class_path": named, "init_args": described(hparams)["init_args"]}


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
            shipped = config_dir() / value.removeprefix("configs/")
            if not shipped.is_file():
                raise FaceDiffError(f"--config {value}: no such file, neither here nor among the shipped configs")
            if word.startswith("--config="):
                arguments[i] = f"--config={shipped}"
            else:
                arguments[i + 1] = str(shipped)
    return arguments
