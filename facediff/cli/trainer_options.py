"""Options of the trainer that fail silently and are refused, and warnings of Lightning that are not shown."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from facediff.errors import ArgumentError

HALF = ("bf16-true", "16-true", "transformer-engine", "transformer-engine-float16")
"""Lightning's precisions with weights of 16 bits."""


def check_trainer(options: Mapping[str, Any], command: str = "fit") -> None:
    """Refuse options that Lightning accepts and that make a run worthless; ``command`` is fit, validate and so on."""
    limit = f"limit_{ {'fit': 'train', 'validate': 'val'}.get(command, command) }_batches"
    precision, clipping = options.get("precision"), options.get("gradient_clip_val") or 0
    refused = {
        "precision": (precision in HALF, "losses and the last map of a model need float32; expected bf16-mixed, "
                      "16-mixed or 32-true"),
        "gradient_clip_val": (not 0 <= clipping < float("inf"), "expected a number of at least 0"),
        limit: (options.get(limit) == 0, "leaves no batch; give 1 or more, or fast_dev_run for a trial"),
    }  # fmt: skip
    for name, (is_wrong, reason) in refused.items():
        if is_wrong:
            raise ArgumentError({f"trainer.{name}": options[name]}, reason, located=True)


IDLE_WARNINGS = (
    # Reading is cheap (memory-mapped motion), so worker processes would only add their start-up time.
    ".*does not have many workers",
    # Lightning 2.6.6 calls a spelling that torch 2.13 deprecates.
    ".*isinstance.treespec, LeafSpec.*",
    # The throughput monitor is there for clips a second.
    ".*define a `flops_per_batch` attribute",
    # A config without a seed gets 0, and its run folder says so.
    "No seed found, seed set to 0",
    # Frozen layers are in evaluation mode on purpose: no dropout.
    r"Found \d+ module\(s\) in eval mode at the start of training",
)
"""Warnings of Lightning that need no action."""


@contextmanager
def without_warnings(*messages: str) -> Iterator[None]:
    """A context without warnings that begin with one of these patterns, and without Lightning's advertisements."""
    log = logging.getLogger("lightning.pytorch.utilities.rank_zero")
    log.addFilter(_no_advertisement)
    with warnings.catch_warnings():
        for message in messages:
            warnings.filterwarnings("ignore", message)
        try:
            yield
        finally:
            log.removeFilter(_no_advertisement)


def _no_advertisement(record: logging.LogRecord) -> bool:
    return "try installing [lit" not in record.getMessage()
