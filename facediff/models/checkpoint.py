"""Opening checkpoints: an untrusted file becomes a model that is ready for inference.

A checkpoint is read as plain data (``weights_only=True``). The classes that it names (model, components, corpus) must
be registered, or be imported already; nothing is imported because a file asks for it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY, FORMAT, FORMAT_KEY, Assets
from facediff.errors import FaceDiffError
from facediff.registry import COMPONENTS, Kind, corpus, model

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.models.base import AnimationModel


def load_model(path: Path | str, device: str = "cpu") -> AnimationModel:
    """A trained model, ready for inference.

    Args:
        path: a checkpoint of any model, also of an installed package's.
        device: where it computes.

    Raises:
        FaceDiffError: as :func:`read_checkpoint`, or if the model cannot be rebuilt.

    Example:
        >>> model = load_model("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate(speech, identity="F1").vertices.shape  # doctest: +SKIP
        torch.Size([75, 1008, 3])
    """
    return build_model(path, read_checkpoint(path)).to(device)


def read_assets(path: Path | str) -> Assets:
    """The assets alone: templates, faces, frame rate …; no class that the checkpoint names is looked at.

    Raises:
        FaceDiffError: if the file is missing, or no checkpoint of this version of facediff.
    """
    return Assets.from_state(read_file(path)[ASSETS_KEY])


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """Read a checkpoint without running any code from it, and check the classes that it names.

    Raises:
        FaceDiffError: if the file is missing, or no checkpoint of this version of facediff, or names a model or a
            component that is not known.
    """
    checkpoint = read_file(path)
    check_classes(path, checkpoint["hyper_parameters"])
    return checkpoint


def read_file(path: Path | str) -> dict[str, Any]:
    """The plain data and tensors of a checkpoint of facediff's."""
    expected = "expected a .ckpt file that `facediff fit` has written"
    if not Path(path).is_file():
        raise FaceDiffError(f"{path}: no such checkpoint; {expected}")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # Whatever a damaged or hostile file makes the reader raise, the reason is the file.
        raise FaceDiffError(
            f"{path}: not a checkpoint that can be loaded safely (damaged, or more than tensors and plain values); "
            f"{expected}"
        ) from error
    if not isinstance(checkpoint, dict) or not {ASSETS_KEY, "hyper_parameters", "state_dict"} <= checkpoint.keys():
        raise FaceDiffError(
            f"{path}: a checkpoint, but not of facediff: it lacks the templates and sizes that animation needs; "
            f"{expected}"
        )
    if checkpoint.get(FORMAT_KEY) != FORMAT:
        raise FaceDiffError(
            f"{path}: written by another version of facediff, whose checkpoints this one cannot read; train the model "
            f"again with `facediff fit`, or use the version that wrote it"
        )
    return checkpoint


def build_model(path: Path | str, checkpoint: dict[str, Any]) -> AnimationModel:
    """The model of a checkpoint that :func:`read_checkpoint` has read, ready for inference on the CPU.

    Args:
        path: the file, for messages.
        checkpoint: its content.

    Raises:
        FaceDiffError: if a component cannot be made here, or the weights do not fit.
    """
    from lightning.pytorch.cli import instantiate_module

    hparams = {name: value for name, value in checkpoint["hyper_parameters"].items() if name != "_instantiator"}
    try:
        # The model is rebuilt from its own options with the sizes that the checkpoint states; then come the assets,
        # before the weights, since tables of mesh encoders are among these.
        made: AnimationModel = instantiate_module(check_classes(path, hparams), hparams)
        made.on_load_checkpoint(checkpoint)
        made.load_state_dict(checkpoint["state_dict"])
    except FaceDiffError:
        raise
    except (Exception, SystemExit) as error:
        # Lightning, jsonargparse and the components each have their own exceptions for what cannot be rebuilt.
        reason = next(iter(str(error).strip().splitlines()), repr(error))
        raise FaceDiffError(
            f"{path}: cannot be rebuilt as {hparams['_class_path']} ({reason}); install the packages that its "
            f"components come from"
        ) from error
    return made.eval()


def check_classes(path: Path | str, hparams: dict[str, Any]) -> type[AnimationModel]:
    """The model's class; refuse hyper-parameters that name anything but a model and components.

    Whatever class path stands in a checkpoint would be imported and called when the model is rebuilt.

    Raises:
        FaceDiffError: if a class is neither registered nor imported, or stands where none belongs.
    """
    from facediff.models.base import AnimationModel
    from facediff.models.samplers import Sampler

    # Lightning and jsonargparse import and call whatever class path they find. weights_only=True does not prevent that:
    # a path is plain text. So every path must be known before either of them sees the file.
    found: type[AnimationModel] | None = find_class(model, str(hparams.get("_class_path")), AnimationModel)
    if found is None:
        raise unknown_class(path, "model", hparams.get("_class_path"))
    for name, value in hparams.items():
        options = value
        if name in COMPONENTS and isinstance(value, dict):
            base = Sampler if name == "sampler" else torch.nn.Module
            if find_class(COMPONENTS[name], str(value.get("class_path")), base) is None:
                raise unknown_class(path, name, value.get("class_path"))
            options = value.get("init_args", {})
        if names_a_class(options):
            raise FaceDiffError(f"{path}: its option {name} names a class where none belongs; it was not loaded")
    return found


def names_a_class(value: object) -> bool:
    """Whether plain data holds a class path at any depth."""
    if isinstance(value, dict):
        return "class_path" in value or any(names_a_class(item) for item in value.values())
    return isinstance(value, list) and any(names_a_class(item) for item in value)


def corpus_class(path: Path | str, source: Mapping[str, Any]) -> type[SpeechMotionDataModule]:
    """The data module that a model was trained on.

    Args:
        path: the checkpoint, for messages.
        source: the model's :attr:`AnimationModel.data_source`.

    Raises:
        FaceDiffError: if the class is neither registered nor imported.
    """
    from facediff.data import SpeechMotionDataModule

    found: type[SpeechMotionDataModule] | None = find_class(
        corpus, str(source.get("class_path")), SpeechMotionDataModule
    )
    if found is None:
        raise unknown_class(path, "data module", source.get("class_path"))
    return found


def unknown_class(path: Path | str, role: str, named: object) -> FaceDiffError:
    """The error for a class that is neither registered nor imported."""
    return FaceDiffError(
        f'{path}: its {role} is "{named}", which is not known; it was not loaded. If you trust the file, install or '
        f"import the package that the {role} comes from"
    )


def corpus_options(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """The options of the data module that a checkpoint was trained on."""
    options = checkpoint.get("datamodule_hyper_parameters") or {"root": checkpoint[DATA_SOURCE_KEY].get("root")}
    return {name: value for name, value in options.items() if not name.startswith("_")}


def find_class(kind: Kind, path: str, base: type) -> Any:  # noqa: ANN401 - a class that is a subclass of ``base``
    """The class of an import path, if it is registered or its module is imported already; else None.

    Args:
        kind: where it may be registered; its entries are imported first, so that a plug-in is found.
        path: the import path.
        base: what the class must be a subclass of.
    """
    module, _, name = path.rpartition(".")
    if module == f"facediff.registry.{kind.kind}":
        return kind.get(name) if name in kind.names() else None
    kind.load()
    # Not getattr, which may make a lazily loaded package import the module that the file asks for.
    found = vars(sys.modules[module]).get(name) if module in sys.modules else None
    return found if isinstance(found, type) and issubclass(found, base) else None
