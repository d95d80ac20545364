"""The one door into a checkpoint: how an untrusted file becomes a model, its assets and its corpus.

A model folder (:mod:`facediff.models.pretrained`), also of the Hugging Face hub, is read into the same content as a
checkpoint, and goes the same way from there on.

Every command and every method that loads a checkpoint comes through here. In this order, and before anything is
imported because the file asks for it:

1. The content is tensors and plain data (``torch.load`` with ``weights_only=True``, or safetensors and JSON).
2. The model, its components and the data module are classes that are registered, or imported already.
3. Their options are plain values of the types that the constructors ask for
   (:mod:`facediff.hyperparameters`): nothing that could be imported, opened as a config, fetched from another
   machine or resolved as ``${…}``.
4. The assets are those that :meth:`Assets.from_state` accepts, and the weights fit the model that is built.

A checkpoint can make facediff read only the folders of the corpus that it was trained on, when it is scored on that
corpus or adapted; see SECURITY.md.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

import torch

from facediff.data import SpeechMotionDataModule
from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY, FORMAT, FORMAT_KEY, Assets
from facediff.errors import FaceDiffError, choices, damaged
from facediff.hyperparameters import Components, read_options, unknown_class
from facediff.models.checkpoint_content import FACES_KEY, CheckpointContent
from facediff.models.earlier_versions import without_removed_options
from facediff.models.pretrained import read_model
from facediff.registry import COMPONENTS, corpus, find_class, model
from facediff.spaces import Space
from facediff.utils.hints import is_name
from facediff.utils.hub import model_path, split_face
from facediff.utils.limits import quoted
from facediff.utils.torch_files import EXPECTED, load_tensors

FACES_PREFIX = "further_faces."
"""Beginning of the names of these faces' weights, in front of the face's name."""


def naming(path: object) -> AbstractContextManager[None]:
    """Errors of reading a damaged content become a sentence that names the file."""
    packages = "or install the packages that its components come from, in the versions that wrote it"
    return damaged(path, f"the file is damaged, {packages}", Exception)


def read_checkpoint(path: str | os.PathLike[str] | IO[bytes]) -> dict[str, Any]:
    """Read a checkpoint without running any code from it, and check all that it names.

    Args:
        path: the file, which may be open; a model folder; or a name of the Hugging Face hub.
    """
    checkpoint, name = read_content(path)
    model_of(name, checkpoint["hyper_parameters"])
    assets = assets_of(name, checkpoint)
    if checkpoint["hyper_parameters"].get("identities") != assets.identities:
        raise FaceDiffError(f"{name}: its model and its assets do not have the same identities; {EXPECTED}")
    return checkpoint


def read_assets(path: Path | str) -> Assets:
    """The assets alone: templates, faces, frame rate …; no class that the checkpoint names is looked at."""
    content, name = read_content(path, weights=False)
    return assets_of(name, content)


def corpus_class(path: Path | str, source: Mapping[str, Any]) -> type[SpeechMotionDataModule]:
    """The data module that a model was trained on, which is registered or imported."""
    module: type[SpeechMotionDataModule] | None = find_class(corpus, source.get("class_path"), SpeechMotionDataModule)
    if module is None:
        raise unknown_class(path, "data module", source.get("class_path"))
    return module


def corpus_of(path: Path | str, checkpoint: Mapping[str, Any]) -> tuple[type[SpeechMotionDataModule], dict[str, Any]]:
    """The data module that a checkpoint was trained on, and its options, which are plain values."""
    source = checkpoint.get(DATA_SOURCE_KEY) or {}
    module = corpus_class(path, source)
    # An imported model knows its corpus, but not where its folder is.
    saved = checkpoint.get("datamodule_hyper_parameters")
    stored = saved if saved else {name: source[name] for name in source.keys() & {"root"}}
    stored = without_removed_options({"class_path": source.get("class_path"), "init_args": stored}, path)["init_args"]
    options = {name: value for name, value in stored.items() if not name.startswith("_")}
    # A folder that training was given relative to its working folder is found from another one.
    root, trained = options.get("root"), source.get("root")
    if isinstance(root, str) and isinstance(trained, str) and not Path(root).expanduser().exists():
        options["root"] = trained if Path(trained).is_dir() else root
    read_options(str(path), module, options, component_finders())
    return module, options


@contextmanager
def checked_file(path: str | os.PathLike[str] | IO[bytes]) -> Iterator[IO[bytes]]:
    """A checkpoint after all checks, as a stream, for Lightning, which must read it itself."""
    content = read_checkpoint(path)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    buffer.seek(0)
    yield buffer


def read_content(path: str | os.PathLike[str] | IO[bytes], *, weights: bool = True) -> tuple[dict[str, Any], str]:
    """The content of a checkpoint or of a model folder, of which only the outer form is checked, and its name.

    Args:
        path: a checkpoint, which may be open; a model folder; a name of the Hugging Face hub; or one face of any of
            them, as :func:`facediff.utils.hub.split_face` reads it.
        weights: whether to read the weights of a model folder too.
    """
    face, name = None, str(getattr(path, "name", "checkpoint"))
    if isinstance(path, str | os.PathLike):
        source, face = split_face(path)
        name, path = str(source), model_path(source)
    with naming(name):
        if isinstance(path, Path) and path.is_dir():
            content = read_model(path, weights=weights or face is not None)
        else:
            content = load_tensors(path)
    check_content(content, name)
    return (content if face is None else face_content(content, face, name)), name


def face_content(checkpoint: dict[str, Any], face: str, path: object) -> dict[str, Any]:
    """The content of one face's own model in a checkpoint of many faces, without anything of its training."""
    faces = checkpoint.get(FACES_KEY) or {}
    if face not in faces:
        offered = choices(face, list(faces)) if faces else "it is a model of one face; omit the name"
        raise FaceDiffError(f"{path}: has no further face {quoted(face)}: {offered}")
    prefix = f"{FACES_PREFIX}{face}."
    weights = {
        key.removeprefix(prefix): value for key, value in checkpoint["state_dict"].items() if key.startswith(prefix)
    }
    copied = (FORMAT_KEY, "pytorch-lightning_version", "epoch", "global_step")
    shared = {name: checkpoint[name] for name in copied if name in checkpoint}
    content: dict[str, Any] = {**shared, **faces[face], "state_dict": weights}
    check_content(content, path)
    return content


WRAPPER = re.compile(r"(?:^|(?<=\.))(?:_orig_mod|_forward_module|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")


def check_content(checkpoint: Any, path: object) -> None:  # noqa: ANN401 - whatever a file holds
    """Refuse a content that has not the outer form of a checkpoint of facediff's, and drop options of 1.x in place."""
    parts, optional = ("hyper_parameters", "state_dict", ASSETS_KEY), (DATA_SOURCE_KEY, "datamodule_hyper_parameters")
    complete = (
        isinstance(checkpoint, dict)
        and all(isinstance(checkpoint.get(part), dict) for part in parts)
        and all(isinstance(checkpoint.get(part), dict | None) for part in optional)
    )
    if not complete or not isinstance(checkpoint.get(FORMAT_KEY), int) or checkpoint[FORMAT_KEY] != FORMAT:
        raise FaceDiffError(
            f"{path}: written by another version of facediff, whose checkpoints this one cannot read; train the model "
            f"again with `facediff fit`, or use the version that wrote it"
            if complete
            else f"{path}: a checkpoint, but not of facediff: it lacks the templates and sizes that animation needs; "
            f"{EXPECTED}"
        )
    # torch.compile and sharded strategies wrap modules, which adds a word to the names of their weights.
    checkpoint["state_dict"] = {WRAPPER.sub("", key): value for key, value in checkpoint["state_dict"].items()}
    checkpoint["hyper_parameters"] = without_removed_options(checkpoint["hyper_parameters"], path)


def assets_of(path: Path | str, checkpoint: Mapping[str, Any]) -> Assets:
    """The assets of a checkpoint's content."""
    with naming(path):
        return Assets.from_state(checkpoint[ASSETS_KEY])


def model_of(path: Path | str, hparams: Mapping[str, Any]) -> tuple[type[CheckpointContent], dict[str, Any]]:
    """The model's class and its constructor's arguments: components and plain values."""
    class_path = hparams.get("_class_path")
    implementation: type[CheckpointContent] | None = find_class(model, class_path, CheckpointContent)
    if implementation is None:
        raise unknown_class(path, "model", class_path)
    extra = ("_class_path", "_instantiator", "identities", "space", "faces")
    options = {name: value for name, value in hparams.items() if name not in extra}
    with naming(path):
        arguments = read_options(str(path), implementation, options, component_finders())
        sizes = {name: hparams.get(name) for name in ("identities", "space")}
        check_sizes(sizes)
        if "faces" in hparams:
            for name, face in hparams["faces"].items():
                check_sizes({"identities": [name], "space": None})
                check_sizes(face)
            sizes["faces"] = hparams["faces"]
    return implementation, {**arguments, **sizes}


def check_sizes(sizes: Mapping[str, Any]) -> None:
    """Refuse identities that cannot be names of files, and a space that is none."""
    names = sizes["identities"]
    if not isinstance(names, list) or not all(map(is_name, names)):
        raise FaceDiffError(f"its identities are {quoted(names)}; expected names without path separators")
    if sizes["space"] is not None:
        Space.from_state(sizes["space"])


def misfit(weights: Mapping[str, torch.Tensor], expected: Mapping[str, Any]) -> str:
    """A sentence about weights that do not fit a model's own; empty if they do."""
    absent_keys, extra = sorted(expected.keys() - weights.keys()), sorted(weights.keys() - expected.keys())
    reshaped = sorted(name for name in expected.keys() & weights.keys() if expected[name].shape != weights[name].shape)
    for names, fault in ((absent_keys, "are missing"), (extra, "are too many"), (reshaped, "are of another shape")):
        if names:
            shapes = f" {tuple(weights[names[0]].shape)} in place of {tuple(expected[names[0]].shape)}" * (
                names is reshaped
            )
            return (
                f"its weights are not those of its model ({len(names)} {fault}, the first is {quoted(names[0])}"
                f"{shapes}); the file is damaged, or its options were changed"
            )
    return ""


def component_finders() -> Components:
    """What finds the classes of components, by kind; those that are not registered must be of the kind's base class."""
    from facediff.models import (
        audio_encoders,
        decoders,
        fusions,
        mesh_encoders,
        motion_space,
        samplers,
        speaker_encoders,
    )

    bases: dict[str, type] = {
        "motion_space": motion_space.MotionSpace,
        "audio_encoder": audio_encoders.AudioEncoder,
        "identity_encoder": speaker_encoders.IdentityEncoder,
        "style_encoder": speaker_encoders.StyleEncoder,
        "mesh_encoder": mesh_encoders.MeshEncoder,
        "fusion": fusions.Fusion,
        "decoder": decoders.Decoder,
        "sampler": samplers.Sampler,
    }
    return {name: partial(find_class, kind, base=bases.get(name, torch.nn.Module)) for name, kind in COMPONENTS.items()}
