"""The forward noise process (dual-path style diffusion paper, eq. 1)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor


class NoiseProcess:
    """Gradual noising: q(Mⁿ | Mⁿ⁻¹) = N(√(1 − α_n) Mⁿ⁻¹, α_n I) (eq. 1).

    The paper's α_n is the noise variance of a step (β_n in the DDPM literature). Steps are counted from 0 here, so
    step n of this class is the paper's step n + 1. The schedule comes from the library diffusers.

    Args:
        steps: number of steps N.
        schedule: name of a schedule of diffusers: ``squaredcos_cap_v2`` (the cosine schedule), ``linear`` or
            ``scaled_linear``.
    """

    def __init__(self, steps: int = 1000, schedule: str = "squaredcos_cap_v2") -> None:
        from diffusers import DDPMScheduler

        self.steps = steps
        self.schedule = schedule
        self._scheduler = DDPMScheduler(**self.scheduler_config())

    def scheduler_config(self) -> dict[str, Any]:
        """What every scheduler of diffusers is told: this schedule, clean-motion prediction, no clipping."""
        return {
            "num_train_timesteps": self.steps,
            "beta_schedule": self.schedule,
            "prediction_type": "sample",
        }

    @property
    def variances(self) -> Float[Tensor, " steps"]:
        """The noise variance α_n of each step."""
        return self._scheduler.betas

    @property
    def signal(self) -> Float[Tensor, " steps"]:
        """ᾱ_n = Π_{k≤n} (1 − α_k): the share of the clean motion's variance that is left after step n."""
        return self._scheduler.alphas_cumprod

    def add_noise(
        self,
        clean: Float[Tensor, "batch ..."],
        noise: Float[Tensor, "batch ..."],
        step: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch ..."]:
        """Mⁿ = √ᾱ_n M⁰ + √(1 − ᾱ_n) ε, the closed form of n applications of eq. 1."""
        return self._scheduler.add_noise(clean, noise, step)

    def draw_steps(
        self, batch: int, device: torch.device, generator: torch.Generator | None = None
    ) -> Int[Tensor, " batch"]:
        """Uniform random step numbers (algorithm 1, line 3)."""
        return torch.randint(0, self.steps, (batch,), device=device, generator=generator)
