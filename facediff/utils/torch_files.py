"""Files of tensors, of which nothing runs: by ``torch.load`` with ``weights_only=True``, and safetensors."""

from __future__ import annotations

import os
import pickle  # for its exception only
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from facediff.errors import FaceDiffError, damaged
from facediff.utils.arrays import read_arrays
from facediff.utils.limits import brief

if TYPE_CHECKING:
    from torch import Tensor

EXPECTED = "expected a .ckpt file that `facediff fit` has written"

AUTHORS = "expected a checkpoint as its authors distribute it (.pth, .pth.tar, .ckpt), written by torch.save"


def load_tensors(file: str | os.PathLike[str] | IO[bytes], expected: str = EXPECTED) -> Any:  # noqa: ANN401
    """The tensors and plain data of a file that ``torch.save`` wrote, on the CPU."""
    import torch

    try:
        if not isinstance(file, str | os.PathLike):
            file.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of how older versions stored tensors
            return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # PyTorch's reasons are paragraphs with advice to read such a file all the same
        name = file if isinstance(file, str | os.PathLike) else getattr(file, "name", "checkpoint")
        not_plain = isinstance(error, pickle.UnpicklingError)
        reason = "damaged, or more than tensors and plain values" if not_plain else brief(error)
        raise FaceDiffError(f"{name}: not a checkpoint that can be loaded safely ({reason}); {expected}") from error


def write_safetensors(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors; not atomic."""
    from safetensors.torch import save

    # The library's own writer gives its files to their owner alone.
    content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    path.write_bytes(save(content, {"format": "pt"}))


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a file, on the CPU."""
    from safetensors.torch import load_file

    remedy = "copy or download it again, in a git clone by `git lfs pull`"
    with damaged(f"{path}: not a readable safetensors file", remedy, Exception):
        return load_file(path)


# Checkpoints of other projects: their tensors alone.


class Foreign:
    """In place of an object of another package, of which nothing is kept."""

    def __new__(cls, *arguments: object) -> Any:  # noqa: ANN401
        """Take any arguments."""
        return super().__new__(cls)

    def __setstate__(self, state: object) -> None:
        """Forget the state."""


class ForeignDict:
    """In place of a class of dicts, or of an ``argparse.Namespace``: a dict that has the object's attributes."""

    def __new__(cls, *arguments: object) -> Any:  # noqa: ANN401
        """The only kind of dict that PyTorch's reader fills."""
        return OrderedDict()


def path_text(*parts: object) -> str:
    """In place of a path: its text."""
    return str(PurePosixPath(*map(str, parts)))


def stand_in_for(name: str) -> Any:  # noqa: ANN401
    """What takes the place of a function or class, e.g. ``pathlib.PosixPath``."""
    if name.startswith("pathlib."):
        return path_text
    # defaultdict, EasyDict, ConfigDict, yacs' CfgNode.
    return ForeignDict if name.endswith(("dict", "Dict", "CfgNode", "Namespace")) else Foreign


def read_authors_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the plain options of another project's checkpoint by name, on the CPU.

    The file is one of ``torch.save``, or arrays by name (``.npz``), as ``tools/convert_tensorflow.py`` writes them.
    Tensors may lie in it by their names, or under ``state_dict``, ``model`` or ``encoder``; options under ``args``, as
    an ``argparse.Namespace`` or a dict. Of anything else in it, nothing is imported or run.
    """
    import torch

    if path.suffix == ".npz":
        return {name: torch.from_numpy(np.array(value)) for name, value in read_arrays(path).items()}, {}
    try:
        names = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    except Exception:  # an archive of before PyTorch 1.6, which may hold tensors alone; or damaged, as is said below
        names = []
    with torch.serialization.safe_globals([(stand_in_for(name), name) for name in names]):
        content = load_tensors(path, AUTHORS)
    tensors = state_of(content)
    if not tensors:
        raise FaceDiffError(f"{path}: holds no tensors by name; {AUTHORS}")
    options = content.get("args")
    options = {**options, **vars(options)} if isinstance(options, OrderedDict) else options
    options = options if isinstance(options, Mapping) else {}
    return (
        {name.removeprefix("module."): value.detach() for name, value in tensors.items()},
        {key: value for key, value in options.items() if isinstance(key, str) and is_plain(value)},
    )


def is_plain(value: object) -> bool:
    """Whether it is a number, a text, None, or a list of such."""
    if isinstance(value, list | tuple):
        return all(is_plain(item) and not isinstance(item, list | tuple) for item in value)
    return value is None or isinstance(value, bool | int | float | str)


def state_of(content: object) -> dict[str, Tensor]:
    """The tensors by name of a state dict, or of what wraps one."""
    import torch

    if not isinstance(content, Mapping):
        return {}
    tensors = {k: value for k, value in content.items() if isinstance(k, str) and isinstance(value, torch.Tensor)}
    if tensors:
        return tensors
    inner = (state_of(content.get(key)) for key in ("state_dict", "model", "model_state_dict", "encoder"))
    return next(filter(None, inner), {})
