"""Checksums and sizes of files, as manifests record them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from facediff.errors import damaged
from facediff.utils.jobs import run_tasks


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with damaged(f"{path}: cannot be read", "check who may read it", OSError), path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_of(content: object) -> str:
    """SHA-256 of plain data with sorted keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def describe_files(
    folder: Path, names: Iterable[str] | None = None, *, workers: int = 1, progress: str = ""
) -> dict[str, dict[str, int | str]]:
    """Size and SHA-256 of files as manifests record them, ``{"bytes": …, "sha256": …}`` by name, sorted.

    ``names`` are paths relative to the folder; None stands for all files in it and its subfolders.
    """
    if names is None:
        names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    ordered = sorted(names)
    digests = dict(
        run_tasks(lambda name: sha256(folder / name), ordered, workers=workers, mode="threads", progress=progress)
    )
    return {name: {"bytes": (folder / name).stat().st_size, "sha256": digests[name]} for name in ordered}


def file_stamps(folder: Path) -> list[tuple[str, int, int]]:
    """Path, size and time of every file below a folder, sorted: they tell a change without reading the files."""
    files = ((path, path.stat()) for path in folder.rglob("*") if path.is_file())
    return sorted((path.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns) for path, stat in files)


def same_sizes(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether all files that a manifest describes are there with their sizes; their content is not read."""
    try:
        return all((folder / name).stat().st_size == facts["bytes"] for name, facts in files.items())
    except (OSError, KeyError, TypeError):
        return False
