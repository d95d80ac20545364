"""Units of length: what a corpus or an animation calls its unit, in metres."""

from __future__ import annotations

import re

from facediff.errors import FaceDiffError
from facediff.utils.limits import brief

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
UNITS = (1e-9, 1e9)
"""Metres that a unit of length may have."""
_ABOUT = re.compile(r"about ([0-9.]+) mm\b")


def metres_per_unit(unit: str) -> float:
    """Metres in one unit of length.

    Args:
        unit: ``m``, ``cm``, ``mm``, ``in``, a number of metres, or a description with "about … mm", such as that of a
            corpus whose faces were normalised.

    Raises:
        FaceDiffError: if it is none of these.

    Example:
        >>> metres_per_unit("mm"), metres_per_unit("normalised (about 185 mm)")
        (0.001, 0.185)
    """
    about = _ABOUT.search(unit)
    try:
        value = float(about[1]) / 1000 if about else METRES.get(unit) or float(unit)
    except ValueError:
        value = 0.0
    if not UNITS[0] <= value <= UNITS[1]:
        raise FaceDiffError(
            f'unit "{brief(unit) if unit else ""}": expected one of {", ".join(METRES)}, or a number of metres from '
            f"{UNITS[0]:g} to {UNITS[1]:g}"
        )
    return value
