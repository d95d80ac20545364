"""The one door into a checkpoint: loading models, their assets and their corpora.

What is checked, and in which order, stands in :mod:`facediff.models.checkpoint_reading`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from facediff.data import SpeechMotionDataModule
from facediff.data.batch import DATA_SOURCE_KEY, Assets
from facediff.models.base import AnimationModel
from facediff.models.checkpoint_reading import (
    assets_of,
    build,
    component_finders,
    open_content,
    read_content,
)
from facediff.registry import corpus, find_class
from facediff.utils.licences import require_cleared
from facediff.utils.plain_options import read_options, unknown_class


def load_model(path: Path | str, device: str = "cpu", *, commercial_only: bool = False) -> AnimationModel:
    """A trained model, ready for inference.

    Args:
        path: a checkpoint of any model, also of an installed package's; a model folder; or ``user/name[@revision]`` of
            the Hugging Face hub, where no such path exists.
        device: where it computes.
        commercial_only: refuse a model whose licence labels do not allow commercial use.

    Raises:
        FaceDiffError: as :func:`read_checkpoint`, or if the model cannot be rebuilt, or its licence is refused.

    Example:
        >>> model = load_model("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate(speech, identity="F1").vertices.shape  # doctest: +SKIP
        torch.Size([75, 1008, 3])
    """
    model = build_model(path, read_checkpoint(path))
    if commercial_only:
        require_cleared(path, model.licences)
    return model.to(device)


def read_checkpoint(path: str | os.PathLike[str] | IO[bytes]) -> dict[str, Any]:
    """Read a checkpoint without running any code from it, and check all that it names.

    Args:
        path: the file, which may be open; a model folder; or a name of the Hugging Face hub.

    Raises:
        FaceDiffError: if the file is missing, or no checkpoint of this version of facediff, or names a model, a
            component or a value that is not known.
    """
    return read_content(path, AnimationModel)


def build_model(path: Path | str, checkpoint: dict[str, Any]) -> AnimationModel:
    """The model of a checkpoint that :func:`read_checkpoint` has read, ready for inference on the CPU.

    Args:
        path: the file, for messages.
        checkpoint: its content.

    Raises:
        FaceDiffError: if a component cannot be made here, or the weights do not fit.
    """
    return build(path, checkpoint, AnimationModel)  # type: ignore[type-abstract]


def read_assets(path: Path | str) -> Assets:
    """The assets alone: templates, faces, frame rate …; no class that the checkpoint names is looked at.

    Raises:
        FaceDiffError: if the file is missing, or no checkpoint of this version of facediff.
    """
    with open_content(path, weights=False) as (content, name):
        return assets_of(name, content)


def corpus_class(path: Path | str, source: Mapping[str, Any]) -> type[SpeechMotionDataModule]:
    """The data module that a model was trained on.

    Args:
        path: the checkpoint, for messages.
        source: the model's :attr:`AnimationModel.data_source`.

    Raises:
        FaceDiffError: if the class is neither registered nor imported.
    """
    module: type[SpeechMotionDataModule] | None = find_class(corpus, source.get("class_path"), SpeechMotionDataModule)
    if module is None:
        raise unknown_class(path, "data module", source.get("class_path"))
    return module


def corpus_of(path: Path | str, checkpoint: Mapping[str, Any]) -> tuple[type[SpeechMotionDataModule], dict[str, Any]]:
    """The data module that a checkpoint was trained on, and its options.

    Raises:
        FaceDiffError: if the class is not known, or an option is no plain value of the type that the class asks for.
    """
    source = checkpoint.get(DATA_SOURCE_KEY) or {}
    module = corpus_class(path, source)
    # An imported model knows its corpus, but not where its folder is.
    saved = checkpoint.get("datamodule_hyper_parameters")
    stored = {**module.former_options, **saved} if saved else {name: source[name] for name in source.keys() & {"root"}}
    options = {name: value for name, value in stored.items() if not name.startswith("_")}
    read_options(str(path), module, options, component_finders())
    return module, options
