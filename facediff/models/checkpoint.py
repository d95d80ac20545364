"""The one door into a checkpoint: how an untrusted file becomes a model, its assets and its corpus.

A model folder (:mod:`facediff.models.pretrained`), also of the Hugging Face hub, is read into the same content as a
checkpoint, and goes the same way from there on.

Every command and every method that loads a checkpoint comes through here, before
Lightning or jsonargparse see any of it. In this order, and before anything is imported or allocated because the file
asks for it:

1. The archive's directory and the sizes of all tensors agree and stay within the budget
   (:mod:`facediff.utils.torch_files`); the content is tensors and plain data (``weights_only=True``).
2. The model, its components and the data module are classes that are registered, or imported already.
3. Their options are plain values of the types that the constructors ask for
   (:mod:`facediff.hyperparameters`): nothing that could be imported, opened as a config, fetched from another
   machine or resolved as ``${…}``.
4. The assets are what :meth:`Assets.from_state` accepts.
5. The model is built within a budget that follows from its weights, and the weights fit it.

What a checkpoint may make facediff read are the folders of the corpus that it was trained on, when it is scored on that
corpus or adapted; see SECURITY.md.
"""

from __future__ import annotations

import io
import os
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import torch
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_parameter_registration_hook,
)

from facediff.data import SpeechMotionDataModule
from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY, FORMAT, FORMAT_KEY, Assets
from facediff.errors import FaceDiffError, choices
from facediff.hyperparameters import Components, read_options, unknown_class
from facediff.models.checkpoint_content import FACES_KEY, CheckpointContent
from facediff.models.earlier_versions import without_removed_options
from facediff.models.pretrained import read_model
from facediff.registry import COMPONENTS, corpus, find_class, model
from facediff.spaces import Space
from facediff.utils.hints import is_name, is_plain_text
from facediff.utils.hub import model_path, split_face
from facediff.utils.licences import require_cleared
from facediff.utils.limits import quoted
from facediff.utils.torch_files import EXPECTED, load_tensors, open_checkpoint

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel


INSTANTIATOR = "lightning.pytorch.cli.instantiate_module"
"""What Lightning imports and calls to rebuild a module; no checkpoint of facediff's names anything else."""


SPARE_NUMBERS, SPARE_TENSORS = 2**25, 1000
"""What a model may register in addition to four times its weights."""


FACES_PREFIX = "further_faces."
"""What the names of these faces' weights begin with, in front of the face's name."""


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
    with open_content(path) as (checkpoint, name):
        pass
    model_of(name, checkpoint["hyper_parameters"])
    assets = assets_of(name, checkpoint)
    if checkpoint["hyper_parameters"].get("identities") != assets.identities:
        raise FaceDiffError(f"{name}: its model and its assets do not have the same identities; {EXPECTED}")
    return checkpoint


def build_model(path: Path | str, checkpoint: dict[str, Any]) -> AnimationModel:
    """The model of a checkpoint that :func:`read_checkpoint` has read, ready for inference on the CPU.

    Args:
        path: the file, for messages.
        checkpoint: its content.

    Raises:
        FaceDiffError: if a component cannot be built here, or the weights do not fit.
    """
    weights = checkpoint["state_dict"]
    # The model is rebuilt from its own options with the sizes that the checkpoint states; then come the assets,
    # before the weights, since tables of mesh encoders are among these.
    implementation, arguments = model_of(path, checkpoint["hyper_parameters"])
    try:
        with warnings.catch_warnings(), weight_budget(path, weights.values()):
            warnings.simplefilter("ignore")  # of sizes that are 0, for example
            built = implementation(**arguments)
        built.on_load_checkpoint(checkpoint)
        check_weights(path, weights, built.state_dict())
        try:
            built.load_state_dict(weights)
        except RuntimeError as error:
            raise FaceDiffError(f"{path}: {misfit(weights, built.state_dict())}") from error
        check_styles(built)
    except FaceDiffError as error:
        raise FaceDiffError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    except Exception as error:
        # Components have their own exceptions for what cannot be rebuilt, and PyTorch lists every weight.
        lines = str(error).strip().splitlines() or [repr(error)]
        reason = " ".join(" ".join(lines[:2]).split())[:200]
        raise FaceDiffError(
            f"{path}: cannot be rebuilt as {implementation.__name__} ({reason}); install the packages that its "
            f"components come from, in the versions that wrote it"
        ) from error
    for name, value in built.state_dict().items():  # buffers such as means of motion as well
        if not value.isfinite().all():
            raise FaceDiffError(
                f"{path}: its weights {name} hold NaN or infinity, so the training has diverged; use an earlier "
                f"checkpoint, or train again with a lower learning rate"
            )
    return built.eval()


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
    build_model(str(path), content)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    buffer.seek(0)
    yield buffer


@contextmanager
def open_content(
    path: str | os.PathLike[str] | IO[bytes], *, weights: bool = True
) -> Iterator[tuple[dict[str, Any], str]]:
    """The content of a checkpoint or of a model folder, of which only the outer form is checked, and its name.

    Args:
        path: a checkpoint, which may be open; a model folder; a name of the Hugging Face hub; or one face of any of
            them, as :func:`facediff.utils.hub.split_face` reads it.
        weights: whether to read the weights of a model folder too.

    Raises:
        FaceDiffError: if there is none, or it is damaged.
    """
    face = None
    if isinstance(path, str | os.PathLike):
        path, face = split_face(path)
        if (folder := model_path(path)).is_dir():
            content = read_model(folder, weights=weights or face is not None)
            check_content(content, path)
            yield content if face is None else face_content(content, face, path), str(path)
            return
    with open_checkpoint(path) as (stream, name):
        content = read_file(stream, name)
        yield content if face is None else face_content(content, face, path), name


def face_content(checkpoint: dict[str, Any], face: str, path: object) -> dict[str, Any]:
    """The content of a checkpoint of many faces as that of one face's own model, without anything of its training.

    Args:
        checkpoint: of many faces.
        face: the name of one that is not the first.
        path: the file, for messages.

    Raises:
        FaceDiffError: if there is no such face, or it is damaged.
    """
    faces = checkpoint.get(FACES_KEY)
    if not isinstance(faces, dict) or face not in faces or not isinstance(faces[face], dict):
        names = [str(name)[:100] for name in faces] if isinstance(faces, dict) else []
        known = choices(face, names) if names else "it is a model of one face; omit the name"
        raise FaceDiffError(f"{path}: has no further face {quoted(face)}: {known}")
    prefix = f"{FACES_PREFIX}{face}."
    weights = {key.removeprefix(prefix): own for key, own in checkpoint["state_dict"].items() if key.startswith(prefix)}
    counted = (FORMAT_KEY, "pytorch-lightning_version", "epoch", "global_step")
    shared = {name: checkpoint[name] for name in counted if name in checkpoint}
    content: dict[str, Any] = {**shared, **faces[face], "state_dict": weights}
    check_content(content, path)
    return content


def read_file(stream: IO[bytes], path: Path | str) -> dict[str, Any]:
    """The plain data and tensors of a checkpoint of facediff's; only its outer form is checked."""
    checkpoint = load_tensors(stream, path)
    check_content(checkpoint, path)
    return checkpoint


def check_content(checkpoint: Any, path: object) -> None:  # noqa: ANN401 - whatever a file holds
    """Refuse a content that has not the outer form of a checkpoint of facediff's, and drop options of 1.x in place.

    Raises:
        FaceDiffError: naming the file and the part.
    """
    if not isinstance(checkpoint, dict) or not {ASSETS_KEY, "hyper_parameters", "state_dict"} <= checkpoint.keys():
        raise FaceDiffError(
            f"{path}: a checkpoint, but not of facediff: it lacks the templates and sizes that animation needs; "
            f"{EXPECTED}"
        )
    version = checkpoint.get(FORMAT_KEY)
    if type(version) is not int or version != FORMAT:
        raise FaceDiffError(
            f"{path}: written by another version of facediff, whose checkpoints this one cannot read; train the model "
            f"again with `facediff fit`, or use the version that wrote it"
        )
    for key in ("hyper_parameters", "state_dict", ASSETS_KEY, DATA_SOURCE_KEY, "datamodule_hyper_parameters"):
        value = checkpoint.get(key)
        if not (isinstance(value, dict) and all(isinstance(name, str) for name in value)) and (
            value is not None or key in ("hyper_parameters", "state_dict", ASSETS_KEY)
        ):
            raise FaceDiffError(f"{path}: its {key} is {quoted(value)}; expected values by name. The file is damaged")
    for name, value in (checkpoint.get(DATA_SOURCE_KEY) or {}).items():
        if not isinstance(value, str) or not is_plain_text(value):
            raise FaceDiffError(
                f"{path}: its corpus has the {quoted(name)} {quoted(value)}; expected a path. {EXPECTED}"
            )
    for name, value in checkpoint["state_dict"].items():
        if not isinstance(value, torch.Tensor):
            raise FaceDiffError(f"{path}: its weight {quoted(name)} is {quoted(value)}; expected a tensor")
    checkpoint["hyper_parameters"] = without_removed_options(checkpoint["hyper_parameters"], path)


def assets_of(path: Path | str, checkpoint: Mapping[str, Any]) -> Assets:
    """The assets of a checkpoint's content.

    Raises:
        FaceDiffError: naming the file and what is wrong with them.
    """
    try:
        return Assets.from_state(checkpoint[ASSETS_KEY])
    except FaceDiffError as error:
        raise FaceDiffError(f"{path}: {error}") from error


def model_of(path: Path | str, hparams: Mapping[str, Any]) -> tuple[type[AnimationModel], dict[str, Any]]:
    """The model's class and its constructor's arguments.

    Raises:
        FaceDiffError: if the hyper-parameters name anything but a model, components and plain values.
    """
    named = hparams.get("_class_path")
    # Every model is an AnimationModel, whose file imports this one; of what it extends, nothing else has its arguments.
    implementation = cast("type[AnimationModel] | None", find_class(model, named, CheckpointContent))
    if implementation is None:
        raise unknown_class(path, "model", named)
    if hparams.get("_instantiator", INSTANTIATOR) != INSTANTIATOR:
        raise FaceDiffError(
            f"{path}: it names {quoted(hparams['_instantiator'])} to rebuild it; expected {INSTANTIATOR}"
        )
    identities = hparams.get("identities")
    if not isinstance(identities, list) or not all(map(is_name, identities)):
        raise FaceDiffError(f"{path}: its identities are {quoted(identities)}; expected names without path separators")
    space = hparams.get("space")
    if space is not None:
        try:
            Space.from_state(space)
        except FaceDiffError as error:
            raise FaceDiffError(f"{path}: {error}. The file is damaged") from error
    kept = ("_class_path", "_instantiator", "identities", "space", "faces")
    arguments = read_options(
        str(path),
        implementation,
        {name: value for name, value in hparams.items() if name not in kept},
        component_finders(),
    )
    for name in ("n_vertices", "frame_rate"):
        if not arguments.get(name, 0) > 0:
            raise FaceDiffError(f"{path}: its {name} is {quoted(hparams.get(name))}; expected a number above zero")
    sizes = {} if "faces" not in hparams else {"faces": sizes_of_faces(path, hparams["faces"])}
    return implementation, {**arguments, "identities": list(identities), "space": space, **sizes}


def sizes_of_faces(path: Path | str, faces: object) -> dict[str, dict[str, Any]]:
    """The sizes of further faces, as :attr:`facediff.data.SpeechMotionDataModule.faces` gives them, after checks.

    Raises:
        FaceDiffError: if they are anything else. Numbers are left to the constructor, which knows their ranges.
    """
    error = FaceDiffError(f"{path}: its faces are {quoted(faces)}; expected sizes by name. The file is damaged")
    if not isinstance(faces, dict) or not all(map(is_name, faces)):
        raise error
    for sizes in faces.values():
        if not isinstance(sizes, dict) or sizes.keys() != {"n_vertices", "identities", "frame_rate", "space"}:
            raise error
        names = sizes["identities"]
        if not isinstance(names, list) or not all(map(is_name, names)):
            raise error
        if not isinstance(sizes["n_vertices"], int) or not isinstance(sizes["frame_rate"], int | float):
            raise error
        if sizes["space"] is not None:
            Space.from_state(sizes["space"])
    return faces


@contextmanager
def weight_budget(path: Path | str, weights: Iterable[torch.Tensor]) -> Iterator[None]:
    """Within it, this thread can build no model that is much larger than the weights that belong to it.

    A model of 10⁶ layers, or of 10⁹ channels, is one number in a file. The weights in the same file say how large the
    model can be.

    Raises:
        FaceDiffError: naming the file, as soon as a parameter or a buffer is too much.
    """
    kept, thread = list(weights), threading.get_ident()
    # Generously more than the weights: a constructor may make parts that it replaces, and buffers that are not saved.
    numbers, tensors = 4 * sum(weight.numel() for weight in kept) + SPARE_NUMBERS, 4 * len(kept) + SPARE_TENSORS

    def spend(module: torch.nn.Module, name: str, value: torch.Tensor | None) -> None:
        nonlocal numbers, tensors
        if value is None or threading.get_ident() != thread:
            return
        numbers, tensors = numbers - value.numel(), tensors - 1
        if numbers < 0 or tensors < 0:
            raise FaceDiffError(
                f"{path}: its options ask for a model that is much larger than its weights; the file is damaged"
            )

    # PyTorch's layers register their weights before they fill them, so that the memory has not been touched yet.
    hooks = register_module_parameter_registration_hook(spend), register_module_buffer_registration_hook(spend)
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def check_weights(path: Path | str, weights: Mapping[str, torch.Tensor], own: Mapping[str, Any]) -> None:
    """Refuse weights whose numbers are of another sort than the model's: copying would change them in silence.

    Raises:
        FaceDiffError: naming the weights.
    """
    for name, value in weights.items():
        mine = own.get(name)
        if isinstance(mine, torch.Tensor) and mine.is_floating_point() != value.is_floating_point():
            raise FaceDiffError(
                f"{path}: its weights {quoted(name)} are of the type {value.dtype}, and {mine.dtype} in the model; the "
                f"file is damaged"
            )


def check_styles(built: AnimationModel) -> None:
    """Refuse styles of speakers that are not as long as those of the model, of which one number would fill all.

    Raises:
        FaceDiffError: saying both lengths.
    """
    lengths = {len(style.vector) for style in built.person_styles.values()}
    if not lengths:
        return
    still = torch.zeros(1, 1, built.n_vertices, built.dims)
    with torch.inference_mode():
        width = built.eval().encode_style(still, torch.ones(1, 1, dtype=torch.bool)).shape[-1]
    if lengths != {width}:
        raise FaceDiffError(
            f"its styles of speakers have {min(lengths)} numbers, those of its model {width}; the file is damaged"
        )


def misfit(weights: Mapping[str, torch.Tensor], own: Mapping[str, Any]) -> str:
    """What is wrong with weights that do not fit a model, in a sentence."""
    missing, extra = sorted(own.keys() - weights.keys()), sorted(weights.keys() - own.keys())
    other = sorted(name for name in own.keys() & weights.keys() if own[name].shape != weights[name].shape)
    difference = "they do not fit"
    for names, what in ((missing, "are missing"), (extra, "are too many"), (other, "are of another shape")):
        if names:
            shapes = f" {tuple(weights[names[0]].shape)} in place of {tuple(own[names[0]].shape)}" * (names is other)
            difference = f"{len(names)} {what}, the first is {quoted(names[0])}{shapes}"
            break
    return f"its weights are not those of its model ({difference}); the file is damaged, or its options were changed"


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
