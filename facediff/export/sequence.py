"""A folder with a file for every frame, the speech and a record of what it is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.export.format import Space, facts
from facediff.export.place import RECORD, folder_of, record
from facediff.export.sound import write_wav
from facediff.takes import Take


def write_folder(
    path: Path, take: Take, space: Space, sound: str | None, content: Callable[[npt.NDArray[np.float32]], bytes]
) -> None:
    """Write ``hello_obj/hello_0000.obj`` … for ``hello.obj``, with ``hello.wav`` and ``sequence.json``.

    Args:
        path: the name that was asked for.
        take: the take.
        space: unit and axes.
        sound: name of the speech in the folder; None for none.
        content: a file's bytes from a frame's positions (V, 3).
    """
    folder = folder_of(path)
    folder.mkdir()
    digits = max(4, len(str(len(take.vertices) - 1)))
    for index, points in enumerate(space.frames(take)):
        (folder / f"{path.stem}_{index:0{digits}d}{path.suffix}").write_bytes(content(points))
    told = {**facts(take, space), "files": f"{path.stem}_{'#' * digits}{path.suffix}"}
    if sound is not None:
        write_wav(folder / sound, take)
        told["speech"] = sound
    (folder / RECORD).write_bytes(record(told))
