"""Ancestral sampling, the reference."""

from __future__ import annotations

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.ddim import DdimSampler
from facediff.registry import sampler


@sampler.register("ddpm")
class DdpmSampler(DdimSampler):
    """Ancestral sampling from the Gaussian posterior q(Mⁿ⁻¹ | Mⁿ, M̂⁰); the reference (Ho et al. 2020).

    It is DDIM's update at η = 1 (Song et al. 2021, section 4.1). No noise is added in the last step, and nothing is
    clipped, since motion has no fixed range.

    Args:
        process: the noise process; given by the system.
        steps: denoising steps; all of the process's if None.
    """

    def __init__(self, *, process: NoiseProcess, steps: int | None = None) -> None:
        super().__init__(process=process, steps=process.steps if steps is None else steps, eta=1.0)
