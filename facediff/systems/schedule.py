"""The learning rate over training."""

from __future__ import annotations

import math
from typing import Literal

Schedule = Literal["constant", "cosine"]


def lr_factor(step: int, *, total: int, warmup_steps: int, schedule: Schedule) -> float:
    """What the learning rate is multiplied by at an optimiser step.

    Args:
        step: the step, counted from 0.
        total: steps of the whole training.
        warmup_steps: steps over which the factor rises from zero.
        schedule: constant, or half a cosine down to zero at the end.
    """
    warm = min(1.0, (step + 1) / max(1, warmup_steps))
    if schedule == "constant":
        return warm
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / max(1, total))))
