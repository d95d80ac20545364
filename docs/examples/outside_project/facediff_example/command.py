"""A command of the program ``facediff``: a typed function, whose parameters and docstring are its options and help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from facediff.utils.hints import Range
from facediff.utils.option import Option


def liveliest(
    animation: Annotated[Path, Option(metavar="ANIMATION", reads=True, exists="file")],
    *,
    count: Annotated[int, Range(1, 100)] = 1,
) -> None:
    """Print the moments at which a face moves fastest.

    Args:
        animation: motion of `facediff animate`
        count: how many
    """
    import numpy as np

    import facediff

    motion = facediff.read(animation)
    speed = np.linalg.norm(np.diff(motion.vertices, axis=0), axis=-1).mean(-1)
    for frame in np.sort(speed.argsort()[-count:]):
        print(f"{(frame + 1) / motion.frame_rate:.2f} s")
