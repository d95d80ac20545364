"""What every sampler is: a thin layer over a scheduler of the library diffusers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.diffusion.process import NoiseProcess
from facediff.errors import FaceDiffError

Denoiser = Callable[[Tensor, int], Tensor]
"""(noisy motion, step counted from 0) to predicted clean motion of the same shape."""

NoiseSource = Callable[[Tensor], Tensor]
"""Fresh unit Gaussian noise like a tensor; one for each clip of its own, so that a clip does not depend on others."""


class Sampler(ABC):
    """Runs the reverse process from noise to clean motion (algorithm 2).

    Class attributes:
        linear: whether every update is a fixed linear combination, the same for all coordinates, of motions,
            predictions and noise, and the last update returns the last prediction itself. Then the process may run
            on any linear image of motion (:mod:`facediff.diffusion.folding`). A sampler that clips or
            thresholds, or that ends anywhere else, is not; False is always safe.

    Args:
        process: the noise process to reverse.
        steps: denoising steps; at most the process's own number.

    Raises:
        FaceDiffError: if the number of steps is impossible.
    """

    linear: ClassVar[bool] = False

    def __init__(self, process: NoiseProcess, steps: int) -> None:
        if not 1 <= steps <= process.steps:
            raise FaceDiffError(
                f"sampler.steps: {steps} is impossible with {process.steps} diffusion steps; "
                f"choose 1 to {process.steps}"
            )
        self.process = process
        self.steps = steps

    def places(self) -> list[int]:
        """The steps visited, counted from 0: evenly spread, from the process's last (pure noise) downwards."""
        total = self.process.steps
        return [round(total * (self.steps - i) / self.steps) - 1 for i in range(self.steps)]

    @abstractmethod
    def make_scheduler(self) -> Any:  # noqa: ANN401 - diffusers' schedulers share no typed base class
        """A fresh scheduler of diffusers with its timesteps set."""

    def advance(
        self,
        scheduler: Any,  # noqa: ANN401
        clean: Tensor,
        step: int,
        noisy: Tensor,
        noise: NoiseSource,
    ) -> Tensor:
        """From the motion at ``step`` and the clean prediction to the motion at the scheduler's next step.

        A sampler that adds noise on the way overrides this and takes the noise from ``noise``.
        """
        return scheduler.step(clean, step, noisy, return_dict=False)[0]

    def run(
        self,
        denoise: Denoiser,
        start: Float[Tensor, "*shape"],
        *,
        noise: NoiseSource = torch.randn_like,
        progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
    ) -> Float[Tensor, "*shape"]:
        """Denoise ``start`` to clean motion.

        Args:
            denoise: predicts the clean motion from the noisy one.
            start: unit Gaussian noise.
            noise: source of the noise that stochastic samplers add.
            progress: wraps the iteration over steps, e.g. in a progress bar.
        """
        scheduler = self.make_scheduler()
        steps: Iterable[int] = [int(step) for step in scheduler.timesteps]
        noisy = start
        for step in progress(steps) if progress is not None else steps:
            clean = denoise(noisy, step)
            noisy = self.advance(scheduler, clean, step, noisy, noise)
        return noisy


class SamplerFactory(Protocol):
    """Makes a sampler once the noise process is known."""

    def __call__(self, *, process: NoiseProcess) -> Sampler:
        """Make one that reverses ``process``."""
        ...
