"""The trainer's options: their ranges, and what Lightning objects to, in one sentence that names the options."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

from facediff.errors import ArgumentError, FaceDiffError
from facediff.utils.hints import mismatch
from facediff.utils.ranges import Range

Batches = Annotated[int, Range(0)] | Annotated[float, Range(0, 1)] | None
Interval = Annotated[int, Range(1)] | Annotated[float, Range(0, 1, above=True)] | str | dict[str, int] | None
Epochs = Annotated[int, Range(-1)] | None

RANGES: dict[str, Any] = {
    "max_epochs": Epochs,
    "min_epochs": Annotated[int, Range(0)] | None,
    "max_steps": Annotated[int, Range(-1)],
    "min_steps": Annotated[int, Range(0)] | None,
    "num_nodes": Annotated[int, Range(1, 100_000)],
    "fast_dev_run": bool | Annotated[int, Range(0)],
    "limit_train_batches": Batches,
    "limit_val_batches": Batches,
    "limit_test_batches": Batches,
    "limit_predict_batches": Batches,
    "overfit_batches": Batches,
    "val_check_interval": Interval,
    "check_val_every_n_epoch": Annotated[int, Range(1)] | None,
    "num_sanity_val_steps": Annotated[int, Range(-1)] | None,
    "log_every_n_steps": Annotated[int, Range(0)] | None,
    "accumulate_grad_batches": Annotated[int, Range(1)],
    "gradient_clip_val": Annotated[float, Range(0)] | None,
    "reload_dataloaders_every_n_epochs": Annotated[int, Range(0)],
}
"""Types and ranges of those options whose wrong values Lightning takes, or reports after minutes."""

HALF = ("bf16-true", "16-true", "transformer-engine", "transformer-engine-float16")
"""Lightning's precisions whose weights are of 16 bits."""

PROCESSES = 4
"""Processes for each processor core that are believed to be meant."""


def check_trainer(options: Mapping[str, Any], prefix: str = "trainer.") -> None:
    """Refuse numbers that no training can have.

    Args:
        options: of the trainer.
        prefix: what stands before their names.

    Raises:
        ArgumentError: naming the option.
    """
    for name, hint in RANGES.items():
        expected = mismatch(hint, options[name]) if name in options else None
        if expected is not None:
            raise ArgumentError({f"{prefix}{name}": options[name]}, f"expected {expected}", located=True)
    if (precision := options.get("precision")) in HALF:
        raise ArgumentError(
            {f"{prefix}precision": precision},
            "the last map of a model and its losses need float32; expected bf16-mixed, 16-mixed or 32-true",
            located=True,
        )
    check_machine(options, prefix)
    devices, most = options.get("devices"), max(8, PROCESSES * (os.cpu_count() or 1))
    if options.get("accelerator") in ("cpu", "auto") and str(devices).isdecimal() and int(str(devices)) > most:
        raise ArgumentError(
            {f"{prefix}devices": devices},
            f"that many processes would be started; expected at most {most} on this machine's {os.cpu_count()} cores",
            located=True,
        )


SHARDED = ("fsdp", "deepspeed", "modelparallel")
"""What the names of strategies contain that spread one model over GPUs."""


def check_machine(options: Mapping[str, Any], prefix: str) -> None:
    """Refuse GPUs that are not there, and strategies that need them.

    Args:
        options: of the trainer.
        prefix: what stands before their names.

    Raises:
        ArgumentError: naming the option.
    """
    import torch

    accelerator, strategy = options.get("accelerator"), options.get("strategy")
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available() and not torch.backends.mps.is_available():
        raise ArgumentError(
            {f"{prefix}accelerator": accelerator},
            f"this machine has no GPU that PyTorch can use; give --{prefix}accelerator=cpu, or look "
            f"at `nvidia-smi` and at the build of PyTorch",
            located=True,
        )
    path = strategy if isinstance(strategy, str) else getattr(strategy, "class_path", None) or type(strategy).__name__
    name = str(path).rpartition(".")[2]
    sharded = any(word in name.lower().replace("_", "") for word in SHARDED)
    if sharded and (accelerator == "cpu" or not torch.cuda.is_available()):
        raise ArgumentError(
            {f"{prefix}strategy": name},
            f"spreads a model over GPUs, and this run has none; give --{prefix}strategy=ddp, which needs none",
            located=True,
        )


@contextmanager
def explained(options: Mapping[str, Any], prefix: str = "--trainer.") -> Iterator[None]:
    """A context in which a trainer is made, and Lightning's errors become one sentence.

    Args:
        options: the trainer's options.
        prefix: what the user writes before their names.
    """
    from lightning.fabric.utilities.exceptions import MisconfigurationException

    try:
        check_trainer(options, prefix.removeprefix("--"))
        yield
    except FaceDiffError:
        raise
    except (MisconfigurationException, ValueError, TypeError, RuntimeError, ImportError) as error:
        raise FaceDiffError(f"{spoken_of(str(error), options, prefix)}: {sentence_of(error)}") from error


def raised_in(error: BaseException, package: str) -> bool:
    """Whether the statement that raised an error is a package's."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and str(last.tb_frame.f_globals.get("__name__")).partition(".")[0] == package


def spoken_of(message: str, options: Mapping[str, Any], prefix: str) -> str:
    """The trainer's options that an error of Lightning's speaks of, with their values; ``--trainer`` if of none."""
    text = message.lower()
    # What is left to Lightning (null, auto) is no fault of the user's; a switch is where the error names it.
    chosen = {
        name: str(value).lower() if isinstance(value, bool) else value
        for name, value in options.items()
        if isinstance(value, str | int | float) and value != "auto" and (name in text or not isinstance(value, bool))
    }
    named = [name for name, value in chosen.items() if name in text or (isinstance(value, str) and value in text)]
    of_machine = [name for name in ("accelerator", "strategy", "devices", "precision") if name in chosen]
    return " ".join(f"{prefix}{name} {chosen[name]}" for name in (named or of_machine)[:3]) or "the trainer"


def sentence_of(error: BaseException) -> str:
    """A message on one line, no longer than a sentence or two."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else f"{text[:300]}…"


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
"""Warnings of Lightning's that nobody needs to act on."""


@contextmanager
def without_warnings(*messages: str) -> Iterator[None]:
    """A context without warnings that begin with one of these patterns, and without what Lightning advertises."""
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
