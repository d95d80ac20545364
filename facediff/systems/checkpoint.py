"""Opening checkpoints, which are untrusted files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from facediff.data.assets import ASSETS_KEY
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.systems.base import SpeechAnimator


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
    return checkpoint


def load_system(path: Path | str, map_location: str = "cpu") -> SpeechAnimator:
    """A trained system, ready to animate.

    Args:
        path: a checkpoint of any system.
        map_location: device to load it to.

    Raises:
        FaceDiffError: as :func:`read_checkpoint`, or if the system or one of its components is not installed.
    """
    checkpoint = read_checkpoint(Path(path))
    name = str(checkpoint["hyper_parameters"].get("_class_path"))
    try:
        system = system_class(name).load_from_checkpoint(path, map_location=map_location, weights_only=True)
    except FaceDiffError:
        raise
    except (Exception, SystemExit) as error:
        # Lightning, jsonargparse and the components each have their own exceptions for what cannot be rebuilt.
        reason = next(iter(str(error).strip().splitlines()), repr(error))
        raise FaceDiffError(
            f"{path}: cannot be rebuilt as {name} ({reason}); install the packages its components come from"
        ) from error
    return system.eval()


def system_class(path: str) -> type[SpeechAnimator]:
    """The system of an import path; only classes that are imported already are looked at.

    Raises:
        FaceDiffError: if no imported system has that path.
    """
    from facediff.systems.base import SpeechAnimator

    waiting = SpeechAnimator.__subclasses__()
    while waiting:
        candidate = waiting.pop()
        if path == f"{candidate.__module__}.{candidate.__qualname__}":
            return candidate
        waiting += candidate.__subclasses__()
    raise FaceDiffError(f'the checkpoint was made by the system "{path}", which is not imported; import it first')
