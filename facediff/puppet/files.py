"""Writing a folder of files as one: complete or not there at all."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facediff.files import sha256

_OWNER = ".owner"
_FORGOTTEN_AFTER = 86_400.0


@contextmanager
def folder_as_a_whole(root: Path) -> Iterator[Path]:
    """Lend a sibling folder to write into and rename it to ``root`` when the block ends without an error.

    Args:
        root: The folder that shall appear; a folder that is there already is replaced.

    Yields:
        The folder ``ROOT.partial-PID`` to fill. It is removed if the block fails; one left behind by a
        process that was killed is removed by the next writer.
    """
    root.parent.mkdir(parents=True, exist_ok=True)
    _sweep(root)
    partial = root.with_name(f"{root.name}.partial-{os.getpid()}")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    (partial / _OWNER).write_text(socket.gethostname())
    try:
        yield partial
        (partial / _OWNER).unlink()
        _put_in_place(partial, root)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _put_in_place(partial: Path, root: Path) -> None:
    """Rename, moving an older folder out of the way first."""
    old = root.with_name(f"{root.name}.replaced-{os.getpid()}")
    if root.exists():
        # Another process may move it away at the same time: then there is nothing left to move.
        try:
            root.rename(old)
        except FileNotFoundError:
            old = partial
    try:
        partial.rename(root)
    except OSError:
        # Another process was quicker. Its folder has the same contents, so this one is not needed.
        if not (root / "manifest.json").is_file():
            raise
    finally:
        if old != partial:
            shutil.rmtree(old, ignore_errors=True)


def _sweep(root: Path) -> None:
    """Remove what killed processes left behind, on this machine or more than a day ago."""
    for kind in ("partial", "replaced"):
        for leftover in root.parent.glob(f"{root.name}.{kind}-*"):
            pid = leftover.name.rpartition("-")[2]
            owner = leftover / _OWNER
            try:
                age = time.time() - leftover.stat().st_mtime
                here = owner.is_file() and owner.read_text() == socket.gethostname()
            except OSError:
                continue
            if age > _FORGOTTEN_AFTER or (here and pid.isdigit() and not _is_alive(int(pid))):
                shutil.rmtree(leftover, ignore_errors=True)


def _is_alive(pid: int) -> bool:
    """Say whether a process runs; where one cannot ask without harm, say yes."""
    if os.name != "posix":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def write_manifest(folder: Path, facts: dict[str, Any]) -> None:
    """Write ``manifest.json``: the facts, and size and SHA-256 of every other file in the folder.

    Args:
        folder: The folder to describe.
        facts: What else to record; plain JSON data.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name not in (_OWNER, "manifest.json"):
            files[path.relative_to(folder).as_posix()] = {"bytes": path.stat().st_size, "sha256": sha256(path)}
    text = json.dumps({**facts, "files": files}, indent=1)
    (folder / "manifest.json").write_text(text + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> dict[str, Any]:
    """A folder's manifest; empty if there is none that can be read."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return manifest if isinstance(manifest, dict) else {}


def matches_manifest(folder: Path, facts: dict[str, Any]) -> bool:
    """Say whether a folder has a manifest with these facts and all its files in their sizes.

    Args:
        folder: The folder to look at.
        facts: What the manifest must say.

    Returns:
        False as well if the manifest is missing or cannot be read.
    """
    manifest = read_manifest(folder)
    try:
        if any(manifest.get(key) != value for key, value in facts.items()):
            return False
        return all((folder / name).stat().st_size == file["bytes"] for name, file in manifest["files"].items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def write_ply(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: NDArray[np.uint8]) -> None:
    """Write a coloured triangle mesh as binary little-endian PLY.

    Args:
        path: The file.
        vertices: Positions, shape (V, 3).
        faces: Vertex indices, shape (F, 3).
        colours: Red, green, blue, shape (V, 3).
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    points = np.empty(len(vertices), dtype=[("place", "<f4", 3), ("colour", "u1", 3)])
    points["place"], points["colour"] = vertices, colours
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, faces
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + points.tobytes() + corners.tobytes())
