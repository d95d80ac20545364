"""Looking at what ``facediff data prepare`` has recorded, and whether the files are still those."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from facediff.doctor.findings import Finding, counted, few, guarded
from facediff.errors import FaceDiffError
from facediff.files import sha256

MANIFEST = "manifest.json"
STATE = "prepare.json"
"""There while preparing is at work or was cut short."""


def read_record(root: Path, name: str, findings: list[Finding]) -> dict[str, Any]:
    """One of the two records; empty if there is none, or none that can be read."""
    path = root / name
    if path.is_file():
        with guarded(findings, "manifest_unreadable", path, root):
            try:
                record = json.loads(path.read_bytes())
            except (ValueError, RecursionError) as error:
                raise FaceDiffError(
                    f"not readable as JSON ({error}); prepare the folder anew, or remove the file"
                ) from error
            if not isinstance(record, dict):
                raise FaceDiffError("holds no JSON object; prepare the folder anew, or remove the file")
            return record
    return {}


def check_ended(root: Path, corpus: str | None, findings: list[Finding]) -> bool:
    """Whether preparing has ended, where it was begun at all."""
    if not (root / STATE).exists():
        return True
    findings.append(
        Finding(
            "error",
            "unfinished",
            STATE,
            f"preparing this folder has not ended: run the same `facediff data prepare {corpus or 'CORPUS'} RAW "
            f"{root}` again (it goes on where it was), or wait if it is at work",
        )
    )
    return False


def check_files(
    root: Path, manifest: Mapping[str, Any], hashes: Mapping[str, str], findings: list[Finding], *, quick: bool
) -> dict[str, list[str]]:
    """Hold the files against their sizes (``quick``), or their SHA-256, in ``manifest.json``.

    Args:
        root: the corpus folder.
        manifest: what it says.
        hashes: SHA-256 of the files that were read already.
        findings: what is wrong is added here.
        quick: compare sizes only.

    Returns:
        the names of the files that are not as recorded: ``changed`` and ``missing``.
    """
    files = manifest.get("files")
    found: dict[str, list[str]] = {"changed": [], "missing": []}
    if not isinstance(files, dict):
        return found
    for name, said in files.items():
        path = root / name
        if not isinstance(said, dict) or not _is_below(root, path):
            message = f'"{name}" is no entry of a file below the folder; prepare the folder anew'
            findings.append(Finding("error", "manifest_entry", MANIFEST, message))
            continue
        with guarded(findings, "file_unreadable", path, root):
            if not path.is_file():
                found["missing"].append(name)
                message = "is in manifest.json and is not there; prepare the folder anew"
                findings.append(Finding("error", "file_missing", name, message))
            elif not _is_as_recorded(path, said, hashes.get(name), quick=quick):
                found["changed"].append(name)
                message = "is not what was written (manifest.json): changed since, or damaged; prepare the folder anew"
                findings.append(Finding("error", "file_changed", name, message))
    return found


def _is_as_recorded(path: Path, said: Mapping[str, Any], known: str | None, *, quick: bool) -> bool:
    if path.stat().st_size != said.get("bytes"):
        return False
    return quick or (known or sha256(path)) == said.get("sha256")


def _is_below(root: Path, path: Path) -> bool:
    """Whether a name from the record stays in the folder: nothing else is opened on a stranger's word."""
    try:
        return path.resolve().is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError):
        return False


def check_account(manifest: Mapping[str, Any], findings: list[Finding]) -> None:
    """Tell what preparing itself has reported: clips that failed, and what the raw folder did not have."""
    failed, missing = manifest.get("failed"), manifest.get("missing")
    if isinstance(failed, dict) and failed:
        name, reason = next(iter(failed.items()))
        message = f"{counted(len(failed), 'clip')} could not be prepared, the first: {name}: {reason}"
        findings.append(Finding("warning", "prepare_failed", MANIFEST, message))
    if isinstance(missing, dict) and missing:
        message = f"the raw folder had not everything: {few(missing)}; the reasons are in {MANIFEST}"
        findings.append(Finding("note", "prepare_missing", MANIFEST, message))
