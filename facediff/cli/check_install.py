"""``facediff check-install``: versions and devices, and a trial of the bundled model."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
import time
from typing import TYPE_CHECKING

from facediff.cli.process import tell
from facediff.errors import FaceDiffError, printable, shortened

if TYPE_CHECKING:
    from facediff.animation import Animation

PACKAGES = ("numpy", "onnxruntime", "torch", "torchmetrics", "lightning", "transformers", "scipy", "trimesh")
"""Packages with versions that a bug report needs."""
SECONDS = 10
"""Length of the trial animation."""


def check_install() -> None:
    """Print versions and devices, and animate ten seconds with the bundled model.

    Paste its output into a bug report. The exit status is 2 where the base installation does not work.
    """
    from facediff.version import __version__

    tell(f"facediff {__version__} in {os.path.dirname(os.path.dirname(os.path.abspath(__file__)))}")
    tell(f"Python {platform.python_version()} ({sys.executable}) on {platform.platform()}")
    versions = {name: version for name in PACKAGES if (version := version_of(name))}
    tell("packages: " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    tell(f"devices: {devices()}")
    started = time.monotonic()
    try:
        animation = trial()
    except Exception as error:  # a damaged installation may raise anything
        reason = shortened(printable(f"{type(error).__name__}: {error}"))
        raise FaceDiffError(
            f"the bundled model does not animate ({reason}); install facediff again in a new virtual environment"
        ) from error
    frames, vertices = animation.vertices.shape[:2]
    tell(
        f"trial: {SECONDS} s of sound animated by the bundled model in {time.monotonic() - started:.1f} s "
        f"({frames} frames of {vertices} vertices)"
    )
    tell("The base installation works.")


def trial() -> Animation:
    """Animate bursts of a tone."""
    import numpy as np

    import facediff
    from facediff.utils import SAMPLE_RATE
    from facediff.utils.hub import BUNDLED

    seconds = np.arange(SECONDS * SAMPLE_RATE) / SAMPLE_RATE
    speech = (0.3 * np.sin(2 * np.pi * 140 * seconds) * (np.sin(2 * np.pi * 3 * seconds) > 0)).astype(np.float32)
    model = facediff.load(BUNDLED)
    animation: Animation = model.animate(speech, SAMPLE_RATE)
    if len(animation.vertices) != round(SECONDS * animation.frame_rate) or not np.isfinite(animation.vertices).all():
        raise FaceDiffError(f"{animation.vertices.shape} for {SECONDS} s at {animation.frame_rate:g} frames a second")
    return animation


def version_of(package: str) -> str | None:
    """The installed version of a package; None if there is none."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def devices() -> str:
    """Processors, and PyTorch's other devices."""
    processors = f"{os.cpu_count()} processors ({platform.machine()})"
    try:
        import torch
    except (ImportError, OSError) as error:  # it is absent, or a library that it loads
        return f"{processors}; PyTorch cannot be imported ({shortened(printable(error))})"
    cards = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
    cards += ["Apple MPS"] if torch.backends.mps.is_available() else []
    return ", ".join([processors, *cards]) + ("" if cards else "; no graphics card for PyTorch")
