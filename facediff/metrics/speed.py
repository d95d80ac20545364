"""Real-time factor: how long a model computes for one second of speech, and on what."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import ClassVar, Unpack

import torch
from torch import Tensor

from facediff.errors import counted
from facediff.metrics.base import ExactMetric, Inferred, ProcessOptions, functional
from facediff.registry import metric


@metric.register("real_time_factor")
class RealTimeFactor(ExactMetric):
    """Real-time factor (RTF): seconds of computing over seconds of speech, summed over clips.

    RTF = Σ computing / Σ speech over all clips: below 1 is faster than speech. Clips count by their length;
    it is no mean of factors. Over several processes the times of all are added, so the factor describes one
    process on one device. The caller chooses the timed parts (audio features,
    sampling, copies, files) and the batch size: the first calls on a device are slow and are best left out.

    Args:
        hardware: the device, for the summary: see :func:`device_name`.

    >>> metric = RealTimeFactor("one core")
    >>> metric.update(1.0, 10.0)
    >>> metric.update(2.0, 2.0)
    >>> metric.compute().item()
    0.25
    >>> metric.describe()
    'seconds of computing for one second of speech, added up over clips, on one core [1]'
    """

    higher_is_better = False
    needs = ("time",)
    inferred: ClassVar[Inferred] = {"hardware": lambda _: "unknown hardware"}
    seconds: Tensor

    def __init__(self, hardware: str, **options: Unpack[ProcessOptions]) -> None:
        definition = f"seconds of computing for one second of speech, added up over clips, on {hardware} [1]"
        super().__init__(definition=definition, **options)
        self.hardware = hardware
        self.add_state("seconds", torch.zeros(2, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, computing: float | Tensor, speech: float | Tensor) -> None:
        """Add a clip or several.

        Args:
            computing: seconds it took, not negative; a number or one for each clip.
            speech: seconds of speech, positive; as many as ``computing``.
        """
        device = self.seconds.device
        times = [torch.as_tensor(value, device=device).double().reshape(-1) for value in (computing, speech)]
        took, duration = times
        sensible = took.shape == duration.shape and took.isfinite().all() and duration.isfinite().all()
        if not sensible or bool((took < 0).any() | (duration <= 0).any()):
            raise ValueError(f"computing {took.tolist()} and speech {duration.tolist()} must be positive seconds")
        self.seconds = self.seconds + torch.stack([took.sum(), duration.sum()])

    @contextmanager
    def measure(self, speech: float) -> Iterator[None]:
        """Time the body of ``with`` and add it; work on GPUs is waited for before and after."""
        _wait_for_gpus()
        start = time.perf_counter()
        yield
        _wait_for_gpus()
        self.update(time.perf_counter() - start, speech)

    def compute(self) -> Tensor:
        """The factor over all clips so far, a float64 scalar."""
        computing, speech = self.seconds
        if float(speech) == 0:
            self.leave_synchronised_state()
            raise ValueError("RealTimeFactor has no clip; call update before compute")
        return computing / speech


real_time_factor = functional(RealTimeFactor)


def device_name(device: torch.device | str) -> str:
    """Name of a device: the GPU's product name, or the processor with torch's number of threads."""
    device = torch.device(device)
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type != "cpu":
        return str(device)
    processor = platform.processor() or platform.machine() or "CPU"
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as lines:
        names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        processor = next(names, processor)
    return f"{processor}, {counted(torch.get_num_threads(), 'thread')}"


def _wait_for_gpus() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
