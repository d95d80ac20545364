"""A folder of ``facediff export-model`` with the interface of a trained model, so that the same code can score it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facediff.data import Batch
from facediff.data.batch import Assets, Reference
from facediff.errors import counted
from facediff.models.base import AnimationModel
from facediff.models.inference import Expressivity, Style
from facediff.runtime.model import RuntimeModel, RuntimeStream
from facediff.runtime.sampling import RuntimeChoices, RuntimeConditions
from facediff.runtime.styles import style_from
from facediff.speech.windows import WindowPlan


class ExportedModel(AnimationModel):
    """Motion by the folder's graphs, with the noise that PyTorch would draw for a clip."""

    runtime: RuntimeModel
    sampler: str

    @classmethod
    def open(cls, folder: Path, assets: Assets, *, commercial_only: bool = False) -> ExportedModel:
        """Read a folder for the clips of a corpus, whose speakers need not be those of the training."""
        runtime = RuntimeModel.open(folder)
        if commercial_only:
            runtime.description.require_commercial_use()
        return cls.of(runtime, assets)

    @classmethod
    def of(cls, runtime: RuntimeModel, assets: Assets) -> ExportedModel:
        """The same of an opened folder."""
        about = runtime.description
        points = (runtime.arrays["templates"] if about.motion_space.is_vertices else runtime.arrays["resting"]).shape[1]
        model = cls(
            n_vertices=points, identities=assets.identities, frame_rate=about.frame_rate, space=about.motion_space
        )
        model.runtime = runtime
        model.expressivity = about.usual_expressivity
        model.samples = about.generation == "sampled"  # type: ignore[misc]  # of each folder
        model.sampler = f"{about.sampler} with {counted(len(runtime.loop), 'step')}"
        model.windows = WindowPlan(above=math.inf)  # the folder's own plan cuts speech
        model.adopt(assets)
        return model.eval()

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Graphs cannot be trained."""
        raise NotImplementedError

    def choose_low_latency(self) -> None:
        """Animate frame by frame from now on."""
        self.runtime.choose_low_latency()

    def choose_expressivity(self, factor: Expressivity) -> None:
        """Go from the mean prediction (0) to a full sample (1) or beyond."""
        if self.runtime.description.last_step < 0:
            super().choose_expressivity(factor)  # refuses all but 1
        self.expressivity = factor

    def default_style(self, identity: str) -> Reference | Style:
        """The folder's style of an identity."""
        about = self.runtime.description
        if about.style_source != "reference" or identity not in about.styles:
            return super().default_style(identity)
        return Style(identity, torch.from_numpy(style_from(identity, self.runtime, identity).vector))

    def encode_style(self, reference: Tensor, mask: Tensor) -> Tensor:
        """Style vectors of reference motions by the folder's graph."""
        if "style" not in self.runtime.description.graphs:
            return super().encode_style(reference, mask)
        clips = [motion[valid].numpy() for motion, valid in zip(reference, mask, strict=True)]
        return torch.from_numpy(np.stack([self.runtime.encode_style(clip).vector for clip in clips]))

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Any = None) -> Tensor:  # noqa: ANN401, ARG002
        """Offsets (B, T, points, dims) from the batch's templates."""
        motion = torch.zeros_like(batch.motion)
        styles = self.style_of(batch).numpy()
        trained = self.runtime.description.identities
        for clip, (name, identity) in enumerate(zip(batch.names, batch.identity.tolist(), strict=True)):
            known = self.identities[identity] if identity >= 0 else ""
            conditions = RuntimeConditions(
                identity=trained.index(known) if known in trained else -1,
                style=styles[clip],
                style_name=batch.reference_names[clip],
                template=batch.template[clip].numpy(),
                choices=RuntimeChoices(seed=seed, expressivity=float(self.expressivity)),
                clip=name,
            )
            stream = RuntimeStream(self.runtime, 0, conditions, self.runtime.windows)
            speech = batch.audio[clip, : int(batch.audio_lengths[clip])].numpy()
            frames = int(batch.frame_lengths[clip])
            points = np.concatenate(list(self.runtime.parts(speech, stream, frames=frames)))
            motion[clip, :frames] = torch.from_numpy(points) - batch.template[clip]
        return motion

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Any = None) -> Tensor:  # noqa: ANN401, ARG002
        """Samples (seeds, T, points, dims) of one clip of any length."""
        return torch.cat([self.generate_clips(clip, seed=seed) for seed in seeds])
