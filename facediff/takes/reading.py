"""A take from a motion file: an archive, or a bare array with what it lacks given beside it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.takes.archive import BROKEN, read_archive
from facediff.takes.take import Take

SUFFIXES = (".npz", ".npy")
OF_VERTICES = ("template", "faces", "colours", "inner_lip_pairs")
"""Facts that hold for one topology only."""


@dataclass(frozen=True)
class Surroundings:
    """What a bare array of vertices does not say; None is "not given".

    Attributes:
        template: (V, 3) neutral face.
        faces: (F, 3) triangles.
        frame_rate: frames a second.
        unit: unit of length.
        colours: (V, 3) vertex colours.
        regions: vertex indices by region name.
        inner_lip_pairs: (P, 2) upper and lower inner lips.
        speech: (S,) mono.
        sample_rate: of the speech.
    """

    template: npt.NDArray[np.float32] | None = None
    faces: npt.NDArray[np.int32] | None = None
    frame_rate: float | None = None
    unit: str | None = None
    colours: npt.NDArray[np.uint8] | None = None
    regions: dict[str, npt.NDArray[np.int64]] = field(default_factory=dict)
    inner_lip_pairs: npt.NDArray[np.int64] | None = None
    speech: npt.NDArray[np.float32] | None = None
    sample_rate: int = 16_000

    @classmethod
    def of(cls, take: Take) -> Surroundings:
        """What a take knows beside its motion and its speech."""
        facts: dict[str, Any] = {name: getattr(take, name) for name in (*OF_VERTICES, "frame_rate", "unit")}
        return cls(**facts, regions=dict(take.regions))

    def completed(self, other: Surroundings | None) -> Surroundings:
        """These facts, and from others what these do not say: of another topology the frame rate and unit only."""
        if other is None:
            return self
        alike = self.template is None or other.template is None or self.template.shape == other.template.shape
        names = (*(OF_VERTICES if alike else ()), "frame_rate", "unit")
        missing: dict[str, Any] = {name: getattr(other, name) for name in names if getattr(self, name) is None}
        return replace(self, **missing, regions={**(other.regions if alike else {}), **self.regions})


def read_take(path: Path, given: Surroundings | None = None, lent: Surroundings | None = None) -> Take:
    """Read a motion file.

    Args:
        path: ``.npz`` as :func:`facediff.takes.write_archive` writes it, or ``.npy`` of absolute vertices (T, V, 3) or
            (T, 3V).
        given: goes before what an archive says, and completes an array. Without a template a bare array's first
            frame is taken for the neutral face.
        lent: completes what neither the file nor ``given`` says.

    Raises:
        FaceDiffError: if the file is unreadable, an array lacks a frame rate, or the parts do not fit one another.
    """
    given = given or Surroundings()
    if path.suffix == ".npz":
        take = read_archive(path)
        said = given.completed(Surroundings.of(take)).completed(lent)
        told: dict[str, Any] = {name: getattr(said, name) for name in (*OF_VERTICES, "frame_rate", "unit")}
        if given.speech is not None:
            told |= {"speech": given.speech, "sample_rate": given.sample_rate}
        return replace(take, **told, regions=said.regions)
    if path.suffix != ".npy":
        raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected a motion in {" or ".join(SUFFIXES)}')
    vertices = read_vertices(path)
    given = given.completed(lent)
    if given.frame_rate is None:
        raise FaceDiffError(f"{path}: an array does not say its frame rate; give --frame-rate or --checkpoint")
    return Take(
        name=path.stem,
        vertices=vertices,
        template=given.template if given.template is not None else np.array(vertices[0], np.float32),
        frame_rate=given.frame_rate,
        faces=given.faces,
        unit=given.unit or "m",
        speech=given.speech,
        sample_rate=given.sample_rate,
        colours=given.colours,
        regions=given.regions,
        inner_lip_pairs=given.inner_lip_pairs,
    )


def read_vertices(path: Path) -> npt.NDArray[np.float32]:
    """Absolute vertices (T, V, 3), memory-mapped where the file holds float32.

    Raises:
        FaceDiffError: if the file is missing, broken or of another shape.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a motion (frames, vertices, 3)")
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except BROKEN as error:
        raise FaceDiffError(f"{path}: not a readable NumPy array ({error})") from error
    if not isinstance(array, np.ndarray):
        array.close()
        raise FaceDiffError(f"{path}: not a NumPy array but an archive of several; name it .npz")
    flat = array.ndim == 2 and array.shape[1] % 3 == 0
    if not np.issubdtype(array.dtype, np.floating) or not (flat or (array.ndim == 3 and array.shape[2] == 3)):
        raise FaceDiffError(
            f"{path}: holds {array.dtype} of shape {array.shape}; expected absolute vertices as floating point, "
            f"(frames, vertices, 3) or (frames, 3 * vertices)"
        )
    if not array.size:
        raise FaceDiffError(f"{path}: holds no {'vertices' if len(array) else 'frames'}; give a motion of at least one")
    return array.reshape(len(array), -1, 3).astype(np.float32, copy=False)
