"""The numbers behind lip curves: the mouth's opening over time, and the outline of a waveform."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from facediff.errors import FaceDiffError
from facediff.figures.material import Array, Material, chunks, shortest
from facediff.metrics import LipPairs
from facediff.metrics.formulas import opening

PAIRS_FILE = "regions/inner_lip_pairs.txt"
"""Where a corpus has its pairs of inner-lip vertices."""


@dataclass(frozen=True)
class Curves:
    """The opening of the mouth.

    Attributes:
        times: middle of each frame (T,), in seconds.
        openings: opening (T,) by name, the truth's first, in the vertices' unit.
    """

    times: Array
    openings: dict[str, Array]


def read_pairs(source: str | None, corpus: Path | None, n_vertices: int) -> LipPairs:
    """Pairs of an upper and a lower lip vertex.

    Args:
        source: a text file of pairs, or pairs themselves, ``3531-3504,1-2``; the corpus's file if None.
        corpus: the corpus folder.
        n_vertices: vertices of the mesh.

    Raises:
        FaceDiffError: if nothing says them, or they are none of this mesh.
    """
    if source is None and corpus is not None and (corpus / PAIRS_FILE).is_file():
        source = str(corpus / PAIRS_FILE)
    if source is None:
        where = f"{corpus / PAIRS_FILE}: no such file" if corpus is not None else "the truth is no corpus folder"
        raise FaceDiffError(
            f"{where}; give --lip-pairs, a file with one upper and one lower lip vertex a line, or pairs such as "
            f"3531-3504 (the middle of FLAME's lips)"
        )
    try:
        if not Path(source).is_file() and all(c.isdecimal() or c in "-," for c in source):
            pairs = LipPairs.from_pairs("given", [[int(i) for i in pair.split("-")] for pair in source.split(",")])
        else:
            pairs = LipPairs.from_file(source)
        pairs.check(n_vertices)
    except ValueError as error:
        raise FaceDiffError(f"--lip-pairs {source}: {error}") from error
    return pairs


def opening_curves(material: Material, clip: str, pairs: LipPairs) -> tuple[Curves, str | None]:
    """The opening of truth and methods in a clip: the mean distance of the pairs, as `MouthOpeningDifference` has it.

    Returns:
        the curves in the length that all have; and a note if lengths differ.

    Raises:
        FaceDiffError: if a file cannot be used.
    """
    motions = material.open(clip)
    frames, note = shortest(motions)
    indices, openings = pairs.tensor(), {}
    for name, motion in motions.items():
        found = np.empty(frames)
        for first, part in chunks(motion, material.path(clip, name), frames):
            found[first : first + len(part)] = opening(torch.from_numpy(part), None, indices).numpy()
        openings[name] = found
    return Curves(np.asarray((np.arange(frames) + 0.5) / material.rate, np.float64), openings), note


def envelope(samples: npt.NDArray[np.float32], columns: int) -> tuple[Array, Array]:
    """Lowest and highest sample of each of up to ``columns`` equal stretches, so that a waveform stays a small drawing.

    Returns:
        lowest and highest, (columns,) each, or fewer if there are fewer samples.
    """
    edges = np.linspace(0, len(samples), min(columns, len(samples)) + 1).astype(np.int64)
    low, high = (np.asarray(f.reduceat(samples, edges[:-1]), np.float64) for f in (np.minimum, np.maximum))
    return low, high
