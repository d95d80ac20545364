"""One dual-path model for many faces: a trunk that all of them train, and for each face a head of its own.

The audio encoder, the style encoder, fusion and decoder work in the model's width and know nothing of a face. What does
is a head: the motion space with its maps into that width and out of it, the mesh encoder, and the identities. Every
face is therefore a :class:`DualPathDiffusion` with the trunk of the first one.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from facediff.data import Batch, SpeechMotionDataModule
from facediff.errors import ArgumentError
from facediff.models.base import SIZES
from facediff.models.checkpoint import face_content
from facediff.models.checkpoint_content import FACES_KEY
from facediff.models.dual_path.model import DualPathDiffusion
from facediff.registry import model


@model.register("ManyFaces")
class ManyFaces(DualPathDiffusion):
    """A dual-path model of several faces, each with a head of its own, trained together on a corpus for each.

    It is the first face's model, for the data module's own corpus, and :attr:`further_faces` has the models for
    ``data.further_corpora``. Once trained, each is animated, tested and exported like a model of its own, by its name
    after the checkpoint's: ``best.ckpt:mask``.

    Args:
        faces: sizes of the further faces by name, as :attr:`facediff.data.SpeechMotionDataModule.faces` has them; taken
            from the data module on the command line.
        options: of :class:`DualPathDiffusion`, for all faces.

    Attributes:
        further_faces: the models of all faces but the first.
    """

    def __init__(self, *, faces: dict[str, dict[str, Any]] | None = None, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        if self.style_source == "person":
            raise ArgumentError(
                {"style_source": "person"}, "expected reference: further faces keep no speakers' styles"
            )
        shared = {name: value for name, value in options.items() if name not in SIZES}
        # Named as in facediff.models.checkpoint.FACES_PREFIX.
        self.further_faces = nn.ModuleDict(
            {name: DualPathDiffusion(**sizes, **shared) for name, sizes in (faces or {}).items()}
        )
        for _, face in self.heads():
            face.network.share_trunk(self.network)
        self._validated: set[str] = set()

    @classmethod
    def for_data(cls, data: SpeechMotionDataModule, **options: Any) -> Self:  # noqa: ANN401
        """A model with a head for a corpus and for each of its further ones; see :meth:`AnimationModel.for_data`."""
        return super().for_data(data, **{"faces": data.faces, **options})

    def heads(self) -> Iterator[tuple[str, DualPathDiffusion]]:
        """The further faces by name."""
        return cast(Iterator[tuple[str, DualPathDiffusion]], iter(self.further_faces.items()))

    def own_modules(self) -> Iterator[nn.Module]:
        """The modules of the first face."""
        return (module for part in self.children() if part is not self.further_faces for module in part.modules())

    def model_of(self, batch: Batch) -> DualPathDiffusion:
        """The model of the face that a batch is of; itself for the first."""
        return dict(self.heads()).get(batch.face, self)

    def use_corpus(self, data: SpeechMotionDataModule, stage: str) -> None:
        """Let every face take its own corpus."""
        untrained = self.untrained
        super().use_corpus(data, stage)
        if stage not in ("fit", "validate"):
            return  # each face is tested by itself
        for name, face in self.heads():
            face.trainer = self.trainer
            data.further[name].trainer = self.trainer
            face.use_corpus(data.further[name], stage)
            face.data_options = dict(data.further[name].hparams)
            face.licences = self.licences  # the trunk has learnt from everything
            if untrained and stage == "fit":
                face.scale_like(self, data.further[name])

    def on_fit_start(self) -> None:
        """Say for every corpus in which form training motion is wanted."""
        super().on_fit_start()
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if isinstance(data, SpeechMotionDataModule):
            for name, face in self.heads():
                data.further[name].projection.choose(face.training_projection())

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The losses of the batch's own face."""
        face = self.model_of(batch)
        return super().losses(batch, generator) if face is self else face.losses(batch, generator)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss and metrics of the batch's own face."""
        self._validated.add(batch.face)
        super().validation_step(batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of each further face as ``val/NAME/mve`` …, and the mean over all faces as ``val/mve`` …."""
        scores = []
        for name in sorted(self._validated):  # a rehearsal of two batches sees two faces at most
            scores.append(dict(self.heads()).get(name, self).evaluation.scalars("val"))
            metrics = {f"val/{name}/{key.removeprefix('val/')}": value for key, value in scores[-1].items() if name}
            self.log_dict(metrics, sync_dist=True)
        self._validated.clear()
        shared = [key for key in scores[0] if all(key in one for one in scores)] if scores else []
        means = {key: mean_over_faces([float(one[key]) for one in scores]) for key in shared}
        self.log_dict({**self.validation_terms(), **means}, prog_bar=False, sync_dist=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the content of the further faces' models."""
        super().on_save_checkpoint(checkpoint)
        faces: dict[str, dict[str, Any]] = {}
        for name, face in self.heads():
            content: dict[str, Any] = {"hyper_parameters": dict(face.hparams)}
            face.on_save_checkpoint(content)
            content["datamodule_hyper_parameters"] = face.data_options
            faces[name] = content
        checkpoint[FACES_KEY] = faces

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Let the further faces take theirs."""
        super().on_load_checkpoint(checkpoint)
        for name, face in self.heads():
            face.on_load_checkpoint(face_content(checkpoint, name, "the checkpoint"))


def mean_over_faces(scores: list[float]) -> float:
    """The geometric mean of errors, which may have units of their own; the mean where a score is not above zero."""
    return statistics.geometric_mean(scores) if min(scores) > 0 else statistics.fmean(scores)
