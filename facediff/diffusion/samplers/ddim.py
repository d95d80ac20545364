"""Denoising diffusion implicit models."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.base import NoiseSource, Sampler
from facediff.errors import FaceDiffError
from facediff.registry import sampler


class DdimScheduler:
    """DDIM's update between any two steps of a process (Song et al. 2021, eq. 12 and 16).

    It has the interface of a scheduler of diffusers but not its arithmetic: diffusers' ``DDIMScheduler`` always goes
    back by ``N // steps``, which is not the distance to its own next timestep where ``steps`` does not divide N; the
    noise level is then wrong throughout, and for some numbers of steps the clean end is never reached.

    Args:
        process: the noise process.
        places: the steps visited, descending; the first is the process's last, so that it sees pure noise.
    """

    def __init__(self, process: NoiseProcess, places: list[int]) -> None:
        signal = [float(process.signal[place]) for place in places]
        self.timesteps = torch.tensor(places)
        self._signal = dict(zip(places, zip(signal, [*signal[1:], 1.0], strict=True), strict=True))

    def step(self, clean: Tensor, step: int, noisy: Tensor, *, eta: float, noise: NoiseSource) -> Tensor:
        """From the motion at timestep ``step`` and the clean prediction to the motion at the next timestep."""
        now, then = self._signal[step]
        direction = (noisy - now**0.5 * clean) / (1 - now) ** 0.5
        variance = eta**2 * (1 - then) / (1 - now) * (1 - now / then)
        mean = then**0.5 * clean + max(1 - then - variance, 0.0) ** 0.5 * direction
        return mean if variance == 0 else mean + variance**0.5 * noise(noisy)


@sampler.register("ddim")
class DdimSampler(Sampler):
    """Few-step implicit sampling; deterministic after its start at eta 0 (Song et al. 2021).

    Args:
        process: the noise process; given by the system.
        steps: denoising steps, spread evenly and starting from pure noise.
        eta: noise added per step, as a share of ancestral sampling's.

    Raises:
        FaceDiffError: if the number of steps or eta is impossible.
    """

    linear: ClassVar[bool] = True

    def __init__(self, *, process: NoiseProcess, steps: int = 25, eta: float = 0.0) -> None:
        super().__init__(process, steps)
        if not 0 <= eta <= 1:
            raise FaceDiffError(f"sampler.eta: {eta} is impossible; choose 0 (deterministic) to 1 (ancestral)")
        self.eta = eta

    def make_scheduler(self) -> Any:  # noqa: ANN401
        """Even spacing from the process's last step to the clean end."""
        return DdimScheduler(self.process, self.places())

    def advance(
        self,
        scheduler: Any,  # noqa: ANN401
        clean: Tensor,
        step: int,
        noisy: Tensor,
        noise: NoiseSource,
    ) -> Tensor:
        """DDIM's update with the sampler's share of noise."""
        return scheduler.step(clean, step, noisy, eta=self.eta, noise=noise)
