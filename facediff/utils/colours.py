"""Colours as screens take them, sRGB, and as light adds up, linear (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float32 = npt.NDArray[np.float32]


def to_linear(srgb: npt.ArrayLike) -> Float32:
    """SRGB values from 0 to 1 as linear light."""
    values = np.asarray(srgb, dtype=np.float64)
    linear = np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def to_srgb(linear: npt.ArrayLike) -> Float32:
    """Linear light from 0 to 1 as sRGB."""
    values = np.clip(np.asarray(linear, dtype=np.float64), 0, 1)
    srgb = np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)
    return srgb.astype(np.float32)
