"""Contents of a checkpoint in addition to the weights: assets of the corpus, licences, provenance, speakers' styles.

:class:`CheckpointContent` is the part of a model that writes and reads it, and encodes the speakers from all of their
motion, in place of one reference clip (``style_source=person``). How an untrusted file is read stands in
:mod:`facediff.models.checkpoint`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from facediff.data import Assets, Batch, Reference, SpeechMotionDataModule
from facediff.data.batch import ASSETS_KEY, DATA_SOURCE_KEY, FORMAT, FORMAT_KEY, pad
from facediff.errors import FaceDiffError, OptionError, counted
from facediff.hyperparameters import component_class, describe, plain
from facediff.models.inference import Inference, Style
from facediff.models.layers import evaluating, frame_mask
from facediff.registry import COMPONENTS
from facediff.spaces import Space
from facediff.speech.voice_activity import OFF, USUAL_GATE
from facediff.utils.hints import defaults, is_name
from facediff.utils.licences import LICENCES_KEY, Licence, merged, read_licences
from facediff.utils.limits import quoted

PROVENANCE_KEY = "facediff_provenance"
"""Key of a checkpoint's provenance, texts by name: ``parent``, ``epochs``, ``steps``, ``version``."""

COUNTED = {"epochs": "epoch", "steps": "global_step"}
"""Entries of the provenance that a checkpoint of training counts itself, and their keys."""

IMPORTED = "imported"
"""In the provenance: the method from which the authors' weights were imported."""

STYLES_KEY = "facediff_styles"
"""Where a checkpoint keeps the speakers' style vectors, if they are of all their motion."""

FACES_KEY = "facediff_faces"
"""Key of a many-faced model's further faces, each with the content that the face's own model would keep."""

StyleSource = Literal["reference", "person"]
MotionScale = Literal["unit", "none"]


class CheckpointContent(LightningModule, Inference):
    """The part of a model that a checkpoint keeps besides its weights."""

    n_vertices: int
    space: Space
    identities: list[str]
    motion_scaling: MotionScale
    style_source: StyleSource

    def __init__(self) -> None:
        super().__init__()
        self.data_source: dict[str, str] = {}
        self.data_options: dict[str, Any] = {}
        self.licences: tuple[Licence, ...] = ()
        self.provenance: dict[str, str] = {}
        self.person_styles: dict[str, Style] = {}
        self._assets: Assets | None = None
        self._styles_of_step: int | None = None  # the step whose weights gave the vectors

    @property
    def dims(self) -> int:
        """Numbers that each point of the motion has."""
        return self.space.dims

    @property
    def assets(self) -> Assets:
        """Templates, faces, regions, references and scale of the training corpus."""
        if self._assets is None:
            raise FaceDiffError("the model has no templates yet; train it with a data module or load a checkpoint")
        return self._assets

    @property
    def untrained(self) -> bool:
        """Whether no training has begun; the assets of a model that was validated or tested alone have no scale."""
        measured = self._assets is not None and self._assets.motion_scale is not None
        return not measured and IMPORTED not in self.provenance

    @property
    def scale(self) -> float:
        """Factor from offsets in the corpus's unit to the motion that the networks see."""
        if self.motion_scaling == "none":
            return 1.0
        if self.assets.motion_scale is None:
            raise OptionError.naming("the model has never been trained: give a checkpoint (--ckpt_path, {checkpoint})")
        return self.assets.motion_scale

    @property
    def usual_gate(self) -> Literal["energy", "off"]:
        """The voice gate of animations that choose none: an imported model gives its authors' motion, in pauses too."""
        return OFF if IMPORTED in self.provenance else USUAL_GATE

    def adopt(self, assets: Assets) -> None:
        """Take over a corpus's assets after checking that they fit the model's sizes."""
        sizes = {template.shape[0] for template in assets.templates.values()}
        for what, mine, stored in (
            ("kinds of space", self.space.kind, assets.space.kind),
            ("vertices" if self.space.is_vertices else "channels", {self.n_vertices}, sizes),
            ("spaces", self.space, assets.space),
            ("identities", self.identities, assets.identities),
            ("frames a second", self.frame_rate, assets.frame_rate),
            ("units", assets.unit if self._assets is None else self._assets.unit, assets.unit),
        ):
            if mine != stored:
                raise FaceDiffError(
                    f"the model and the corpus {assets.corpus} do not fit: {what} are {mine} in the model and {stored} "
                    f"in the corpus; use a checkpoint that was trained on this topology and these identities"
                )
        self._assets = assets
        self.make_parts(assets)

    def make_parts(self, assets: Assets) -> None:
        """Make modules that take their size from the corpus; the base class has none.

        Called by :meth:`adopt` (possibly more than once) and when a model is cloned for training.
        """

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the constructor's arguments as plain data, in the form that Lightning rebuilds a module from."""
        options = {**defaults(type(self)), **arguments, "space": None if self.space.is_vertices else self.space.state()}
        for kind in COMPONENTS.keys() & options.keys():
            modules = [m for m in self.modules() if isinstance(m, component_class(options[kind]))]
            options[kind] = describe(options[kind], modules[0] if modules else None)
        self.save_hyperparameters(
            {
                "_class_path": f"{type(self).__module__}.{type(self).__qualname__}",
                "_instantiator": "lightning.pytorch.cli.instantiate_module",
                **plain(options),
            }
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the assets, so that the checkpoint animates without the corpus."""
        # Plain data and tensors only: a checkpoint is read with weights_only=True, where a class would be refused.
        checkpoint[FORMAT_KEY] = FORMAT
        checkpoint[ASSETS_KEY] = self.assets.state()
        checkpoint[DATA_SOURCE_KEY] = self.data_source
        checkpoint[LICENCES_KEY] = [licence.state() for licence in self.licences]
        if self._trainer is not None:  # a run that goes on from a checkpoint counts its own
            provenance = {name: text for name, text in self.provenance.items() if name not in COUNTED}
        else:
            provenance = dict(self.provenance)
        if provenance:
            checkpoint[PROVENANCE_KEY] = provenance
        if self.style_source == "person":
            # By the weights that are saved: weight averaging has replaced the present ones in the checkpoint by now.
            if self._trainer is not None and isinstance(self.trainer.datamodule, SpeechMotionDataModule):  # type: ignore[attr-defined]
                self.encode_people(checkpoint["state_dict"])
            checkpoint[STYLES_KEY] = {name: (style.name, style.vector) for name, style in self.person_styles.items()}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the assets from the checkpoint."""
        if ASSETS_KEY in checkpoint:
            # Before the weights are loaded: it makes the modules that take their size from the corpus.
            self.adopt(Assets.from_state(checkpoint[ASSETS_KEY]))
            check_weights("the checkpoint", checkpoint.get("state_dict", {}), self.state_dict())
            self.data_source = checkpoint.get(DATA_SOURCE_KEY) or {}
            self.licences = merged(self.licences, read_licences("its labels", checkpoint.get(LICENCES_KEY, [])))
            self.provenance = read_provenance(checkpoint)
            self.data_options = dict(checkpoint.get("datamodule_hyper_parameters") or {})
            self.person_styles = read_person_styles(checkpoint.get(STYLES_KEY, {}))

    # The speakers' styles, of all their motion.

    @abstractmethod
    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else its references' vectors."""

    def default_style(self, identity: str) -> Reference | Style:
        """The style of all of an identity's motion if the model keeps it, else its stored reference."""
        return self.person_styles.get(identity) or super().default_style(identity)

    def styled_identities(self) -> list[str]:
        """The identities that have a style of their own to be conditioned on."""
        return [*{**self.assets.references, **self.person_styles}]

    def with_person_styles(self, batch: Batch) -> Batch:
        """The batch with the style of all motion of each clip's speaker, where the model uses it and knows it."""
        styles = [self.person_styles.get(name) for name in batch.identity_names]
        if not any(styles) or batch.style is not None:
            return batch
        with torch.no_grad():
            style = self.style_of(batch).clone()
        names = list(batch.reference_names)
        for clip, clip_style in enumerate(styles):
            if clip_style is not None:
                style[clip], names[clip] = clip_style.vector.to(style), clip_style.name
        return replace(batch, style=style, reference_names=names)

    def on_validation_epoch_start(self) -> None:
        """Encode the speakers with the weights that are used now; weight averaging has put its own in."""
        self.encode_people()

    on_test_epoch_start = on_predict_epoch_start = on_validation_epoch_start

    def encode_people(self, weights: Mapping[str, Tensor] | None = None) -> None:
        """Encode every speaker's style from all of their motion, if ``style_source`` is ``person``.

        The motion is cut into stretches as long as a style reference; a speaker's style is the mean of the stretches'
        vectors, weighted by their frames. Clips of the evaluated splits are never among them.
        """
        step = int(self.trainer.global_step)
        if self.style_source != "person" or self._styles_of_step == step:
            return
        data: SpeechMotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        # functional_call swaps the weights in for the call alone: the model that is training is not touched.
        encoder = StyleEncoding(self)
        prefixed = {f"model.{name}": value for name, value in (weights or {}).items()}
        styles: dict[str, Style] = {}
        with torch.no_grad(), evaluating(self):
            for name, clips in data.known_clips().items():
                total, frames = torch.zeros(()), 0
                for clip in clips if name in data.corpus.templates else []:
                    parts = torch.split(data.corpus.read_motion(clip).to(self.device), data.reference_frames)
                    lengths = torch.tensor([len(part) for part in parts], device=self.device)
                    mask = frame_mask(lengths, int(lengths.max()))
                    vectors = torch.func.functional_call(encoder, prefixed, (pad(parts), mask)).float()
                    total, frames = total + (vectors * lengths[:, None]).sum(0).cpu(), frames + int(lengths.sum())
                if frames and total.numel():
                    styles[name] = Style(f"all motion of {name} ({counted(len(clips), 'clip')})", total / frames)
        self.person_styles, self._styles_of_step = styles, step


def check_weights(source: object, weights: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Refuse NaN and infinity, and weights of another kind of number, which copying would convert without a word."""
    for name, value in weights.items():
        converts = name in expected and expected[name].is_floating_point() != value.is_floating_point()
        if converts or not value.isfinite().all():
            problem = "hold NaN or infinity, so the training has diverged; use an earlier checkpoint, or train again"
            if converts:
                problem = f"are of the type {value.dtype}, and {expected[name].dtype} in the model; the file is damaged"
            raise FaceDiffError(f"{source}: its weights {quoted(name)} {problem}")


def read_provenance(checkpoint: Mapping[str, Any]) -> dict[str, str]:
    """A checkpoint's provenance; the epochs and steps of one that says nothing else."""
    counters = {name: checkpoint.get(key) for name, key in COUNTED.items()}
    return {
        **checkpoint.get(PROVENANCE_KEY, {}),
        **{name: str(count) for name, count in counters.items() if isinstance(count, int)},
    }


def read_person_styles(state: Mapping[str, tuple[str, Tensor]]) -> dict[str, Style]:
    """The styles of all motion of each speaker, from a checkpoint."""
    for name, (_, vector) in state.items():
        if not is_name(name) or vector.ndim != 1 or not bool(vector.isfinite().all()):
            raise FaceDiffError(f"its style of {quoted(name)} is {quoted(vector)}; expected a name and a finite vector")
    return {name: Style(text, vector.float()) for name, (text, vector) in state.items()}


class StyleEncoding(nn.Module):
    """A model's style encoder as a module, so that it can be called with other weights than the model has."""

    def __init__(self, model: CheckpointContent) -> None:
        super().__init__()
        self.model = model

    def forward(self, reference: Tensor, mask: Tensor) -> Tensor:
        """Style vectors, as :meth:`CheckpointContent.encode_style` gives them."""
        return self.model.encode_style(reference, mask)
