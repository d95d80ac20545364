"""DPM-Solver++."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from torch import Tensor

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.base import NoiseSource, Sampler
from facediff.errors import FaceDiffError
from facediff.registry import sampler


class DpmSolverScheduler:
    """The multistep updates of DPM-Solver++ for clean predictions (Lu et al. 2022, algorithm 2 and appendix).

    It makes the choices of diffusers' ``DPMSolverMultistepScheduler`` (midpoint form; first order at the start and at
    the end, second order at most before the end where there are fewer than 15 steps), but not its rounding: the
    library takes every motion to float32, whatever it was. The last step returns the clean prediction itself. One
    scheduler serves one run.

    Args:
        process: the noise process.
        places: the steps visited, descending.
        order: order of the solver, 1 to 3.
    """

    def __init__(self, process: NoiseProcess, places: list[int], order: int) -> None:
        self.timesteps = torch.tensor(places)
        self._order = order
        signal = [float(process.signal[place]) for place in places]
        self._signal_rate = [math.sqrt(kept) for kept in signal]
        self._noise_rate = [math.sqrt(1 - kept) for kept in signal]
        # λ, half the logarithm of the signal-to-noise ratio, is the solver's time.
        self._time = [math.log(a / s) for a, s in zip(self._signal_rate, self._noise_rate, strict=True)]
        self._predictions: list[Tensor] = []

    def step(self, clean: Tensor, noisy: Tensor) -> Tensor:
        """From the motion at the present timestep and the clean prediction to the motion at the next."""
        now, total = len(self._predictions), len(self.timesteps)
        self._predictions.append(clean)
        if now == total - 1:
            return clean
        if now >= 3:
            self._predictions[now - 3] = clean.new_empty(0)  # never looked at again
        order = min(self._order, now + 1, total - now if total < 15 else self._order)
        h = self._time[now + 1] - self._time[now]
        decay = math.expm1(-h)
        signal = self._signal_rate[now + 1]
        moved = self._noise_rate[now + 1] / self._noise_rate[now] * noisy - signal * decay * clean
        if order == 1:
            return moved
        ratio = (self._time[now] - self._time[now - 1]) / h
        slope = (clean - self._predictions[now - 1]) / ratio
        if order == 2:
            return moved - 0.5 * signal * decay * slope
        before = (self._time[now - 1] - self._time[now - 2]) / h
        bend = (slope - (self._predictions[now - 1] - self._predictions[now - 2]) / before) / (ratio + before)
        slope = slope + ratio * bend
        return moved + signal * (decay / h + 1) * slope - signal * ((decay + h) / h**2 - 0.5) * bend


@sampler.register("dpm_solver")
class DpmSolverSampler(Sampler):
    """DPM-Solver++ multistep solver; good results in few steps (Lu et al. 2022).

    Args:
        process: the noise process; given by the system.
        steps: denoising steps.
        order: order of the solver, 1 to 3.

    Raises:
        FaceDiffError: if the number of steps or the order is impossible.
    """

    linear: ClassVar[bool] = True

    def __init__(self, *, process: NoiseProcess, steps: int = 5, order: int = 2) -> None:
        super().__init__(process, steps)
        if order not in (1, 2, 3):
            raise FaceDiffError(f"sampler.order: {order} is impossible; choose 1, 2 or 3")
        self.order = order

    def make_scheduler(self) -> Any:  # noqa: ANN401
        """Ends at zero noise, so that the last step returns the clean prediction itself."""
        return DpmSolverScheduler(self.process, self.places(), self.order)

    def advance(
        self,
        scheduler: Any,  # noqa: ANN401
        clean: Tensor,
        step: int,
        noisy: Tensor,
        noise: NoiseSource,
    ) -> Tensor:
        """The solver's update; no noise is added."""
        return scheduler.step(clean, noisy)
