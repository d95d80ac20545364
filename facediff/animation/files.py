"""A take from a motion file: an archive, or a bare array with what it lacks given beside it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import Animation
from facediff.errors import FaceDiffError
from facediff.utils import SAMPLE_RATE
from facediff.utils.arrays import open_vertices, read_arrays
from facediff.utils.files import atomic

# Motion that is written to a .npy file while it is made, so that memory does not hold it.


class MotionWriter:
    """A .npy file of (frames, V, 3) float32 that grows; its header is right after :meth:`close`.

    Args:
        path: the file.
        frame: shape of a frame, (V, 3).
    """

    def __init__(self, path: Path, frame: tuple[int, ...]) -> None:
        self.path = path
        self.frame = frame
        self.frames = 0
        self._stream = path.open("wb")
        self._write_header()

    def write(self, vertices: npt.NDArray[np.float32]) -> None:
        """Add frames (n, V, 3)."""
        self._stream.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        self.frames += len(vertices)

    def close(self) -> None:
        """Write how many frames there are."""
        with self._stream:
            self._stream.seek(0)
            self._write_header()

    def _write_header(self) -> None:
        # NumPy leaves room for the first number of a shape to grow, so the header may be written again in its place.
        facts = {"descr": "<f4", "fortran_order": False, "shape": (self.frames, *self.frame)}
        np.lib.format.write_array_header_1_0(self._stream, facts)


# A take in one file: NumPy's .npz with everything that players and exporters need.

FORMAT = "facediff take 1"
ARRAYS = ("vertices", "template", "faces", "speech", "colours", "inner_lip_pairs")
NEEDED = ("vertices", "template", "about")
SHAPES: dict[str, tuple[str, str, tuple[int | None, ...]]] = {
    "vertices": ("f", "floating point (frames, vertices, 3)", (None, None, 3)),
    "template": ("f", "floating point (vertices, 3)", (None, 3)),
    "faces": ("iu", "whole numbers (triangles, 3)", (None, 3)),
    "speech": ("f", "floating point (samples,)", (None,)),
    "colours": ("u", "bytes (vertices, 3)", (None, 3)),
    "inner_lip_pairs": ("iu", "whole numbers (pairs, 2)", (None, 2)),
}
"""What the arrays are: kinds of number, in words, and lengths of the axes."""


def write_archive(path: Path, animation: Animation) -> None:
    """Write a take; ``numpy.load`` opens the file without pickle.

    The entries are the arrays of :class:`Animation` under their own names, ``region_<name>`` for each region, and ``about``:
    JSON with name, frame rate, unit, sample rate and metadata.

    Raises:
        FaceDiffError: if the file cannot be written, or the motion is not finite.
    """
    animation.refuse_not_finite()
    arrays: dict[str, Any] = {name: getattr(animation, name) for name in ARRAYS if getattr(animation, name) is not None}
    arrays |= {f"region_{name}": indices for name, indices in animation.regions.items()}
    about = {
        "format": FORMAT,
        "name": animation.name,
        "frame_rate": animation.frame_rate,
        "unit": animation.unit,
        "sample_rate": animation.sample_rate,
        "metadata": dict(animation.metadata),
    }
    arrays["about"] = np.array(json.dumps(about, ensure_ascii=False))
    with atomic(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_archive(path: Path) -> Animation:
    """Read what :func:`write_archive` wrote.

    Raises:
        FaceDiffError: if the file is missing, broken, or no take.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a take that `facediff animate … -o take.npz` wrote")
    held: dict[str, Any] = {**read_arrays(path)}
    missing = [name for name in NEEDED if name not in held]
    if missing:
        raise FaceDiffError(
            f"{path}: has no {', '.join(missing)}; expected a take that `facediff animate … -o take.npz` wrote"
        )
    try:
        about = json.loads(str(held["about"]))
        facts: dict[str, Any] = {
            "name": str(about["name"]),
            "frame_rate": float(about["frame_rate"]),
            "unit": str(about["unit"]),
            "sample_rate": int(about["sample_rate"]),
            "metadata": {str(key): str(value) for key, value in about["metadata"].items()},
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FaceDiffError(
            f"{path}: its entry about is not what facediff writes ({error!r}); write it anew"
        ) from error
    regions = {name.removeprefix("region_"): held[name] for name in held if name.startswith("region_")}
    for name, (kinds, words, lengths) in SHAPES.items():
        if name in held:
            _refuse_other(path, name, held[name], kinds, words, lengths)
    for name, indices in {**regions, "inner_lip_pairs": held.get("inner_lip_pairs", np.zeros(0, int))}.items():
        _refuse_outside(path, name, indices, len(held["template"]))
    return Animation(**{name: held[name] for name in ARRAYS if name in held}, regions=regions, **facts)


def _refuse_other(
    path: Path, name: str, array: npt.NDArray[Any], kinds: str, words: str, lengths: tuple[int | None, ...]
) -> None:
    """Refuse an array of another kind or shape; one without any number may have any shape."""
    fits = array.ndim == len(lengths) and all(
        wanted in (None, length) for length, wanted in zip(array.shape, lengths, strict=True)
    )
    if array.dtype.kind not in kinds or not (fits or not array.size):
        raise FaceDiffError(
            f"{path}: its {name} are {array.dtype} of shape {array.shape}; expected {words}; write it anew"
        )


def _refuse_outside(path: Path, name: str, indices: npt.NDArray[Any], count: int) -> None:
    """Refuse indices of vertices that are not there."""
    if indices.size and (indices.dtype.kind not in "iu" or not 0 <= indices.min() <= indices.max() < count):
        raise FaceDiffError(f"{path}: its {name} names vertices other than 0 to {count - 1}; write it anew")


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
    sample_rate: int = SAMPLE_RATE

    @classmethod
    def of(cls, animation: Animation) -> Surroundings:
        """What a take knows beside its motion and its speech."""
        facts: dict[str, Any] = {name: getattr(animation, name) for name in (*OF_VERTICES, "frame_rate", "unit")}
        return cls(**facts, regions=dict(animation.regions))

    def completed(self, other: Surroundings | None) -> Surroundings:
        """These facts, and from others what these do not say: of another topology the frame rate and unit only."""
        if other is None:
            return self
        alike = self.template is None or other.template is None or self.template.shape == other.template.shape
        names = (*(OF_VERTICES if alike else ()), "frame_rate", "unit")
        missing: dict[str, Any] = {name: getattr(other, name) for name in names if getattr(self, name) is None}
        return replace(self, **missing, regions={**(other.regions if alike else {}), **self.regions})


def read_animation(path: Path, given: Surroundings | None = None, lent: Surroundings | None = None) -> Animation:
    """Read a motion file.

    Args:
        path: ``.npz`` as :func:`facediff.animation.write_archive` writes it, or ``.npy`` of absolute vertices (T, V, 3) or
            (T, 3V).
        given: goes before what an archive says, and completes an array. Without a template a bare array's first
            frame is taken for the neutral face.
        lent: completes what neither the file nor ``given`` says.

    Raises:
        FaceDiffError: if the file is unreadable, an array lacks a frame rate, or the parts do not fit one another.
    """
    given = given or Surroundings()
    if path.suffix == ".npz":
        animation = read_archive(path)
        said = given.completed(Surroundings.of(animation)).completed(lent)
        told: dict[str, Any] = {name: getattr(said, name) for name in (*OF_VERTICES, "frame_rate", "unit")}
        if given.speech is not None:
            told |= {"speech": given.speech, "sample_rate": given.sample_rate}
        return replace(animation, **told, regions=said.regions)
    if path.suffix != ".npy":
        raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected a motion in {" or ".join(SUFFIXES)}')
    vertices = open_vertices(path).astype(np.float32, copy=False)
    given = given.completed(lent)
    if given.frame_rate is None:
        raise FaceDiffError(f"{path}: an array does not say its frame rate; give --frame-rate or --checkpoint")
    return Animation(
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
