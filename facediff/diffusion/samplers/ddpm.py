"""Ancestral sampling, the reference."""

from __future__ import annotations

from typing import Any

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.base import Sampler
from facediff.registry import sampler


@sampler.register("ddpm")
class DdpmSampler(Sampler):
    """Ancestral sampling from the Gaussian posterior q(Mⁿ⁻¹ | Mⁿ, M̂⁰); the reference (Ho et al. 2020).

    No noise is added in the last step.

    Args:
        process: the noise process; given by the system.
        steps: denoising steps; all of the process's if None.
    """

    def __init__(self, *, process: NoiseProcess, steps: int | None = None) -> None:
        super().__init__(process, process.steps if steps is None else steps)

    def make_scheduler(self) -> Any:  # noqa: ANN401
        """The posterior's own variance; nothing is clipped, since motion has no fixed range."""
        from diffusers import DDPMScheduler

        scheduler = DDPMScheduler(
            **self.process.scheduler_config(),
            variance_type="fixed_small",
            clip_sample=False,
        )
        # Given by hand: the library's own spacing has one step too many for some numbers of steps, by rounding.
        scheduler.set_timesteps(timesteps=self.places())
        return scheduler
