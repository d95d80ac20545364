"""Animations on disk: archives that hold everything, and bare arrays of vertices that options complete."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import Animation
from facediff.errors import FaceDiffError
from facediff.utils.arrays import open_vertices, read_arrays
from facediff.utils.files import atomic, parse_json

FORMAT = "facediff take 1"
"""Marks an archive. The word is older than the class :class:`Animation`; it stays, so that old and new files agree."""

ARRAYS: dict[str, tuple[str, str, tuple[int | None, ...]]] = {
    "vertices": ("f", "floating point (frames, vertices, 3)", (None, None, 3)),
    "template": ("f", "floating point (vertices, 3)", (None, 3)),
    "faces": ("iu", "whole numbers (triangles, 3)", (None, 3)),
    "speech": ("f", "floating point (samples,)", (None,)),
    "colours": ("u", "bytes (vertices, 3)", (None, 3)),
    "inner_lip_pairs": ("iu", "whole numbers (pairs, 2)", (None, 2)),
}
"""The arrays of an archive: kinds of number, in words, and lengths of the axes."""

OF_TOPOLOGY = ("template", "faces", "colours", "inner_lip_pairs")
"""Facts that hold for one topology only, as regions do."""


class AnimationFacts(TypedDict, total=False):
    """What a bare array of vertices lacks, as the fields of :class:`Animation`; any of them may be missing."""

    template: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    frame_rate: float
    unit: str
    colours: npt.NDArray[np.uint8]
    regions: Mapping[str, npt.NDArray[np.int64]]
    inner_lip_pairs: npt.NDArray[np.int64]
    speech: npt.NDArray[np.float32]
    sample_rate: int


def read_animation(
    path: Path, overrides: AnimationFacts | None = None, defaults: AnimationFacts | None = None
) -> Animation:
    """Read a motion file.

    Args:
        path: ``.npz`` as :func:`facediff.animation.write_archive` writes it, or ``.npy`` of absolute vertices (T, V, 3)
            or (T, 3V). Without a template an array's first frame is used as the neutral face.
        overrides: facts that take precedence over those of an archive.
        defaults: facts that neither the file nor ``overrides`` have; those of another topology only if they hold for
            any.

    Raises:
        FaceDiffError: if the file is unreadable, an array lacks a frame rate, or the parts do not fit one another.
    """
    overrides = overrides or {}
    if path.suffix == ".npz":
        animation = read_archive(path)
        facts = complete(complete(overrides, facts_of(animation)), defaults)
        return replace(animation, **facts)
    if path.suffix != ".npy":
        raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected a motion in .npz or .npy')
    vertices = open_vertices(path).astype(np.float32, copy=False)
    facts = complete(overrides, defaults)
    if "frame_rate" not in facts:
        raise FaceDiffError(f"{path}: an array has no frame rate; give --frame-rate or --checkpoint")
    if "template" not in facts:
        facts = {**facts, "template": np.array(vertices[0], np.float32)}
    return Animation(name=path.stem, vertices=vertices, **facts)


def facts_of(animation: Animation) -> AnimationFacts:
    """The facts of an animation, other than its motion and its speech."""
    return {
        "template": animation.template,
        "frame_rate": animation.frame_rate,
        "unit": animation.unit,
        "regions": animation.regions,
        **{name: getattr(animation, name) for name in OF_TOPOLOGY if getattr(animation, name) is not None},  # type: ignore[typeddict-item]
    }


def complete(facts: AnimationFacts, defaults: AnimationFacts | None) -> AnimationFacts:
    """Facts together with those of others that are missing: of another topology, the frame rate and the unit only."""
    if defaults is None:
        return facts
    alike = (
        "template" not in facts or "template" not in defaults or facts["template"].shape == defaults["template"].shape
    )
    names = ("frame_rate", "unit", *(OF_TOPOLOGY if alike else ()))
    found: dict[str, Any] = {name: defaults[name] for name in names if defaults.get(name) is not None}  # type: ignore[literal-required]
    regions = {**(defaults.get("regions", {}) if alike else {}), **facts.get("regions", {})}
    return {**found, **facts, "regions": regions}  # type: ignore[typeddict-item]


def write_archive(path: Path, animation: Animation) -> None:
    """Write an animation to one .npz file, which ``numpy.load`` opens without pickle.

    The entries are the arrays of :class:`Animation` under their own names, ``region_<name>`` for each region, and
    ``about``: JSON with name, frame rate, unit, sample rate and metadata.

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
    """Read a file of :func:`write_archive`.

    Raises:
        FaceDiffError: if the file is missing, damaged, or no archive of an animation.
    """
    expected = "expected an animation that `facediff animate … -o hello.npz` wrote"
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; {expected}")
    arrays: dict[str, Any] = {**read_arrays(path)}
    missing = [name for name in ("vertices", "template", "about") if name not in arrays]
    if missing:
        raise FaceDiffError(f"{path}: has no {', '.join(missing)}; {expected}")
    try:
        about = parse_json(str(arrays["about"]), f"{path}: its entry about", remedy="write the file again")
        facts: dict[str, Any] = {
            "name": str(about["name"]),
            "frame_rate": float(about["frame_rate"]),
            "unit": str(about["unit"]),
            "sample_rate": int(about["sample_rate"]),
            "metadata": {str(key): str(value) for key, value in about["metadata"].items()},
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FaceDiffError(
            f"{path}: its entry about is not what facediff writes ({error!r}); write the file again"
        ) from error
    regions = {name.removeprefix("region_"): arrays[name] for name in arrays if name.startswith("region_")}
    for name in ARRAYS.keys() & arrays.keys():
        array, (kinds, words, lengths) = arrays[name], ARRAYS[name]
        fits = array.ndim == len(lengths) and all(
            wanted in (None, length) for length, wanted in zip(array.shape, lengths, strict=True)
        )
        if array.dtype.kind not in kinds or not (fits or not array.size):  # an empty array may have any shape
            raise FaceDiffError(
                f"{path}: its {name} are {array.dtype} of shape {array.shape}; expected {words}; write the file again"
            )
    indices = regions if "inner_lip_pairs" not in arrays else {**regions, "inner_lip_pairs": arrays["inner_lip_pairs"]}
    count = len(arrays["template"])
    for name, array in indices.items():
        if array.size and (array.dtype.kind not in "iu" or not 0 <= array.min() <= array.max() < count):
            raise FaceDiffError(f"{path}: its {name} names vertices other than 0 to {count - 1}; write the file again")
    return Animation(**{name: arrays[name] for name in ARRAYS if name in arrays}, regions=regions, **facts)


class MotionWriter:
    """A .npy file of (frames, V, 3) float32 that grows, so that memory does not hold a long motion.

    Args:
        path: the file; its header is valid after :meth:`close`.
        frame: shape of a frame, (V, 3).
    """

    def __init__(self, path: Path, frame: tuple[int, ...]) -> None:
        self.path = path
        self.frame = frame
        self.frames = 0  # written so far
        self._stream = path.open("wb")
        self._write_header()

    def write(self, vertices: npt.NDArray[np.float32]) -> None:
        """Add frames (n, V, 3)."""
        self._stream.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        self.frames += len(vertices)

    def close(self) -> None:
        """Write the number of frames into the header."""
        with self._stream:
            self._stream.seek(0)
            self._write_header()

    def _write_header(self) -> None:
        # NumPy leaves room for the first number of a shape to grow, so that the header may be overwritten in its place.
        facts = {"descr": "<f4", "fortran_order": False, "shape": (self.frames, *self.frame)}
        np.lib.format.write_array_header_1_0(self._stream, facts)
