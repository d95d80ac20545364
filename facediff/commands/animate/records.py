"""What a batch has made of which recording with which options: one small file beside each output."""

from __future__ import annotations

import glob
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError
from facediff.files import atomic, sha256

STATE = ".facediff-batch"
"""Folder in the output's folder."""
LOCK = "lock"


@dataclass(frozen=True)
class Recipe:
    """What decides an output, beside the recording.

    Attributes:
        command: the options.
        files: SHA-256 of what they name (checkpoint, styles …), by path.
    """

    command: tuple[str, ...]
    files: Mapping[str, str]

    @classmethod
    def of(cls, command: Sequence[str], files: Sequence[Path]) -> Recipe:
        """Read the files.

        Raises:
            FaceDiffError: if one is not there.
        """
        for path in files:
            if not path.is_file():
                raise FaceDiffError(f"{path}: no such file")
        return cls(tuple(command), {str(path): sha256(path) for path in files})


def record_file(output: Path) -> Path:
    """Where the record of an output lies."""
    return output.parent / STATE / f"{output.name}.json"


def read_record(output: Path) -> dict[str, Any] | None:
    """The record of an output; None if there is none, or it cannot be read."""
    try:
        record = json.loads(record_file(output).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and isinstance(record.get("speech"), dict) else None


def write_record(speech: Path, output: Path, recipe: Recipe, problem: str) -> None:
    """Write down what has become of a recording; an empty problem means that the output is there.

    Raises:
        FaceDiffError: if it cannot be written.
    """
    record = {
        "speech": _facts(speech) | {"sha256": sha256(speech) if speech.is_file() else ""},
        "recipe": asdict(recipe) | {"command": list(recipe.command), "files": dict(recipe.files)},
        "output_bytes": None if problem else output.stat().st_size,
        "problem": problem,
    }
    with atomic(record_file(output)) as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _facts(speech: Path) -> dict[str, Any]:
    try:
        stat = speech.stat()
    except OSError:
        return {"path": str(speech.resolve())}
    return {"path": str(speech.resolve()), "bytes": stat.st_size, "modified_ns": stat.st_mtime_ns}


def difference(record: Mapping[str, Any], speech: Path, output: Path, recipe: Recipe) -> str:
    """What has changed since a record was written, in words; empty if nothing has."""
    before = record.get("recipe") or {}
    if before.get("command") != list(recipe.command):
        return "the options have changed"
    known = before.get("files") or {}
    for path, digest in recipe.files.items():
        if known.get(path) != digest:
            return f"{path} has changed"
    if known.keys() != recipe.files.keys():
        return "the options have changed"
    if not _same_speech(record["speech"], speech):
        return "the recording has changed"
    if not record.get("problem") and not (output.is_file() and output.stat().st_size == record.get("output_bytes")):
        return "the output is gone or damaged"
    return ""


def _same_speech(known: Mapping[str, Any], speech: Path) -> bool:
    """By place, size and time; where place or time differ, by the bytes."""
    facts = _facts(speech)
    if all(known.get(name) == value for name, value in facts.items()):
        return True
    return speech.is_file() and known.get("bytes") == facts.get("bytes") and known.get("sha256") == sha256(speech)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep a second batch out of an output folder; one that was killed keeps nobody out.

    Raises:
        FaceDiffError: if another batch is at work there, or the folder cannot be made.
    """
    state = folder / STATE
    try:
        state.mkdir(parents=True, exist_ok=True)
        stream = (state / LOCK).open("w")
    except OSError as error:
        raise FaceDiffError(
            f"{folder}: cannot be written ({error.strerror}); choose a folder that you may write to"
        ) from error
    with stream:
        try:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FaceDiffError(f"{folder}: another `facediff animate` is at work here; wait for its end") from error
        except (ImportError, OSError):
            pass  # Windows, or a network disk without locks: two runs at once are the user's lookout
        yield


def sweep(output: Path) -> None:
    """Remove what a killed run left half-written of an output."""
    for leftover in output.parent.glob(f".{glob.escape(output.stem)}.partial-*"):
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink(missing_ok=True)
