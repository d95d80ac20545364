"""Finding the vertices of the lips and the upper face beside the files that are scored."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from facediff.data.regions import ALL, find_region
from facediff.errors import FaceDiffError
from facediff.metrics import Region

Part = Literal["lips", "upper_face"]

USUAL: dict[Part, tuple[str, ...]] = {
    "lips": ("lve.txt", "FLAME_masks.pkl:lips"),
    "upper_face": ("fdd.txt", "FLAME_masks.pkl:forehead+eye_region"),
}
"""Sources that are looked for if none is named."""

OPTIONS: dict[Part, str] = {"lips": "--lips", "upper_face": "--upper-face"}


def read_region(part: Part, n_vertices: int, *, folder: Path | None = None, source: str | None = None) -> Region:
    """A region from one of the files that circulate.

    Args:
        part: ``lips`` or ``upper_face``.
        n_vertices: vertices of the mesh.
        folder: where to look; the working folder if None.
        source: a text file of indices; a pickle; ``FLAME_masks.pkl:lips``, one or several (joined by "+") masks of a
            pickle; ``mouth_mask.txt>0.1``, the vertices of a file of weights above a threshold; or ``all``. Without
            one, ``lve.txt`` or ``fdd.txt`` is taken, else the masks of FLAME.

    Raises:
        FaceDiffError: if it is not there, or not what it should be.
    """
    named = part.replace("_", " ")
    advice = f"give --regions FOLDER with {USUAL[part][0]} or FLAME_masks.pkl in it, or {OPTIONS[part]} FILE"
    if source is None and folder is None:
        raise FaceDiffError(f"nothing says which vertices are the {named}; {advice}")
    root = folder or Path()
    files = {each: root / each.partition(">")[0].partition(":")[0] for each in ([source] if source else USUAL[part])}
    chosen = next((each for each, path in files.items() if each == ALL or path.is_file()), None)
    if chosen is None:
        raise FaceDiffError(f"{' and '.join(map(str, files.values()))}: not there; expected the {named}; {advice}")
    file, above, threshold = chosen.partition(">")
    if not above:
        return find_region(root, [chosen], chosen, n_vertices)
    try:
        region = Region.from_weights(root / file, float(threshold), name=chosen)
        region.check(n_vertices)
    except ValueError as error:
        message = str(error)
        raise FaceDiffError(message if str(root / file) in message else f"{root / file}: {message}") from error
    return region
