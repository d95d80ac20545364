"""DPM-Solver++."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from facediff.errors import FaceDiffError
from facediff.registry import sampler

# The forward noise process (dual-path style diffusion paper, eq. 1).


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


# Unit Gaussian noise of the size of vertex motion.

PART = 2**21
"""How many numbers one stream draws on a processor."""


def unit_noise(shape: Sequence[int], device: torch.device, generator: torch.Generator | None = None) -> Tensor:
    """Noise, drawn by all threads of a processor.

    PyTorch draws on a processor with one thread, which with 70 000 coordinates a frame is a good part of a training
    step. Here many streams, seeded by ``generator``, are drawn side by side. How many threads there are
    does not change the numbers.

    Args:
        shape: the shape of the noise.
        device: where to draw.
        generator: source of the draws; torch's global one if None.
    """
    if device.type != "cpu":
        return torch.randn(*shape, device=device, generator=generator)
    noise = torch.empty(*shape)
    parts = torch.split(noise.view(-1), PART)
    seeds = torch.randint(2**63 - 1, (len(parts),), generator=generator).tolist()

    mode = torch.is_inference_mode_enabled()  # a thread does not know its caller's

    def draw(part: Tensor, seed: int) -> None:
        with torch.inference_mode(mode):
            part.normal_(generator=torch.Generator().manual_seed(seed))

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        list(threads.map(draw, parts, seeds))
    return noise


# What every sampler is: a thin layer over a scheduler of the library diffusers.

Denoiser = Callable[[Tensor, int], Tensor]
"""(noisy motion, step counted from 0) to predicted clean motion of the same shape."""

NoiseSource = Callable[[Tensor], Tensor]
"""Fresh unit Gaussian noise like a tensor; one for each clip of its own, so that a clip does not depend on others."""


class Sampler(ABC):
    """Runs the reverse process from noise to clean motion (algorithm 2).

    Class attributes:
        linear: whether every update is a fixed linear combination, the same for all coordinates, of motions,
            predictions and noise, and the last update returns the last prediction itself. Then the process may run
            on any linear image of motion (:mod:`facediff.models.folding`). A sampler that clips or
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


# Denoising diffusion implicit models.


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
        process: the noise process; given by the model.
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


# Ancestral sampling, the reference.


@sampler.register("ddpm")
class DdpmSampler(DdimSampler):
    """Ancestral sampling from the Gaussian posterior q(Mⁿ⁻¹ | Mⁿ, M̂⁰); the reference (Ho et al. 2020).

    It is DDIM's update at η = 1 (Song et al. 2021, section 4.1). No noise is added in the last step, and nothing is
    clipped, since motion has no fixed range.

    Args:
        process: the noise process; given by the model.
        steps: denoising steps; all of the process's if None.
    """

    def __init__(self, *, process: NoiseProcess, steps: int | None = None) -> None:
        super().__init__(process=process, steps=process.steps if steps is None else steps, eta=1.0)


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
        process: the noise process; given by the model.
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
