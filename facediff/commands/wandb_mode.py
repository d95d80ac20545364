"""Weights & Biases without a question and without waiting: offline where there is no key or no answer."""

from __future__ import annotations

import os
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping
from typing import Any

from facediff.errors import FaceDiffError, MissingExtraError

PATIENCE = 5.0
"""Seconds that the server has for its first answer."""


def settle_wandb_mode(trainer: Mapping[str, Any]) -> None:
    """Let a run that logs to Weights & Biases record offline where it could not upload.

    Without a key wandb asks a question and waits for an answer, and without a network it waits for a minute and a half
    and then fails. Here one line says why the run is offline and how it is uploaded later. Whoever has chosen a mode
    (``WANDB_MODE``, or ``offline: true``) gets that mode.

    Args:
        trainer: the trainer's options as parsed, before anything is made of them.

    Raises:
        FaceDiffError: if wandb is not installed or the key is no key.
    """
    from lightning.pytorch.utilities import rank_zero_only

    options = wandb_options(trainer)
    if options is None or getattr(rank_zero_only, "rank", None):  # other processes of a run log nothing
        return
    try:
        import wandb
    except ModuleNotFoundError as error:
        raise MissingExtraError("wandb", "wandb", "logging to Weights & Biases") from error
    if os.environ.get("WANDB_MODE") or options.get("offline") or wandb.run is not None:
        return
    silent = os.environ.get("WANDB_SILENT")
    os.environ.setdefault("WANDB_SILENT", "true")  # else a login is announced, for which wandb asks the server
    try:
        reason = why_offline()
    except (wandb.Error, ValueError) as error:
        raise FaceDiffError(
            f"wandb: {error}; put the key right (`wandb login --relogin`), or set WANDB_MODE=offline"
        ) from error
    wandb.teardown()  # what comes next reads the environment anew
    if reason is None:
        if silent is None:
            del os.environ["WANDB_SILENT"]  # the run's address is worth a line
        return
    os.environ["WANDB_MODE"] = "offline"
    folder = options.get("save_dir") or options.get("dir") or "."
    print(
        f"wandb: {reason}: the run is recorded offline; upload it later with `wandb sync {folder}/wandb/offline-run-*`",
        file=sys.stderr,
        flush=True,
    )


def wandb_options(trainer: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Options of the first logger that is a WandbLogger; None if there is none."""
    loggers = trainer.get("logger")
    for logger in loggers if isinstance(loggers, list) else [loggers]:
        if str(getattr(logger, "class_path", "")).endswith("WandbLogger"):
            return dict(getattr(logger, "init_args", None) or {})
    return None


def why_offline() -> str | None:
    """What stands in the way of uploading: no key, or no answer; None if nothing does."""
    import wandb

    if not wandb.login(prompt=False, verify=False):
        return "no API key found (`wandb login`, WANDB_API_KEY)"
    address = str(wandb.setup().settings.base_url)
    return None if answers(address) else f"{address} does not answer"


def answers(address: str, patience: float = PATIENCE) -> bool:
    """Whether a web server answers, with whatever but an error of its own; proxies of the environment are used.

    In a thread of its own, since looking up a name may take longer than any time limit of the connection.
    """
    heard = threading.Event()

    def ask() -> None:
        try:
            urllib.request.urlopen(address, timeout=patience).close()  # noqa: S310 (the user's own setting)
        except urllib.error.HTTPError as error:
            if error.code >= 500:  # a gateway whose server is down; "not found" is an answer
                return
        except (OSError, ValueError):
            return
        heard.set()

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(patience)
    return heard.is_set()
