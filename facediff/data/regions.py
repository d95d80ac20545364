"""Finding which vertices are the lips and the upper face, in any of the files that circulate."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError, choices
from facediff.metrics import Region
from facediff.pickles import load_pickle

ALL = "all"
"""The source that stands for every vertex."""

FLAME_SOURCES: dict[str, tuple[str, ...]] = {
    "lips": ("regions/lve.txt", "FLAME_masks.pkl:lips", "regions/FLAME_masks.pkl:lips", "regions/lip.txt"),
    "upper_face": (
        "regions/fdd.txt",
        "FLAME_masks.pkl:forehead+eye_region",
        "regions/FLAME_masks.pkl:forehead+eye_region",
    ),
}
"""Files that say which of FLAME's vertices are the lips and the upper face, in the order of preference."""


def find_region(root: Path, sources: Sequence[str], name: str, n_vertices: int, help_text: str = "") -> Region:
    """The region of the first source whose file is there.

    A source is a file below ``root``: a text file of indices separated by "," or ", "; a pickle with a list of indices;
    or ``FLAME_masks.pkl:lips``, one or several (joined by "+") masks of a pickle with named masks. ``all`` is every
    vertex.

    Raises:
        FaceDiffError: if no file is there (naming all that were looked for), or it is not what it should be.
    """
    for source in sources:
        if source == ALL:
            return Region.from_indices("all vertices", range(n_vertices), n_vertices=n_vertices)
        file, _, masks = source.partition(":")
        path = root / file
        if not path.is_file():
            continue
        try:
            if path.suffix == ".pkl":
                return Region.from_indices(name, read_masks(path, masks), n_vertices=n_vertices)
            return Region.from_file(path, name=name, n_vertices=n_vertices)
        except ValueError as error:
            message = str(error)
            raise FaceDiffError(message if str(path) in message else f"{path}: {message}") from error
    looked = ", ".join(str(root / source) for source in sources)
    raise FaceDiffError(
        f"{root}: nothing says which vertices are the {name.replace('_', ' ')}; looked for {looked}. {help_text} "
        f"To train and score on all vertices instead, set data.{name}={ALL}"
    )


def read_masks(path: Path, names: str) -> list[int]:
    """Indices of one or several masks ("lips", "forehead+eye_region") of a pickle; its whole list if no name is given.

    Raises:
        FaceDiffError: if the file holds something else, or has no mask of that name.
    """
    loaded = load_pickle(path)
    if not names:
        chosen = [loaded]
    else:
        if not isinstance(loaded, dict):
            raise FaceDiffError(f"{path}: expected a dict from mask to vertex indices, got {type(loaded).__name__}")
        for name in names.split("+"):
            if name not in loaded:
                raise FaceDiffError(f'{path}: has no mask "{name}": {choices(name, list(map(str, loaded)))}')
        chosen = [loaded[name] for name in names.split("+")]
    try:
        arrays = [np.asarray(mask) for mask in chosen]
    except ValueError as error:
        raise FaceDiffError(f"{path}: expected lists of vertex indices ({error})") from error
    if any(array.ndim != 1 or not np.issubdtype(array.dtype, np.integer) for array in arrays):
        raise FaceDiffError(f"{path}: expected lists of whole numbers, the vertex indices")
    return [int(index) for array in arrays for index in array]
