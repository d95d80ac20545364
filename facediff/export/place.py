"""Where exported files go: names, what may be overwritten, and all of them at once or none."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from facediff.errors import FaceDiffError

MARK = b"facediff"
"""Stands near the start of every file that is written without having been named by the user."""

RECORD = "sequence.json"
"""The file that tells a folder of frames from any other folder."""


def numbered(path: Path, count: int) -> list[Path]:
    """One path per take: the path itself for one, ``NAME_take1.glb``, ``NAME_take2.glb`` … for several."""
    if count == 1:
        return [path]
    return [path.with_name(f"{path.stem}_take{index + 1}{path.suffix}") for index in range(count)]


def folder_of(path: Path) -> Path:
    """The folder of a sequence that was asked for as a file: ``hello.obj`` gives ``hello_obj``."""
    return path.with_name(f"{path.stem}_{path.suffix[1:]}")


def is_free(path: Path) -> bool:
    """Whether nothing lies there, or something that facediff wrote; of a folder, that nobody put anything else into.

    Raises:
        FaceDiffError: if what lies there cannot be read.
    """
    if not path.exists():
        return True
    try:
        if path.is_dir():
            files = list(path.iterdir())
            recorded = not files or (path / RECORD) in files
            return recorded and all(file.is_file() and is_free(file) for file in files)
        with path.open("rb") as stream:
            return MARK in stream.read(200)
    except OSError as error:
        raise FaceDiffError(
            f"{path}: is in the way and cannot be read ({error.strerror}); choose another -o"
        ) from error


def check_free(path: Path) -> None:
    """Refuse a file or folder that the user did not name, where something lies that facediff did not write.

    Raises:
        FaceDiffError: naming what lies there.
    """
    if not is_free(path):
        what = "is a folder with files" if path.is_dir() else "is a file"
        raise FaceDiffError(
            f"{path}: {what} that facediff did not write, and would be replaced; choose another -o, or move it"
        )


@contextmanager
def staged(path: Path) -> Iterator[Path]:
    """A hidden folder beside ``path``; whatever is in it at the end moves beside ``path``, all of it or nothing.

    Raises:
        FaceDiffError: if the place cannot be written, the disk is full, or a folder is in the way.
    """
    parent = path.parent
    made = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    hidden = parent / f".{path.stem}.partial-{os.getpid()}-{secrets.token_hex(4)}"
    done = False
    try:
        parent.mkdir(parents=True, exist_ok=True)
        hidden.mkdir()
        yield hidden
        arrivals = sorted(hidden.iterdir())
        for arrival in arrivals:
            if (parent / arrival.name).is_dir() != arrival.is_dir() and (parent / arrival.name).exists():
                raise FaceDiffError(f"{parent / arrival.name}: is in the way; move it, or choose another -o")
        for arrival in arrivals:
            _move(arrival, parent / arrival.name)
        done = True
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror or error}); nothing was left there, so make room or choose "
            f"another folder"
        ) from error
    except FaceDiffError as error:
        # A writer that was handed the hidden folder names it; people know their own.
        if str(hidden) not in str(error):
            raise
        raise FaceDiffError(str(error).replace(str(hidden), str(parent))) from error
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        for folder in [] if done else made:
            with suppress(OSError):
                folder.rmdir()


def _move(source: Path, target: Path) -> None:
    """Rename; a folder of an earlier export steps aside and is removed after."""
    if not target.is_dir():
        os.replace(source, target)
        return
    aside = source.with_name(f"{source.name}.old")
    os.rename(target, aside)
    try:
        os.rename(source, target)
    except OSError:
        os.rename(aside, target)
        raise


def record(facts: dict[str, object]) -> bytes:
    """The content of :data:`RECORD`."""
    return json.dumps({"format": "facediff sequence 1", **facts}, ensure_ascii=False, indent=1).encode()
