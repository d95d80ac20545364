"""Denoising diffusion implicit models."""

from __future__ import annotations

from typing import Any

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.base import Sampler
from facediff.registry import sampler


@sampler.register("ddim")
class DdimSampler(Sampler):
    """Few-step implicit sampling; deterministic after its start at eta 0 (Song et al. 2021).

    Args:
        process: the noise process; given by the system.
        steps: denoising steps, spread evenly and starting from pure noise.
        eta: noise added per step, as a share of ancestral sampling's.
    """

    def __init__(self, *, process: NoiseProcess, steps: int = 25, eta: float = 0.0) -> None:
        super().__init__(process, steps)
        self.eta = eta

    def make_scheduler(self) -> Any:  # noqa: ANN401
        """Trailing spacing, so that the first step sees pure noise as in training."""
        from diffusers import DDIMScheduler

        scheduler = DDIMScheduler(**self.process.scheduler_config(), clip_sample=False, timestep_spacing="trailing")
        scheduler.set_timesteps(self.steps)
        return scheduler

    def step_options(self) -> dict[str, Any]:
        """The noise share."""
        return {"eta": self.eta}
