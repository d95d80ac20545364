"""Speakers' styles from all of their motion, in place of one reference clip (``style_source=person``)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff.data import Batch, Reference, SpeechMotionDataModule
from facediff.data.batch import pad
from facediff.models.checkpoint_content import CheckpointContent
from facediff.models.inference import Style
from facediff.models.layers import frame_mask


class PersonStyles(CheckpointContent):
    """The part of a model that encodes its speakers before validation, test and prediction, and when it is saved."""

    def __init__(self) -> None:
        super().__init__()
        self._styles_of_step: int | None = None  # the step whose weights gave the vectors

    @abstractmethod
    def encode_style(
        self, reference: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions, as :meth:`facediff.models.AnimationModel.encode_style`."""

    @abstractmethod
    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else those of its references."""

    def default_style(self, identity: str) -> Reference | Style:
        """The style of all of an identity's motion if the model keeps it, else its stored reference.

        Raises:
            FaceDiffError: if it has neither.
        """
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
        for clip, own in enumerate(styles):
            if own is not None:
                style[clip], names[clip] = own.vector.to(style), own.name
        return replace(batch, style=style, reference_names=names)

    def on_validation_epoch_start(self) -> None:
        """Encode the speakers with the weights that are validated; weight averaging has put its own in."""
        self.encode_people()

    def on_test_epoch_start(self) -> None:
        """Encode the speakers that are tested."""
        self.encode_people()

    def on_predict_epoch_start(self) -> None:
        """Encode the speakers that are predicted."""
        self.encode_people()

    def encode_people(self, weights: Mapping[str, Tensor] | None = None) -> None:
        """Encode every speaker's style from all of their motion, if ``style_source`` is ``person``.

        The motion is cut into stretches as long as a style reference; a speaker's style is the mean of the stretches'
        vectors, weighted by their frames. Clips of the evaluated splits are never among them.

        Args:
            weights: the weights to encode with, by the names of the state dict; the present ones if None.
        """
        step = int(self.trainer.global_step)
        if self.style_source != "person" or self._styles_of_step == step:
            return
        data: SpeechMotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        # functional_call swaps the weights in for the call alone: the model that is training is not touched.
        encoder = StyleEncoding(self)
        named = {f"model.{name}": value for name, value in (weights or {}).items()}
        # Each module's own mode is restored and not train() called, which would wake up frozen parts in evaluation
        # mode.
        modes = [(module, module.training) for module in self.modules()]
        self.eval()
        styles: dict[str, Style] = {}
        with torch.no_grad():
            for name, clips in data.known_clips().items():
                total, frames = torch.zeros(()), 0
                for clip in clips if name in data.corpus.templates else []:
                    parts = torch.split(data.corpus.read_motion(clip).to(self.device), data.reference_frames)
                    lengths = torch.tensor([len(part) for part in parts], device=self.device)
                    mask = frame_mask(lengths, int(lengths.max()))
                    vectors = torch.func.functional_call(encoder, named, (pad(parts), mask)).float()
                    total, frames = total + (vectors * lengths[:, None]).sum(0).cpu(), frames + int(lengths.sum())
                if frames and total.numel():
                    styles[name] = Style(f"all motion of {name} ({len(clips)} clips)", total / frames)
        for module, mode in modes:
            module.training = mode
        self.person_styles, self._styles_of_step = styles, step


class StyleEncoding(nn.Module):
    """A model's style encoder as a module, so that it can be called with other weights than the model has.

    Args:
        model: the model.
    """

    def __init__(self, model: PersonStyles) -> None:
        super().__init__()
        self.model = model

    def forward(self, reference: Tensor, mask: Tensor) -> Tensor:
        """Style vectors, as :meth:`PersonStyles.encode_style` gives them."""
        return self.model.encode_style(reference, mask)
