"""Opening checkpoints, which are untrusted files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import nn

from facediff.data.batch import ASSETS_KEY, Assets
from facediff.errors import FaceDiffError
from facediff.models.samplers import Sampler
from facediff.registry import COMPONENTS

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel


T = TypeVar("T")


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a facediff checkpoint without running any code from it.

    Raises:
        FaceDiffError: if the file is missing, no checkpoint, or not one of facediff's.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such checkpoint; expected a .ckpt file that `facediff fit` has written")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # Whatever a damaged or hostile file makes the reader raise, the reason is the file.
        raise FaceDiffError(
            f"{path}: not a checkpoint that can be loaded safely (damaged, or more than tensors and plain values); "
            f"expected a .ckpt file that `facediff fit` has written"
        ) from error
    if not isinstance(checkpoint, dict) or ASSETS_KEY not in checkpoint:
        raise FaceDiffError(
            f"{path}: a checkpoint, but not of facediff: it lacks the templates and sizes that animation needs; "
            f"expected a .ckpt file that `facediff fit` has written"
        )
    check_class_paths(path, checkpoint.get("hyper_parameters", {}))
    return checkpoint


def read_assets(path: Path) -> Assets:
    """The assets alone: templates, faces, frame rate …; the model is not built.

    Raises:
        FaceDiffError: as :func:`read_checkpoint`.
    """
    return Assets.from_state(read_checkpoint(path)[ASSETS_KEY])


def check_class_paths(path: Path, hparams: dict[str, Any]) -> None:
    """Refuse hyper-parameters that name anything but components.

    Whatever class path stands in a checkpoint would be imported and called when the model is rebuilt.

    Raises:
        FaceDiffError: if a class path is neither a registered component's nor that of an imported module class, or
            stands where no component belongs.
    """
    for key, value in hparams.items():
        if key in COMPONENTS and isinstance(value, dict):
            named = str(value.get("class_path"))
            if not is_component(key, named):
                raise FaceDiffError(
                    f'{path}: its {key} is "{named}", which is no known component; it was not loaded. If you trust the '
                    f"file, install or import the package that the component comes from"
                )
            value = value.get("init_args", {})
        if names_a_class(value):
            raise FaceDiffError(
                f"{path}: its hyper-parameter {key} names a class where none belongs; it was not loaded"
            )


def is_component(kind: str, path: str) -> bool:
    """Whether an import path is a registered component's, or that of a class of modules that is imported already."""
    module, _, name = path.rpartition(".")
    if module == f"facediff.registry.{kind}":
        return name in COMPONENTS[kind].names()
    return is_imported(path, nn.Module) or is_imported(path, Sampler)


def imported(path: str, base: type[T]) -> type[T] | None:
    """The subclass of ``base`` of an import path; None if there is none, or its module is not imported yet."""
    module, _, name = path.rpartition(".")
    found = getattr(sys.modules.get(module), name, None)
    return found if isinstance(found, type) and issubclass(found, base) else None


def is_imported(path: str, base: type) -> bool:
    """Whether an import path is that of a subclass of ``base``; a module that is not imported yet stays so."""
    return imported(path, base) is not None


def names_a_class(value: object) -> bool:
    """Whether plain data holds a class path at any depth."""
    if isinstance(value, dict):
        return "class_path" in value or any(names_a_class(item) for item in value.values())
    return isinstance(value, list) and any(names_a_class(item) for item in value)


def load_model(path: Path | str, device: str = "cpu") -> AnimationModel:
    """A trained model, ready to animate.

    Args:
        path: a checkpoint of any model.
        device: where it shall compute.

    Raises:
        FaceDiffError: as :func:`read_checkpoint`, or if the model or one of its components is not installed.
    """
    checkpoint = read_checkpoint(Path(path))
    name = str(checkpoint["hyper_parameters"].get("_class_path"))
    try:
        # Assets stay on the CPU, where pictures and files are made of them.
        model = model_class(name).load_from_checkpoint(path, map_location="cpu", weights_only=True)
    except FaceDiffError:
        raise
    except (Exception, SystemExit) as error:
        # Lightning, jsonargparse and the components each have their own exceptions for what cannot be rebuilt.
        reason = next(iter(str(error).strip().splitlines()), repr(error))
        raise FaceDiffError(
            f"{path}: cannot be rebuilt as {name} ({reason}); install the packages its components come from"
        ) from error
    return model.eval().to(device)


def model_class(path: str) -> type[AnimationModel]:
    """The model of an import path; only classes that are imported already are looked at.

    Raises:
        FaceDiffError: if no imported model has that path.
    """
    from facediff.models.base import AnimationModel

    waiting = AnimationModel.__subclasses__()
    while waiting:
        candidate = waiting.pop()
        if path == f"{candidate.__module__}.{candidate.__qualname__}":
            return candidate
        waiting += candidate.__subclasses__()
    raise FaceDiffError(f'the checkpoint was made by the model "{path}", which is not imported; import it first')
