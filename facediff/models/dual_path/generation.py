"""Sampling of a dual-path model for clips, for several seeds, for windows of long speech, and towards the mean."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.data import Batch
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.network import ConditionalDenoiser
from facediff.models.dual_path.recipe import DualPathRecipe
from facediff.models.folding import Blend, unchanged
from facediff.models.inference import ClipNoise, Progress, WindowNoise, WindowOverlap
from facediff.models.samplers import NoiseSource
from facediff.speech.windows import MotionWindow


class Generation(DualPathRecipe):
    """Calls :meth:`sample` for clips, samples and windows, each with its own noise."""

    @abstractmethod
    def sample(
        self,
        conditions: Conditions,
        unit: NoiseSource,
        *,
        blend: Blend = unchanged,
        frames: slice = slice(None),  # noqa: B008 - it cannot be changed
        progress: Progress | None = None,
    ) -> Float[Tensor, "batch frames points dims"]:
        """Algorithm 2."""

    @torch.no_grad()
    def generate_clips(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames points dims"]:
        """Algorithm 2 for clips. A clip's noise follows from the seed and its name, not from the rest of the batch."""
        lengths = batch.frame_lengths.tolist()
        unit = ClipNoise(batch.names, lengths, [seed] * len(batch), self.device)
        unit_of_mean = ClipNoise(mean_names(batch), lengths, [0] * len(batch), self.device)
        return self.expressed_motion(self.conditions(batch), unit, unit_of_mean, progress=progress)

    @torch.no_grad()
    def generate_samples(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "samples frames points dims"]:
        """The same for several seeds: speech and style are encoded once."""
        lengths, conditions = clip.frame_lengths.tolist(), self.conditions(clip)
        unit = ClipNoise(clip.names * len(seeds), lengths * len(seeds), seeds, self.device)
        unit_of_mean = ClipNoise(mean_names(clip), lengths, [0], self.device)
        return self.expressed_motion(conditions, unit, unit_of_mean, samples=len(seeds), progress=progress)

    @torch.no_grad()
    def generate_window(
        self, clip: Batch, window: MotionWindow, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "samples frames points dims"], list[Tensor]]:
        """The same for a window of long speech, blended in every denoising step with the window before it."""
        # The speech before the window is encoded with it but not animated: features at its start depend on it.
        animated = torch.from_numpy(window.encoded).to(self.device)
        conditions = self.conditions(clip, animated).frames(animated)
        overlap = WindowOverlap(before, slice(max(0, window.frames - window.kept), window.frames), window.fixed)
        unit = WindowNoise(clip.names[0], window, seeds, self.device)
        unit_of_mean = WindowNoise(mean_names(clip)[0], window, [0], self.device)
        frames, samples = slice(window.fixed, window.frames), len(seeds)
        motion = self.expressed_motion(conditions, unit, unit_of_mean, samples=samples, blend=overlap, frames=frames)
        return motion, overlap.features

    def expressed_motion(
        self,
        conditions: Conditions,
        unit: NoiseSource,
        unit_of_mean: NoiseSource,
        *,
        samples: int = 1,
        blend: Blend = unchanged,
        frames: slice = slice(None),  # noqa: B008 - it cannot be changed
        progress: Progress | None = None,
    ) -> Float[Tensor, "batch frames points dims"]:
        """Motion at the chosen expressivity e: mean + e · (sample − mean).

        Args:
            conditions: of the clips, of one clip, or of a window.
            unit: source of unit noise for every clip and sample.
            unit_of_mean: source of the unit noise from which the mean is predicted, for every clip.
            samples: how many of one clip.
            blend: as :meth:`sample` takes it.
            frames: as :meth:`sample` takes it.
            progress: as :meth:`sample` takes it.
        """
        # Samples of one clip share its speech features and style: only the noisy motion differs.
        rows, share = conditions.repeated(samples), self.expressivity
        if not isinstance(share, Tensor) and share == 1:
            return self.sample(rows, unit, blend=blend, frames=frames, progress=progress)
        mean = self.mean_motion(self.denoiser(conditions, blend), unit_of_mean, frames)
        if not isinstance(share, Tensor) and share == 0:
            return mean.expand(samples * len(mean), -1, -1, -1)
        motion = self.sample(rows, unit, blend=blend, frames=frames, progress=progress)
        # Linear in the offset of the vertices, so that 0 and 1 give mean and sample exactly, and any factor between
        # keeps the sample's timing. One number for each vertex, or one for all.
        factor = share.to(motion)[:, None] if isinstance(share, Tensor) else share
        return mean + factor * (motion - mean)

    def mean_motion(self, denoiser: ConditionalDenoiser, unit: NoiseSource, frames: slice) -> Tensor:
        """The mean of motion under the conditions, one for each clip."""
        # At the last step nothing of the motion is left in the noise, so the prediction that errs least is the mean of
        # all motions that the conditions allow. A network lets some of the noise through all the same, nearly linearly:
        # between noise and its negative that cancels (2 evaluations leave 1/20 of the variance of one). The noise is
        # the mean's own, so that a clip has one mean for all seeds.
        noise = denoiser.noise(unit(self.empty_state(denoiser)))
        last = self.process.steps - 1
        first, second = (self.decode(denoiser, denoiser.denoise(start, last), frames) for start in (noise, -noise))
        return (first + second) / 2

    def denoiser(self, conditions: Conditions, blend: Blend) -> ConditionalDenoiser:
        """The network under some conditions, in the space in which the sampler runs."""
        preconditioning = self.motion_space.preconditioning
        return self.network.prepare_for_inference(
            conditions, self.process.steps, folded=self.folds, blend=blend, preconditioning=preconditioning
        )

    @property
    def folds(self) -> bool:
        """Whether the sampler runs on folded motion: not where it acts on vertices, or goes on after its last step.

        Nor where the network's output is preconditioned, which works on components, which are few already.
        """
        linear = self.sampler.linear and self.sampler.spread == 1
        return self.options.sampling_space == "folded" and linear and self.motion_space.preconditioning is None

    def empty_state(self, denoiser: ConditionalDenoiser) -> Tensor:
        """A state with no values yet."""
        shape = (*denoiser.conditions.mask.shape, denoiser.width)
        return torch.empty(shape, device=self.device, dtype=next(self.parameters()).dtype)

    def decode(
        self, denoiser: ConditionalDenoiser, state: Tensor, frames: slice
    ) -> Float[Tensor, "batch frames points dims"]:
        """The sampler's result as offsets from the template."""
        return self.motion_space.decode(denoiser.motion(state, frames)) / self.scale


def mean_names(batch: Batch) -> list[str]:
    """Names of the noise from which the means of clips are predicted: no sample has the same noise."""
    return [f"{name}/mean" for name in batch.names]
