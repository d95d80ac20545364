"""``manifest.json`` of a corpus folder: its version, its format, and facts such as the frame rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from facediff.errors import FaceDiffError
from facediff.utils.limits import FRAME_RATES, check_format
from facediff.utils.plain_files import load_json
from facediff.utils.ranges import Range
from facediff.utils.records import Text, read_record

FORMAT = 1
"""Goes up when a field changes its meaning; new fields do not count. Folders without the field are of format 1."""

REMEDY = "prepare the folder again, or remove the file"
LONGEST = 200
"""Longest text or name of an identity, in characters: they are repeated in messages, checkpoints and file names."""
ShortText = Annotated[str, Text(r"[^\x00-\x1f\x7f-\x9f]*", "a short text", LONGEST)]


@dataclass(frozen=True)
class Manifest:
    """The fields of a manifest that are read by name; it may have others."""

    frame_rate: Annotated[float, Range(*FRAME_RATES)] | None = None
    n_vertices: Annotated[int, Range(1, 10**9)] | None = None
    corpus: ShortText = ""
    person: ShortText = ""
    unit: ShortText = ""
    files: Mapping[str, Any] = field(default_factory=dict)
    failed: Mapping[str, Any] = field(default_factory=dict)


def load_manifest(path: Path, *, remedy: str = REMEDY) -> dict[str, Any]:
    """The object in a manifest, or in the state of a preparation that is running."""
    manifest = load_json(path, remedy=remedy)
    if not isinstance(manifest, dict):
        raise FaceDiffError(f"{path}: holds no JSON object; {remedy}")
    check_format(path, manifest.get("format", FORMAT), FORMAT)
    return manifest


def read_manifest(root: Path) -> dict[str, Any]:
    """``manifest.json`` of a folder, its fields checked; empty if there is none."""
    path = root / "manifest.json"
    if not path.is_file():
        return {}
    manifest = load_manifest(path)
    read_record(Manifest, manifest, path, remedy=REMEDY, strict=False)
    return manifest


def refuse_interrupted(root: Path) -> None:
    """Refuse a folder that its preparation has not finished."""
    if (root / "prepare.json").is_file() and not (root / "manifest.json").is_file():
        raise FaceDiffError(
            f"{root}: its preparation was interrupted (prepare.json is there, manifest.json is not); run the same "
            f"`facediff data prepare` again to continue it"
        )
