"""Weights of blendshapes, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from facediff.blendshapes.arkit import absent_from, beyond_arkit

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Weights:
    """What :func:`facediff.blendshapes.solve` found.

    Attributes:
        names: K names.
        values: (T, K) weights.
        residual_rms_mm: (T,) root-mean-square distance that each frame's vertices are left with, in millimetres.
        residual_max_mm: (T,) greatest such distance.
        amplitude_mm: the motion's own size: root-mean-square distance of all vertices in all frames from the template.
        frame_rate: frames a second.
        still: names whose shape moves no vertex, and whose weight therefore says nothing.
        metadata: the take's, and how the weights were solved for.
    """

    names: tuple[str, ...]
    values: Array
    residual_rms_mm: Array
    residual_max_mm: Array
    amplitude_mm: float
    frame_rate: float
    still: tuple[str, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of ARKit's that had no shape, in ARKit's order."""
        return absent_from(self.names)

    @property
    def extra(self) -> tuple[str, ...]:
        """Names that are not ARKit's."""
        return beyond_arkit(self.names)

    @property
    def residual_share(self) -> Array:
        """(T,) each frame's residual as a share of the motion's amplitude; zero for a motion that stands still."""
        if self.amplitude_mm <= 0:
            return np.zeros_like(self.residual_rms_mm)
        return self.residual_rms_mm / self.amplitude_mm
