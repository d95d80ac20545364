"""A budget for what a constructor allocates, where its arguments come from an untrusted file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from facediff.errors import FaceDiffError

SPARE_BYTES = 256 * 2**20
"""What a constructor may allocate for anything but weights: tables, windows, temporary copies."""

SPARE_CALLS = 2_000
"""Operations that a constructor may run in addition to those of its weights."""


class AllocationBudget(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Stops a constructor that allocates far more than the weights that belong to it.

    A model of 10⁶ layers, or of 10⁹ channels, is one number in a file. The weights in the same file say how large the
    model can be.

    Args:
        source: the file, for messages.
        bytes: what may be allocated, in total.
        calls: how many operations may run.
    """

    def __init__(self, source: object, bytes: int, calls: int) -> None:  # noqa: A002 - the limit's name
        super().__init__()  # type: ignore[no-untyped-call]
        self._source, self._bytes, self._calls = source, bytes, calls

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # noqa: ANN401
        """Count an operation, and the numbers that it makes, before it runs."""
        self._calls -= 1
        # Eight bytes for each number: the type may be a default, and twice the weights is within the budget.
        self._bytes -= 8 * numbers_made(func.overloadpacket._qualified_op_name, args)
        if self._calls < 0 or self._bytes < 0:
            raise FaceDiffError(
                f"{self._source}: its options ask for a model that is much larger than its weights; the file is damaged"
            )
        return func(*args, **(kwargs or {}))


def numbers_made(name: str, values: Sequence[Any]) -> int:
    """How many numbers an operation makes that it was not given: by sizes, by counts, or by broadcasting."""
    short = name.removeprefix("aten::").removeprefix("new_")
    if short in ("empty", "zeros", "ones", "full", "rand", "randn", "randint", "empty_strided", "repeat"):
        return max((math.prod(max(0, int(n)) for n in v) for v in values if isinstance(v, list | tuple)), default=0) * (
            max(1, values[0].numel()) if short == "repeat" else 1
        )
    if short in ("linspace", "logspace"):
        return int(values[2])
    if short == "arange":
        start, end, step = (0, *values, 1) if len(values) == 1 else (*values, 1)[:3]
        return int(abs((end - start) / step)) + 1
    if short in ("eye", "randperm"):
        return math.prod(int(n) for n in values[:2]) ** (2 if short == "eye" and len(values) == 1 else 1)
    shapes = [value.shape for value in values if isinstance(value, Tensor)]
    if len(shapes) < 2 or short.endswith("_"):  # in place
        return 0
    try:
        return math.prod(torch.broadcast_shapes(*shapes))  # type: ignore[no-untyped-call]
    except RuntimeError:  # a product of matrices
        return math.prod(shapes[-2][:-1]) * shapes[-1][-1] if shapes[-1] else 0


@contextmanager
def allocation_budget(source: object, weights: Iterable[Tensor]) -> Iterator[None]:
    """Within it, no more is allocated than a model with these weights can need.

    Raises:
        FaceDiffError: naming the file, as soon as it is more.
    """
    kept = list(weights)
    numbers = sum(weight.numel() for weight in kept)
    with AllocationBudget(source, 32 * numbers + SPARE_BYTES, 20 * len(kept) + SPARE_CALLS):
        yield
