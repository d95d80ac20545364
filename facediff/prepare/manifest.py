"""The records that preparing keeps in its output folder: one while it is at work, one when it has ended."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError
from facediff.files import atomic, sha256
from facediff.prepare.job import Plan

STATE = "prepare.json"
"""There while preparing is at work or was cut short."""
MANIFEST = "manifest.json"
"""There when it has ended: what was written, what is missing, what failed."""


def version() -> str:
    """Version of the installed facediff."""
    try:
        return metadata.version("facediff")
    except metadata.PackageNotFoundError:  # run from a source tree on the path
        return "unknown"


def recipe(plan: Plan) -> dict[str, Any]:
    """What decides the bytes that are written; a run may be taken up only with the same."""
    return {"facediff": version(), "corpus": plan.corpus, "options": json.loads(json.dumps(plan.options))}


def read_record(path: Path) -> dict[str, Any] | None:
    """A record, or None if there is none.

    Raises:
        FaceDiffError: if the file is no record of this program.
    """
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise FaceDiffError(
            f"{path}: cannot be read ({error}); remove {path.parent}, or choose another folder"
        ) from error
    if not isinstance(record, dict) or not {"corpus", "options"} <= set(record):
        raise FaceDiffError(f"{path}: not written by `facediff data prepare`; choose another folder to write to")
    return record


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write a record atomically."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def refuse_other_recipe(out: Path, record: dict[str, Any], plan: Plan) -> None:
    """Refuse to mix what was written with other options, or by another version, with what this plan writes.

    Raises:
        FaceDiffError: naming what differs.
    """
    now = recipe(plan)
    before: dict[str, Any] = {"facediff": record.get("facediff"), "corpus": record["corpus"]}
    wanted = {"facediff": now["facediff"], "corpus": now["corpus"]}
    before |= {f"--{name.replace('_', '-')}": value for name, value in dict(record["options"]).items()}
    wanted |= {f"--{name.replace('_', '-')}": value for name, value in now["options"].items()}
    differ = [name for name in {**before, **wanted} if before.get(name) != wanted.get(name)]
    if differ:
        words = "; ".join(f"{name} was {_word(before.get(name))} and is {_word(wanted.get(name))}" for name in differ)
        raise FaceDiffError(
            f"{out}: was begun with other settings ({words}); use the same, choose another folder, or remove this one"
        )


def _word(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def describe_files(
    out: Path, files: Iterable[str], workers: int, step: Callable[[], object]
) -> dict[str, dict[str, int | str]]:
    """Size and SHA-256 of files, given by path relative to ``out``; ``step`` is called after each."""

    def describe(name: str) -> tuple[str, dict[str, int | str]]:
        path = out / name
        digest = sha256(path)
        step()
        return name, {"bytes": path.stat().st_size, "sha256": digest}

    # Threads are enough: hashing leaves the interpreter's lock alone.
    with ThreadPoolExecutor(workers) as pool:
        return dict(pool.map(describe, sorted(files)))


def same_sizes(out: Path, record: dict[str, Any]) -> bool:
    """Whether every file of a manifest is there with its size; contents are not read."""
    files: dict[str, dict[str, Any]] = record.get("files", {})
    return all(
        (out / name).is_file() and (out / name).stat().st_size == facts["bytes"] for name, facts in files.items()
    )


def manifest(
    plan: Plan, clips: dict[str, int], failed: dict[str, str], files: dict[str, dict[str, int | str]]
) -> dict[str, Any]:
    """The final record. Nothing in it depends on the time or the way in which the files were made."""
    frames = sum(clips.values())
    return {
        **recipe(plan),
        "frame_rate": plan.frame_rate,
        "unit": plan.unit,
        "n_vertices": plan.n_vertices,
        "totals": {
            "clips": len(clips),
            "frames": frames,
            "seconds": round(frames / plan.frame_rate, 3),
            "bytes": sum(int(facts["bytes"]) for facts in files.values()),
        },
        "clips": dict(sorted(clips.items())),
        "missing": plan.missing,
        "failed": dict(sorted(failed.items())),
        "notes": plan.notes,
        "files": files,
    }
