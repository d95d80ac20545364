"""What the benchmarks say about the machine that they run on."""

from __future__ import annotations

import os
import platform
import resource
import sys
from importlib.metadata import version
from pathlib import Path

import torch


def machine(device: str = "cpu") -> str:
    """Processor, accelerator, load, threads and versions, in one line."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    if device.startswith("cuda"):
        name += f"; {torch.cuda.get_device_name(device)}"
    packages = ", ".join(f"{package} {version(package)}" for package in ("torch", "transformers", "lightning"))
    return (
        f"machine: {name}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; "
        f"{torch.get_num_threads()} threads; device {device}; Python {platform.python_version()}, {packages}"
    )


def peak_memory(device: str = "cpu") -> str:
    """Most memory that the process has held so far."""
    # Linux counts in KiB, macOS in bytes.
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
    text = f"{size:.2f} GiB resident"
    if device.startswith("cuda"):
        text += f", {torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB on the device"
    return text
