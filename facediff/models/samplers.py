"""The forward noise process and the samplers that reverse it, from noise to clean motion.

From top to bottom: what noise is added (:class:`NoiseProcess`, eq. 1 of the dual-path paper), the loop of the reverse
process (:meth:`Sampler.run`, algorithm 2), and the update of each sampler. Nothing here knows a network or a mesh.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, ClassVar, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from facediff.errors import ArgumentError, check_known, counted
from facediff.models.layers import Share
from facediff.registry import name_of, sampler
from facediff.utils.ranges import Range

Steps = Annotated[int, Range(1, 100_000)]
"""Steps of a process."""

Denoiser = Callable[[Tensor, int], Tensor]
"""(noisy motion, step counted from 0) to predicted clean motion of the same shape."""

NoiseSource = Callable[[Tensor], Tensor]
"""New unit Gaussian noise like a tensor; each clip has a source of its own, so that clips do not depend on others."""


def cosine_betas(steps: int) -> list[float]:
    """The cosine schedule (Nichol and Dhariwal 2021, eq. 17): 1 − ᾱ(n+1)/ᾱ(n), at most 0.999."""

    def signal(time: float) -> float:
        return math.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2

    return [min(1 - signal((n + 1) / steps) / signal(n / steps), 0.999) for n in range(steps)]


SCHEDULES: dict[str, Callable[[int], Tensor]] = {
    "squaredcos_cap_v2": lambda steps: torch.tensor(cosine_betas(steps), dtype=torch.float32),
    "linear": lambda steps: torch.linspace(0.0001, 0.02, steps, dtype=torch.float32),
    "scaled_linear": lambda steps: torch.linspace(0.0001**0.5, 0.02**0.5, steps, dtype=torch.float32) ** 2,
}
"""The noise variances α_n of every schedule, by the names that the field uses for them."""


class NoiseProcess:
    """Gradual noising: q(Mⁿ | Mⁿ⁻¹) = N(√(1 − α_n) Mⁿ⁻¹, α_n I) (eq. 1).

    The paper's α_n is the noise variance of a step (β_n in the DDPM literature). Steps are counted from 0 here, so
    step n of this class is the paper's step n + 1.

    Args:
        steps: number of steps N.
        schedule: ``squaredcos_cap_v2`` (the cosine schedule), ``linear`` or ``scaled_linear``.
        scale: what motion is multiplied by before it is noised (Chen 2023, arXiv 2301.10972): below 1, noise hides more
            of it at every step. The noisy motion is divided by its new size, so that this is another schedule for the
            same motion: ᾱ becomes b²ᾱ / (b²ᾱ + 1 − ᾱ).
        variances: of another schedule, in the precision in which all is computed; instead of steps and schedule.

    Attributes:
        variances: the noise variance α_n of each step, float32.
        signal: ᾱ_n = Π_{k≤n} (1 − α_k), the share of the clean motion's variance that is left after step n.

    Example:
        >>> process = NoiseProcess(steps=4)
        >>> [round(float(kept), 3) for kept in process.signal]
        [0.847, 0.494, 0.144, 0.0]
    """

    def __init__(
        self,
        steps: int = 1000,
        schedule: str = "squaredcos_cap_v2",
        scale: float = 1.0,
        variances: Float[Tensor, " steps"] | None = None,
    ) -> None:
        check_known("noise_schedule", "schedule", [schedule], SCHEDULES)
        self.steps = steps if variances is None else len(variances)
        self.schedule = schedule
        self.variances: Tensor = SCHEDULES[schedule](steps) if variances is None else variances
        self.signal = torch.cumprod(1.0 - self.variances, dim=0)
        self.scale = scale
        if scale != 1:
            # In float64, so that 1 − ᾱ keeps its digits at the clean end. The variances follow from the new ᾱ as α_n =
            # 1 − ᾱ_n / ᾱ_{n−1}, so that eq. 1 and its closed form still agree.
            scaled = scale**2 * self.signal.double()
            signal = scaled / (scaled + 1 - self.signal.double())
            before = torch.cat([signal.new_ones(1), signal[:-1]])
            # At most the largest number below 1: samplers and losses divide by the noise, which is never none.
            self.signal, self.variances = signal.float().clamp_max(1 - 2**-24), (1 - signal / before).float()
        # A product of so many small factors underflows to 0 in float32; dpm_solver's time, ln(ᾱ / (1 − ᾱ)) / 2, would
        # then be infinite at the very step at which sampling starts.
        if not 0 < float(self.signal[-1]) < 1:
            raise ArgumentError(
                {"diffusion_steps": steps, "noise_schedule": schedule, "noise_scale": scale},
                "the schedule leaves no signal after so many steps; choose fewer steps or squaredcos_cap_v2",
            )

    def add_noise(
        self,
        clean: Float[Tensor, "batch ..."],
        noise: Float[Tensor, "batch ..."],
        step: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch ..."]:
        """Mⁿ = √ᾱ_n M⁰ + √(1 − ᾱ_n) ε, the closed form of n applications of eq. 1."""
        signal = self.signal.to(clean.device)[step.to(clean.device)].view(-1, *[1] * (clean.dim() - 1))
        return signal.sqrt().to(clean) * clean + (1 - signal).sqrt().to(clean) * noise

    def draw_steps(
        self,
        batch: int,
        device: torch.device,
        generator: torch.Generator | None = None,
        weights: Float[Tensor, " steps"] | None = None,
    ) -> Int[Tensor, " batch"]:
        """Random step numbers (algorithm 1, line 3)."""
        if weights is not None:
            return torch.multinomial(weights.to(device), batch, replacement=True, generator=generator)
        return torch.randint(0, self.steps, (batch,), device=device, generator=generator)


Spacing = Literal["steps", "log_snr"]
NoiseLevel = Annotated[float, Range(1e-6, 1e6)]
Spread = Annotated[float, Range(0.5, 2.0)]


def visited(
    process: NoiseProcess,
    steps: int,
    spacing: Spacing,
    last_noise: float | None,
    first_noise: float | None = None,
) -> list[int]:
    """Which steps of the process a sampler visits, counted from 0, from pure noise downwards.

    Args:
        process: the noise process.
        steps: how many.
        spacing: ``steps`` spreads them evenly over the process; ``log_snr`` over the logarithm of the signal-to-noise
            ratio, the time of the solvers, so that few steps go to as little noise as many do.
        last_noise: noise left at the last of them, as a deviation in the unit of the motion, √((1 − ᾱ) / ᾱ); None for
            where the spacing itself ends.
        first_noise: noise from which ``log_snr`` is spread; the process's last step stays the first visited. A process
            ends where motion has long been hidden, and half of the steps would be spent on the way from there.
    """
    if spacing == "steps" and last_noise is None and first_noise is None:
        # From the end of the process, since sampling starts from pure noise; the clean end itself is no step.
        return [round(process.steps * (steps - i) / steps) - 1 for i in range(steps)]
    signal = process.signal.double()
    snr = torch.log(signal / (1 - signal)) / 2  # falls from step to step
    cleanest = 0 if last_noise is None else int((snr + math.log(last_noise)).abs().argmin())
    start = snr[-1] if first_noise is None else snr[-1].clamp_min(-math.log(first_noise))
    if first_noise is not None and (spacing == "steps" or float(start) >= float(snr[cleanest])):
        raise ArgumentError(
            {"first_noise": first_noise, "last_noise": last_noise, "spacing": spacing},
            "is for spacing=log_snr, and above the noise at the last step",
        )
    if process.steps - 1 - cleanest < steps - 1:
        raise ArgumentError(
            {"last_noise": last_noise, "steps": steps, "diffusion_steps": process.steps},
            f"there are {process.steps - cleanest} steps with at least that much noise; "
            f"choose less noise or fewer sampling steps",
        )
    timesteps: list[int] = []
    for i in range(steps):
        share = i / max(1, steps - 1)
        if spacing == "steps":
            nearest = round((process.steps - 1) + share * (cleanest - process.steps + 1))
        else:
            nearest = int((snr - (start + share * (snr[cleanest] - start))).abs().argmin())
        # Each step once, and room for those that follow.
        nearest = min(nearest, timesteps[-1] - 1) if timesteps else process.steps - 1  # pure noise first
        timesteps.append(max(nearest, cleanest + steps - 1 - i))
    return timesteps


PART = 2**21
"""How many numbers one random stream draws on a processor."""


def unit_noise(shape: Sequence[int], device: torch.device, generator: torch.Generator | None = None) -> Tensor:
    """Unit Gaussian noise, drawn by all threads of a processor; the number of threads does not change the numbers."""
    if device.type != "cpu":
        return torch.randn(*shape, device=device, generator=generator)
    # PyTorch draws on a processor with one thread, which with 70 000 coordinates a frame is a good part of a training
    # step: 0.22 s of 3.67 s, and 0.08 s here (tools/benchmarks/RESULTS.md). Many streams, with seeds from the
    # generator, are drawn in parallel instead.
    noise = torch.empty(*shape)
    parts = torch.split(noise.view(-1), PART)
    seeds = torch.randint(2**63 - 1, (len(parts),), generator=generator).tolist()
    mode = torch.is_inference_mode_enabled()  # new threads do not inherit it

    def draw(part: Tensor, seed: int) -> None:
        with torch.inference_mode(mode):
            part.normal_(generator=torch.Generator().manual_seed(seed))

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        list(threads.map(draw, parts, seeds))
    return noise


class Sampler(ABC):
    """Runs the reverse process from noise to clean motion (algorithm 2).

    A sampler implements :meth:`update`, one step of the process.

    Class attributes:
        linear: whether every update is a fixed linear combination, the same for all coordinates, of motions,
            predictions and noise, and the last update returns the last prediction itself. Then the process may run
            on any linear image of motion (:mod:`facediff.models.folding`). A sampler that clips or thresholds, or that
            ends anywhere else, is not; False is always safe.
        memory: how many of the latest predictions :meth:`update` is given.

    Args:
        process: the noise process to reverse.
        steps: denoising steps; at most the process's own number.
        spacing: how they are spread over the process, see :func:`visited`.
        last_noise: noise left at the last of them, see :func:`visited`.
        first_noise: noise from which ``log_snr`` is spread, see :func:`visited`.
        spread: factor of the noise where the first step goes on from it, and of the distance of the result from the
            first prediction, which is the mean; few steps vary too little.

    Attributes:
        timesteps: the steps visited, counted from 0, from the process's last (pure noise) downwards.
        signal: ᾱ at each of them, and 1 for the clean end.

    Example:
        >>> sampler = DdimSampler(process=NoiseProcess(), steps=4)
        >>> sampler.timesteps
        [999, 749, 499, 249]
        >>> sampler.run(lambda noisy, step: torch.ones_like(noisy), torch.randn(1, 2, 3)).unique()
        tensor([1.])
    """

    linear: ClassVar[bool] = False
    memory: ClassVar[int] = 1

    def __init__(
        self,
        process: NoiseProcess,
        steps: int,
        spacing: Spacing = "steps",
        last_noise: float | None = None,
        first_noise: float | None = None,
        spread: Spread = 1.0,
    ) -> None:
        if not 1 <= steps <= process.steps:
            raise ArgumentError(
                {"steps": steps, "diffusion_steps": process.steps}, f"expected 1 to {process.steps} sampling steps"
            )
        self.process = process
        self.steps = steps
        self.spread = spread
        self.timesteps = visited(process, steps, spacing, last_noise, first_noise)
        self.signal = [*(float(process.signal[n]) for n in self.timesteps), 1.0]

    def __str__(self) -> str:
        """Its registered name and its steps."""
        return f"{name_of(type(self))} with {counted(self.steps, 'step')}"

    def run(
        self,
        denoise: Denoiser,
        start: Float[Tensor, "*shape"],
        *,
        noise: NoiseSource = torch.randn_like,
        progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
    ) -> Float[Tensor, "*shape"]:
        """Denoise ``start`` to clean motion."""
        # Solvers of a higher order extrapolate from earlier predictions instead of calling the network again, which is
        # why the predictions and not the states are kept.
        noisy = mean = start
        predictions: list[Tensor] = []
        for i, step in enumerate(progress(self.timesteps) if progress is not None else self.timesteps):
            predictions = [*predictions, denoise(noisy, step)][-self.memory :]
            if i == 0:
                mean = predictions[0]
                # Louder noise alone made blinks too frequent, distance alone closed fewer lips: each does its half.
                noisy = self.spread * noisy if self.spread != 1 else noisy
            noisy = self.update(i, noisy, predictions, noise)
        return noisy if self.spread == 1 else mean + self.spread * (noisy - mean)

    @abstractmethod
    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """From the motion at ``timesteps[i]`` to the motion at ``timesteps[i + 1]``, or to clean motion at the end.

        Args:
            i: which of the timesteps.
            noisy: the motion there.
            predictions: the latest clean predictions, at most :attr:`memory`; the last one is this step's.
            noise: where a stochastic sampler takes new noise from.
        """


class SamplerFactory(Protocol):
    """Makes a sampler once the noise process is known."""

    def __call__(self, *, process: NoiseProcess) -> Sampler:
        """Make one that reverses ``process``."""


@sampler.register("ddim")
class DdimSampler(Sampler):
    """Few-step implicit sampling; deterministic after its start at eta 0 (Song et al. 2021).

    Args:
        steps: denoising steps.
        eta: noise added per step, as a share of ancestral sampling's.
        spacing: ``steps`` spreads them evenly over the process, ``log_snr`` over the logarithm of its signal-to-noise
            ratio.
        last_noise: noise left at the last of them, as a deviation in the unit of scaled motion.
        first_noise: noise from which ``log_snr`` is spread, in the same unit; the process's own last if None.
    """

    linear: ClassVar[bool] = True

    def __init__(
        self,
        *,
        process: NoiseProcess,
        steps: Steps = 25,
        eta: Share = 0.0,
        spacing: Spacing = "steps",
        last_noise: NoiseLevel | None = None,
        first_noise: NoiseLevel | None = None,
    ) -> None:
        super().__init__(process, steps, spacing, last_noise, first_noise)
        self.eta = eta

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """DDIM's update between any two steps of the process (Song et al. 2021, eq. 12 and 16)."""
        # ᾱ of the two steps really visited. Libraries often go back by N // steps instead, which is not the distance to
        # the next step where ``steps`` does not divide N; the noise level is then wrong throughout.
        signal_now, signal_after = self.signal[i], self.signal[i + 1]
        clean = predictions[-1]
        # The noise that the motion holds if the prediction is right. The update keeps as much of it as the next step
        # allows, and replaces the share η² of the posterior's variance by new noise (σ² of eq. 16).
        direction = (noisy - signal_now**0.5 * clean) / (1 - signal_now) ** 0.5
        variance = self.eta**2 * (1 - signal_after) / (1 - signal_now) * (1 - signal_now / signal_after)
        mean = signal_after**0.5 * clean + max(1 - signal_after - variance, 0.0) ** 0.5 * direction
        return mean if variance == 0 else mean + variance**0.5 * noise(noisy)


@sampler.register("ddpm")
class DdpmSampler(DdimSampler):
    """Ancestral sampling from the Gaussian posterior q(Mⁿ⁻¹ | Mⁿ, M̂⁰); the reference (Ho et al. 2020).

    It is DDIM's update at η = 1 (Song et al. 2021, section 4.1). No noise is added in the last step, and nothing is
    clipped, since motion has no fixed range.

    Args:
        steps: denoising steps; all of the process's if None.
        spacing: as for ``ddim``.
        last_noise: as for ``ddim``.
        first_noise: as for ``ddim``.
    """

    def __init__(
        self,
        *,
        process: NoiseProcess,
        steps: Steps | None = None,
        spacing: Spacing = "steps",
        last_noise: NoiseLevel | None = None,
        first_noise: NoiseLevel | None = None,
    ) -> None:
        count = process.steps if steps is None else steps
        super().__init__(
            process=process, steps=count, eta=1.0, spacing=spacing, last_noise=last_noise, first_noise=first_noise
        )


@sampler.register("dpm_solver")
class DpmSolverSampler(Sampler):
    """DPM-Solver++ multistep solver in its midpoint form; good results in few steps (Lu et al. 2022).

    Args:
        steps: denoising steps.
        order: order of the solver, 1 to 3.
        spacing: ``steps`` spreads them evenly over the process, ``log_snr`` over the logarithm of its signal-to-noise
            ratio.
        last_noise: noise left at the last of them, as a deviation in the unit of scaled motion.
        first_noise: noise from which ``log_snr`` is spread, in the same unit; the process's own last if None.
        spread: how much louder the noise is where the first step goes on from it, and how much further from the first
            prediction, the mean, the result is; above 1 lets few steps vary more.
    """

    linear: ClassVar[bool] = True
    memory: ClassVar[int] = 3

    def __init__(
        self,
        *,
        process: NoiseProcess,
        steps: Steps = 5,
        order: Literal[1, 2, 3] = 2,
        spacing: Spacing = "steps",
        last_noise: NoiseLevel | None = None,
        first_noise: NoiseLevel | None = None,
        spread: Spread = 1.0,
    ) -> None:
        super().__init__(process, steps, spacing, last_noise, first_noise, spread)
        self.order = order
        # Without the clean end, where the time λ is infinite; the last update returns the prediction and needs none.
        signal = self.signal[:-1]
        self.signal_rate = [math.sqrt(value) for value in signal]
        self.noise_rate = [math.sqrt(1 - value) for value in signal]
        # λ, half the logarithm of the signal-to-noise ratio, is the solver's time.
        self.time = [math.log(a / s) for a, s in zip(self.signal_rate, self.noise_rate, strict=True)]

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise: NoiseSource) -> Tensor:
        """The multistep update for clean predictions (Lu et al. 2022, algorithm 2 and appendix); no noise is added."""
        clean = predictions[-1]
        if i == self.steps - 1:
            return clean  # at zero noise the solver's update is the prediction itself
        # A high order needs earlier predictions, and is unstable near the clean end where steps are few and far apart:
        # the same choices as in the authors' and diffusers' implementations.
        order = min(self.order, i + 1, self.steps - i if self.steps < 15 else self.order)
        h = self.time[i + 1] - self.time[i]
        # e^{−h} − 1: with many steps h is small, and the difference would lose its digits.
        decay = math.expm1(-h)
        signal = self.signal_rate[i + 1]
        # The exact solution of the probability-flow equation for a prediction that stays constant over the step: the
        # first order of DPM-Solver++, which is DDIM. All higher orders correct it.
        moved = self.noise_rate[i + 1] / self.noise_rate[i] * noisy - signal * decay * clean
        if order == 1:
            return moved
        # First and second derivative of the prediction over λ, from differences between the latest predictions.
        ratio = (self.time[i] - self.time[i - 1]) / h
        slope = (clean - predictions[-2]) / ratio
        if order == 2:
            return moved - 0.5 * signal * decay * slope
        before = (self.time[i - 1] - self.time[i - 2]) / h
        # The divided difference of second order: steps need not be equally long in λ.
        bend = (slope - (predictions[-2] - predictions[-3]) / before) / (ratio + before)
        slope = slope + ratio * bend
        # Third order (Lu et al. 2022, appendix): φ₂ = (e^{−h} − 1)/h + 1 weights the slope, φ₃ = (e^{−h} − 1 + h)/h² −
        # ½ the curvature. Second order above approximates φ₂ by half of −(e^{−h} − 1), the midpoint form.
        return moved + signal * (decay / h + 1) * slope - signal * ((decay + h) / h**2 - 0.5) * bend
