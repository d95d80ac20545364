"""Model folders: a trained model as files that can be handed to others, without anything that only training needs.

A folder holds

- ``model.safetensors``: the weights that checkpoints animate with, which are the averaged ones where training averaged;
  tensors that are equal, such as principal components that two modules know, are stored once;
- ``config.json``: the model's class and options, plain values of its assets, the licence labels and what it was made
  from, all as :meth:`AnimationModel.on_save_checkpoint` gives them, under a version number;
- ``assets.npz``: templates, triangles, regions, and a reference motion for every speaker; motion is stored as
  differences between frames, without loss, which compresses to less than half;
- ``README.md``: a model card (:mod:`facediff.models.model_card`), for people only.

Read again, these are the very content of a checkpoint, and pass every check of :mod:`facediff.models.checkpoint`:
nothing in a folder can name anything to import, to open or to run.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError, OptionError
from facediff.models.checkpoint_content import FACES_KEY, CheckpointContent
from facediff.models.model_card import card
from facediff.utils.arrays import read_arrays
from facediff.utils.files import atomic_folder
from facediff.utils.hints import is_plain_text
from facediff.utils.hub import ASSETS, CARD, CONFIG, WEIGHTS
from facediff.utils.licences import Licence, commercial_use, known_licence, merged
from facediff.utils.limits import check_format, quoted
from facediff.utils.plain_files import json_text, load_json
from facediff.utils.torch_files import read_safetensors, write_safetensors
from facediff.version import __version__

FORMAT = "facediff model 1"
"""Mark of the format of model folders; folders of another mark are refused."""

DATA_OPTIONS_KEY = "datamodule_hyper_parameters"
"""Where a checkpoint keeps the options of the data module."""

LONGEST_LICENCE = 200
"""Characters of the name of a licence."""

LIGHTNING = "2.6.0"
"""Which Lightning is said to have written the content, so that it converts nothing."""

PARTS = {"format", "version", "model", "state", "shared"}
REMEDY = (
    "expected a folder that `facediff publish` has written; copy or download it again, in a git clone by `git lfs pull`"
)
MARK = "$tensor"
MOTION_FRAMES = 8
"""From so many frames on, a (T, V, 3) tensor is stored as differences between frames."""

DTYPES = {
    name: getattr(torch, name)
    for name in ("float64", "float32", "float16", "bfloat16", "int64", "int32", "int16", "int8", "uint8", "bool")
}


def publish(
    model: CheckpointContent,
    folder: Path,
    *,
    licence: str | None = None,
    name: str | None = None,
) -> Path:
    """Write a model folder with its card, whole or not at all; see :meth:`AnimationModel.save_pretrained`."""
    _ = model.assets  # an untrained model is refused before anything is written
    if licence is not None and not (licence.strip() and is_plain_text(licence) and len(licence) <= LONGEST_LICENCE):
        raise OptionError.naming(
            f"{{license}} {quoted(licence)}: expected a short name, such as apache-2.0 or cc-by-nc-4.0"
        )
    before = model.licences
    model.licences = published_licences(before, licence)
    try:
        with atomic_folder(folder) as partial:
            write_model(model, partial)
            (partial / CARD).write_text(card(model, name or folder.resolve().name), encoding="utf-8")
    finally:
        model.licences = before
    return folder


def published_licences(inherited: Iterable[Licence], name: str | None) -> tuple[Licence, ...]:
    """A published model's labels: its weights' own, and all that it inherits.

    Args:
        inherited: the model's labels.
        name: the licence that its author chose for the weights; if None the strictest of the data's, of several equally
            strict the first.
    """
    labels = list(inherited)
    strictest = commercial_use(labels)
    origin = next((label for label in labels if label.commercial == strictest), Licence("weights"))
    own, parents = Licence("weights", origin.name, strictest, f"as {origin.of}" if labels else ""), []
    if name is not None:
        own = Licence("weights", name, known_licence(name), "chosen when the model was published")
        # Weights that derive from published weights inherit their terms, as the parent's do.
        parents = [replace(label, of="parent's weights") for label in labels if label.of == "weights"]
    return merged([own], parents, [label for label in labels if label.of != "weights"])


def write_model(model: CheckpointContent, folder: Path) -> dict[str, Any]:
    """Write a model's files into a folder that exists; not atomic.

    Args:
        model: trained, or read from a checkpoint.
        folder: an empty folder.

    Returns:
        what ``config.json`` holds.
    """
    content = content_of(model)
    weights, shared = stored_once(content.pop("state_dict"))
    tensors: dict[str, Tensor] = {}
    config = {
        "format": FORMAT,
        "version": __version__,
        "model": as_plain(content.pop("hyper_parameters"), tensors, "model"),
        "state": as_plain(content, tensors, ""),
        "shared": shared,
    }
    write_safetensors(folder / WEIGHTS, weights)
    arrays = {name: coded(value) if is_motion(value) else value.contiguous().numpy() for name, value in tensors.items()}
    with (folder / ASSETS).open("wb") as stream:
        np.savez_compressed(stream, **cast(Any, arrays))
    (folder / CONFIG).write_text(json_text(folder / CONFIG, config) + "\n", encoding="utf-8")
    return config


def content_of(model: CheckpointContent) -> dict[str, Any]:
    """The content of the model's checkpoint for inference; no folder of this machine is named in it."""
    content: dict[str, Any] = {"hyper_parameters": dict(model.hparams), "state_dict": model.state_dict()}
    model.on_save_checkpoint(content)
    return without_folders({**content, DATA_OPTIONS_KEY: model.data_options})


def without_folders(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a checkpoint without its corpus's folders and any absolute path; its further faces too."""
    source, options = content.get(DATA_SOURCE_KEY) or {}, content.get(DATA_OPTIONS_KEY) or {}
    cleaned = {
        **content,
        "hyper_parameters": without_paths(content["hyper_parameters"]),
        DATA_SOURCE_KEY: {name: text for name, text in source.items() if name == "class_path"},
        DATA_OPTIONS_KEY: without_paths({name: options[name] for name in options if name not in ("root", "people")}),
    }
    if FACES_KEY in content:
        cleaned[FACES_KEY] = {name: without_folders(face) for name, face in content[FACES_KEY].items()}
    return cleaned


def without_paths(value: Any) -> Any:  # noqa: ANN401 - plain data
    """Plain data with an empty text in place of every absolute path."""
    if isinstance(value, Mapping):
        return {name: without_paths(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_paths(part) for part in value]
    return (
        "" if isinstance(value, str) and (value.startswith(("/", "~", ".")) or value[1:3] in (":\\", ":/")) else value
    )


def stored_once(weights: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The weights without those that equal an earlier one, and for each of these the earlier one's name."""
    unique: dict[str, Tensor] = {}
    shared: dict[str, str] = {}
    by_content: dict[tuple[Any, ...], list[str]] = {}
    for name, value in weights.items():
        alike = by_content.setdefault((value.dtype, tuple(value.shape)), [])
        twin = next(
            (name_of_twin for name_of_twin in alike if value.numel() > 1 and torch.equal(unique[name_of_twin], value)),
            None,
        )
        if twin is None:
            unique[name] = value
            alike.append(name)
        else:
            shared[name] = twin
    return unique, shared


def read_model(folder: Path, *, weights: bool = True) -> dict[str, Any]:
    """A model folder as the content of a checkpoint; only its form is checked."""
    path = folder / CONFIG
    config = load_json(path, remedy=REMEDY)
    if not isinstance(config, dict) or config.keys() != PARTS:
        raise FaceDiffError(f"{path}: is no config of a model, with {', '.join(sorted(PARTS))}; {REMEDY}")
    check_format(path, config["format"], FORMAT)
    arrays = read_arrays(folder / ASSETS, remedy=REMEDY)
    content = {
        "pytorch-lightning_version": LIGHTNING,
        "hyper_parameters": with_tensors(config["model"], arrays),
        **with_tensors(config["state"], arrays),
        "state_dict": {},
    }
    if weights:
        tensors = read_safetensors(folder / WEIGHTS)
        content["state_dict"] = {**{name: tensors[twin] for name, twin in config["shared"].items()}, **tensors}
    return content


# Plain data with tensors in it, as JSON and arrays.


def as_plain(value: Any, tensors: dict[str, Tensor], name: str) -> Any:  # noqa: ANN401 - plain data of any form
    """Plain data for JSON; a tensor goes to ``tensors``, and its place holds a mark with its name and its type."""
    if isinstance(value, Tensor):
        key, number = name, 2
        while key in tensors or "/" in key or "\\" in key:
            key, number = f"{name.replace('/', '_')}_{number}".replace("\\", "_"), number + 1
        tensors[key] = value.detach().cpu()
        return {MARK: key, "type": str(value.dtype).removeprefix("torch."), "shape": list(value.shape)}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value) or MARK in value:
            raise FaceDiffError(f"the model keeps {quoted(value)} in {name}; expected values by name")
        return {key: as_plain(part, tensors, f"{name}.{key}".lstrip(".")) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(part, tensors, f"{name}.{index}") for index, part in enumerate(value)]
    return value


def with_tensors(value: Any, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Any:  # noqa: ANN401
    """Undo :func:`as_plain`; the caller names the file in errors of a tensor's size or type."""
    if isinstance(value, list):
        return [with_tensors(part, arrays) for part in value]
    if not isinstance(value, dict):
        return value
    if MARK not in value:
        return {name: with_tensors(part, arrays) for name, part in value.items()}
    array, kind = arrays[value[MARK]], value["type"]
    if array.dtype == np.uint8 and array.ndim == 3 and kind != "uint8":
        array = decoded(array)
    numbers = torch.from_numpy(np.frombuffer(bytearray(np.ascontiguousarray(array).tobytes()), np.uint8))
    typed = numbers.view(DTYPES[kind]) if kind != "bool" else numbers != 0
    return typed.reshape(value["shape"])


def is_motion(value: Tensor) -> bool:
    """Whether a tensor is stored as differences between frames."""
    return value.ndim == 3 and len(value) >= MOTION_FRAMES and value.dtype in (torch.float16, torch.float32)


def coded(value: Tensor) -> np.ndarray[Any, Any]:
    """Motion (T, V, 3) as bytes (B, T, 3V): differences of the bit patterns between frames, byte by byte apart.

    Neighbouring frames are alike, so that the upper bytes of most differences are 0 or 255, which zip shortens well;
    whole numbers wrap around, so that nothing is lost.
    """
    array = value.contiguous().numpy()
    bits = array.view(f"<u{array.itemsize}").reshape(len(array), -1)
    steps = bits.copy()
    steps[1:] -= bits[:-1]
    return np.ascontiguousarray(np.moveaxis(steps.view(np.uint8).reshape(*bits.shape, array.itemsize), -1, 0))


def decoded(planes: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Undo :func:`coded`, up to the type and the shape."""
    item = len(planes)
    if item not in (2, 4):
        return planes
    steps = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(f"<u{item}")[..., 0]
    return np.cumsum(steps, axis=0, dtype=steps.dtype)
