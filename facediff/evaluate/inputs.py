"""What lies beside the files that are scored: templates, and how many vertices the mesh has."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facediff.data.corpus import MOTION_FOLDERS
from facediff.errors import FaceDiffError
from facediff.metrics import TOPOLOGIES
from facediff.pickles import load_pickle


def find_truths(folder: Path) -> tuple[Path, Path | None]:
    """The folder that holds the truth's files, and the corpus folder that it belongs to, if it does.

    Args:
        folder: a corpus folder, its ``vertices_npy``, or any other folder of files.

    Raises:
        FaceDiffError: if there is no such folder.
    """
    if not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected the truth's motion files, or a corpus folder")
    for name in MOTION_FOLDERS:
        if (folder / name).is_dir():
            return folder / name, folder
    return folder, folder.parent if folder.name in MOTION_FOLDERS else None


def count_vertices(topology: str | None, templates: Path | None, truth: Path) -> int:
    """Vertices of the mesh: as the topology says, else the templates, else the first readable truth.

    Raises:
        FaceDiffError: if none of them says it.
    """
    if topology in TOPOLOGIES:
        return TOPOLOGIES[topology].n_vertices
    if templates is not None:
        loaded = load_pickle(templates)
        sizes = [np.size(value) for value in loaded.values()] if isinstance(loaded, dict) else []
        if sizes and sizes[0] and sizes[0] % 3 == 0:
            return int(sizes[0]) // 3
        raise FaceDiffError(f"{templates}: expected a dict from subject to (V, 3) array")
    for path in sorted(truth.glob("**/*.npy")):
        try:
            shape = np.load(path, mmap_mode="r", allow_pickle=False).shape
        except (ValueError, OSError, EOFError):
            continue
        if len(shape) in (2, 3) and np.prod(shape[1:]) % 3 == 0 and np.prod(shape[1:]):
            return int(np.prod(shape[1:])) // 3
    raise FaceDiffError(f"{truth}: no file says how many vertices the mesh has; say it with --n-vertices")
