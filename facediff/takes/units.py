"""How long a corpus's unit of length is."""

from __future__ import annotations

import re

from facediff.errors import FaceDiffError

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_ABOUT = re.compile(r"about ([0-9.]+) mm\b")


def metres_per_unit(unit: str) -> float:
    """Metres in one unit of length.

    Args:
        unit: ``m``, ``cm``, ``mm``, ``in``, a number of metres, or a description that says "about … mm", as that of a
            corpus whose faces were normalised.

    Raises:
        FaceDiffError: if it is none of these.
    """
    about = _ABOUT.search(unit)
    try:
        value = float(about[1]) / 1000 if about else METRES.get(unit) or float(unit)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise FaceDiffError(f'unit "{unit}": expected one of {", ".join(METRES)}, or a number of metres above 0')
    return value
