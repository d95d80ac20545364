"""Where a model comes from: a checkpoint, a model folder, or the Hugging Face hub, through ``huggingface_hub``.

Importing this costs nothing, so that commands can refuse a name at once.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, TypeVar

from facediff.errors import FaceDiffError, damaged, needs_extra
from facediff.utils.checksums import sha256
from facediff.utils.paths import from_home

CONFIG, WEIGHTS, ASSETS, CARD = "config.json", "model.safetensors", "assets.npz", "README.md"
BUNDLED = Path(__file__).parents[1] / "bundled" / "puppet"
"""The model that comes with facediff: a folder of ``facediff export-model``, made by ``tools/bundled_model.py``."""

FILES = (CONFIG, WEIGHTS, ASSETS, CARD)
"""The files of a model folder; no other is fetched."""

EXPECTED = (
    "expected a .ckpt file that `facediff fit` has written, a folder of `facediff publish`, or user/name[@revision] of "
    "the Hugging Face hub"
)
EXPECTED_TO_ANIMATE = (
    f"expected {BUNDLED.name}, the model that comes with facediff; a .ckpt file that `facediff fit` has written; a "
    f"folder of `facediff publish` or `export-model`; or user/name[@revision] of the Hugging Face hub"
)

Source = TypeVar("Source", bound="str | os.PathLike[str]")

_ID = re.compile(r"(?P<name>[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95})(?:@(?P<revision>[\w.-][\w./-]{0,199}))?")


def hub_id(source: str | os.PathLike[str]) -> tuple[str, str | None] | None:
    """Name and revision of a model on the hub; None for what can be no such name, or is a path of this machine."""
    text = os.fspath(source)
    match = _ID.fullmatch(text)
    if match is None or os.path.lexists(text) or match["name"].endswith((".ckpt", ".pt", ".pth", ".safetensors")):
        return None
    return match["name"], match["revision"]


def split_face(source: str | os.PathLike[str]) -> tuple[str, str | None]:
    """A model of many faces and the face that is named after a colon; None for the whole model.

    Example:
        >>> split_face("user/name:mask"), split_face("demo/puppet.ckpt")
        (('user/name', 'mask'), ('demo/puppet.ckpt', None))
    """
    text = os.fspath(source)
    model, colon, face = text.rpartition(":")
    # Neither a drive letter nor a file with a colon in its name.
    if len(model) < 2 or not re.fullmatch(r"[\w.-]+", face) or os.path.lexists(text):
        return text, None
    return (model, face) if os.path.exists(model) or hub_id(model) is not None else (text, None)  # noqa: PTH110


def is_hub_name(text: str) -> bool:
    """Whether a text can name a model on the hub, without a revision."""
    match = _ID.fullmatch(text)
    return match is not None and match["revision"] is None


def bundled_by_name(source: Source) -> Source | Path:
    """The folder of the model that comes with facediff, where its name is given and no file is called so."""
    return BUNDLED if str(source) == BUNDLED.name and not os.path.lexists(source) else source


def check_model_source(source: str | os.PathLike[str], option: str = "", expected: str = EXPECTED) -> None:
    """Refuse, before anything heavy is imported, what can be no trained model."""
    label = f"{option} {source}".strip()
    source, _ = split_face(source)
    fault = ""
    if is_exported(bundled_by_name(source)):
        fault, expected = "holds graphs, with which one can only animate", EXPECTED
    elif os.path.isdir(source):  # noqa: PTH112 - also of a name with a NUL, which pathlib raises for
        names = missing_files(Path(source))
        fault = f"this folder has no {names}, so it holds no model" if names else ""
    elif not os.path.isfile(source) and hub_id(source) is None:  # noqa: PTH113
        fault = "no such checkpoint"
    if fault:
        raise FaceDiffError(f"{label}: {fault}; {expected}")


def missing_files(folder: Path) -> str:
    """Names of a model folder's files that are not there; empty if all are."""
    return ", ".join(name for name in (CONFIG, WEIGHTS, ASSETS) if not (folder / name).is_file())


def is_exported(source: str | os.PathLike[str]) -> bool:
    """Whether a model is a folder of graphs, of ``facediff export-model`` or others, which needs no PyTorch."""
    return (Path(source) / "model.json").is_file()


def is_audio2face(source: str | os.PathLike[str]) -> bool:
    """Whether a model is a folder of Audio2Face-3D, as NVIDIA distributes it."""
    return is_exported(source) and (Path(source) / "network_info.json").is_file()


def is_graphs(source: str | os.PathLike[str]) -> bool:
    """Whether a model is a folder of ``facediff export-model``, and not of others."""
    return is_exported(source) and not is_audio2face(source)


def may_have_weights(source: str | os.PathLike[str]) -> bool:
    """Whether a model's animations may be made of weights of face shapes, before it is read whole."""
    if not is_graphs(source):
        return True
    from facediff.utils.plain_files import load_json

    content = load_json(Path(source) / "model.json", remedy=EXPECTED)
    content = content if isinstance(content, dict) else {}
    space = content.get("space")
    return content.get("corpus") == "puppet" or (isinstance(space, dict) and space.get("kind") == "arkit")


def check_animating_source(source: str | os.PathLike[str]) -> None:
    """Refuse, before anything heavy is imported, what cannot be animated with."""
    if not is_exported(source):
        check_model_source(source, expected=EXPECTED_TO_ANIMATE)


def model_or_bundled(source: Source | None) -> Source | Path:
    """The model of a name, or the one that comes with facediff, of which a line then tells."""
    model_or_name = BUNDLED if source is None else bundled_by_name(from_home(source))
    if model_or_name is BUNDLED and not is_exported(BUNDLED):
        raise FaceDiffError(f"--checkpoint: missing, and this copy of facediff has no model at {BUNDLED}; {EXPECTED}")
    if source is not None:
        return model_or_name
    print(
        f"no --checkpoint: {BUNDLED.name}, the model that comes with facediff; its speech and faces are synthetic",
        file=sys.stderr,
    )
    return BUNDLED


def check_training_source(source: str | os.PathLike[str]) -> None:
    """Refuse to train on from a published model."""
    check_model_source(source, "--ckpt_path")
    if not os.path.isfile(source):  # noqa: PTH113
        raise FaceDiffError(
            f"--ckpt_path {source}: a model that was published holds no state of a training that could go on; expected "
            f"a .ckpt file of `facediff fit`, or the word last"
        )


def model_path(source: str | os.PathLike[str]) -> Path:
    """The checkpoint or the model folder that a name stands for; a model of the hub is fetched."""
    return _located(source)[0]


def local_model(source: str | os.PathLike[str]) -> Path:
    """As :func:`model_path`, with the face after it where one is named."""
    path, face = _located(source)
    return path if face is None else path.with_name(f"{path.name}:{face}")


def _located(source: str | os.PathLike[str]) -> tuple[Path, str | None]:
    check_model_source(source)
    model, face = split_face(source)
    hub_name = hub_id(model)
    return Path(model) if hub_name is None else fetch(*hub_name), face


def model_files(source: str | os.PathLike[str]) -> list[Path]:
    """The files that decide a model's output: the checkpoint, or the files of the folder that hold numbers."""
    path = model_path(source)
    return [path / name for name in (CONFIG, WEIGHTS, ASSETS)] if path.is_dir() else [path]


def model_hash(source: str | os.PathLike[str]) -> str:
    """SHA-256 of a model: of the checkpoint's bytes, or of a folder's :func:`model_files`.

    A folder's card has no part in the output and does not count.
    """
    path = model_path(source)
    files = model_files(path)
    if not path.is_dir():
        return sha256(path)
    return hashlib.sha256("".join(f"{sha256(file)}  {file.name}\n" for file in files).encode()).hexdigest()


def model_name(source: str | os.PathLike[str]) -> str:
    """What metadata call a model: the name of its file or folder, or its whole name on the hub."""
    return os.fspath(source) if hub_id(source) is not None else Path(source).resolve().name


def fetch(name: str, revision: str | None = None) -> Path:
    """The folder of a model of the hub, in the hub's cache on this machine."""
    with needs_extra("huggingface_hub", "hub", f"fetching the model {name}"):
        from huggingface_hub import snapshot_download
    label = name if revision is None else f"{name}@{revision}"
    with _hub_errors(label, "fetched"):
        options: dict[str, Any] = {"revision": revision, "allow_patterns": list(FILES), "library_name": "facediff"}
        folder = Path(snapshot_download(name, **options))
    if names := missing_files(folder):
        raise FaceDiffError(
            f"{label}: this model of the hub has no {names}, so facediff did not write it; expected a model that "
            f"`facediff publish --push` has sent there"
        )
    return folder


def push(folder: Path, name: str, *, private: bool = False) -> str:
    """Send a model folder to the hub; the model's address."""
    with needs_extra("huggingface_hub", "hub", "sending a model to the hub"):
        from huggingface_hub import HfApi
    with _hub_errors(name, "sent"):
        api = HfApi(library_name="facediff")
        address = api.create_repo(name, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=name, folder_path=folder, commit_message="Publish with facediff", allow_patterns=list(FILES)
        )
    return str(address)


def _hub_errors(name: str, action: str) -> AbstractContextManager[None]:
    """Errors of the hub's library, and of the libraries that it uses, with the model's name."""
    remedy = "check the name, go online, log in with `hf auth login` if it is private, or give a folder in its place"
    return damaged(f"{name}: neither a file or folder here, nor can it be {action}", remedy, Exception)
