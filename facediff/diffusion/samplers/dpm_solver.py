"""DPM-Solver++."""

from __future__ import annotations

from typing import Any

from facediff.diffusion.process import NoiseProcess
from facediff.diffusion.samplers.base import Sampler
from facediff.errors import FaceDiffError
from facediff.registry import sampler


@sampler.register("dpm_solver")
class DpmSolverSampler(Sampler):
    """DPM-Solver++ multistep solver; good results in 10 to 20 steps (Lu et al. 2022).

    Args:
        process: the noise process; given by the system.
        steps: denoising steps.
        order: order of the solver, 1 to 3.

    Raises:
        FaceDiffError: if the number of steps or the order is impossible.
    """

    def __init__(self, *, process: NoiseProcess, steps: int = 10, order: int = 2) -> None:
        super().__init__(process, steps)
        if order not in (1, 2, 3):
            raise FaceDiffError(f"sampler.order: {order} is impossible; choose 1, 2 or 3")
        self.order = order

    def make_scheduler(self) -> Any:  # noqa: ANN401
        """Ends at zero noise, so that the last step returns the clean prediction itself."""
        from diffusers import DPMSolverMultistepScheduler

        scheduler = DPMSolverMultistepScheduler(
            **self.process.scheduler_config(),
            algorithm_type="dpmsolver++",
            solver_order=self.order,
            final_sigmas_type="zero",
        )
        # Given by hand: the library's own spacing has one step too many for some numbers of steps, by rounding.
        scheduler.set_timesteps(timesteps=self.places())
        return scheduler
