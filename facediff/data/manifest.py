"""``manifest.json`` of a corpus folder: its version, its format, and facts such as the frame rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES, check_format, quoted
from facediff.utils.plain_files import load_json

FORMAT = 1
"""Goes up when a field changes its meaning; new fields do not count. Folders without the field are of format 1."""

REMEDY = "prepare the folder again, or remove the file"
TEXTS = ("corpus", "person", "unit")
LONGEST = 200
"""Longest such text or name of an identity, in characters: they are repeated in messages, checkpoints and file
names."""


def load_manifest(path: Path, *, remedy: str = REMEDY) -> dict[str, Any]:
    """The object in a manifest, or in the state of a preparation that is running.

    Args:
        path: the file.
        remedy: what messages advise.
    """
    manifest = load_json(path, remedy=remedy)
    if not isinstance(manifest, dict):
        raise FaceDiffError(f"{path}: holds no JSON object; {remedy}")
    check_format(path, manifest.get("format", FORMAT), FORMAT)
    return manifest


def read_manifest(root: Path) -> dict[str, Any]:
    """``manifest.json`` of a folder, its facts checked; empty if there is none."""
    path = root / "manifest.json"
    if not path.is_file():
        return {}
    manifest = load_manifest(path)
    if manifest.get("frame_rate") is not None:
        check_number(path, "frame_rate", manifest["frame_rate"], *FRAME_RATES, remedy=REMEDY)
    if manifest.get("n_vertices") is not None:
        check_number(path, "n_vertices", manifest["n_vertices"], 1, whole=True, remedy=REMEDY)
    for field in TEXTS:
        text = manifest.get(field, "")
        if text is not None and not (isinstance(text, str) and text.isprintable() and len(text) <= LONGEST):
            raise FaceDiffError(f"{path}: {field} is {quoted(text)}; expected a short text; {REMEDY}")
    return manifest
