"""Writing files so that a reader sees all of a file or nothing of it."""

from __future__ import annotations

import csv
import hashlib
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError


def cache_dir() -> Path:
    """Where things are kept that can be made anew: ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    return Path(os.environ.get("FACEDIFF_CACHE") or Path.home() / ".cache" / "facediff")


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary sibling to write to, renamed to ``path`` at the end; removed if anything fails.

    The temporary name keeps the suffix, since many writers choose the format by it.

    Raises:
        FaceDiffError: if the folder cannot be made or written.
    """
    # Containers that share a folder may have equal process numbers.
    temporary = path.with_name(f".{path.stem}.partial-{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror or error}); choose a folder that you may write to"
        ) from error
    finally:
        with suppress(OSError):  # not there, or below something that is no folder: the error above says it
            temporary.unlink()


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_writable(path: Path) -> None:
    """Make sure, before any work is done, that a file can be written; leaves nothing behind.

    Raises:
        FaceDiffError: if the folder cannot be made or written, or if the path is a folder.
    """
    if path.is_dir():
        raise FaceDiffError(f"{path}: is a folder; expected the name of a file to write")
    probe = path.with_name(f".{path.stem}.probe-{os.getpid()}")
    made = [folder for folder in path.parents if not folder.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror}); choose a folder you may write to"
        ) from error
    finally:
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows of equal keys as CSV, whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


# Where the shipped configs are: inside an installed package, beside it in a checkout.


def config_dir() -> Path:
    """The folder that holds ``experiment/``, ``model/``, ``data/`` and ``trainer/``."""
    package = Path(__file__).parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"
