"""What every metric shares: a definition in words, and sums that keep their precision."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Self

import torch
from torch import Tensor
from torchmetrics import Metric


class ExactMetric(Metric):
    """A metric that says what its number is and whose sums stay in float64.

    Args:
        definition: The metric in plain words, with its options.
        settings: Further options that tell the metric from others but need not be told.
        **kwargs: Passed on to `torchmetrics.Metric` (``process_group``, ``sync_on_compute`` …).
    """

    full_state_update = False
    is_differentiable = False

    def __init__(self, *, definition: str, settings: str, **kwargs: object) -> None:
        super().__init__(**kwargs)
        self.definition = definition
        # A MetricCollection merges metrics whose states have the same names and were nearly equal after the
        # first batch; a signed and an absolute deviation would be taken for one. A name of its own prevents
        # this.
        told = f"{type(self).__name__}: {definition}; {settings}"
        mark = hashlib.sha256(told.encode()).hexdigest()[:16]
        self.add_state(f"definition_{mark}", torch.zeros(1, dtype=torch.int64), dist_reduce_fx="sum")

    def describe(self) -> str:
        """The metric's definition in plain words."""
        return self.definition

    def leave_synchronised_state(self) -> None:
        """To be called before `compute` raises: torchmetrics would keep the states of all processes."""
        if self._is_synced:
            self.unsync()

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> Self:
        """Follow moves to another device but keep float64: ``.to(torch.bfloat16)`` would ruin the sums."""

        def move_only(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return moved if moved.dtype == tensor.dtype else tensor.to(moved.device)

        super()._apply(move_only, exclude_state)
        return self
