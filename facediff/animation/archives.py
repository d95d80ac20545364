"""Animations on disk: archives that hold everything, and bare arrays of vertices that options complete."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import Animation, Channels, MotionMap, stretches_of
from facediff.errors import FaceDiffError, OptionError, check_known, located
from facediff.mesh.alignment import face_size, robust_align
from facediff.spaces import Space
from facediff.utils.arrays import open_vertices, read_arrays, write_header
from facediff.utils.files import atomic
from facediff.utils.limits import check_format
from facediff.utils.plain_files import json_text, parse_json
from facediff.utils.records import read_record

FORMAT = "facediff take 1"
"""Marks an archive. The word is older than the class :class:`Animation`; it stays, so that old and new files agree."""

ARRAYS: dict[str, tuple[str, str, tuple[int | None, ...], type[np.generic]]] = {
    "vertices": ("f", "floating point (frames, vertices, 3)", (None, None, 3), np.float32),
    "template": ("f", "floating point (vertices, 3)", (None, 3), np.float32),
    "faces": ("iu", "whole numbers (triangles, 3)", (None, 3), np.int32),
    "speech": ("f", "floating point (samples,)", (None,), np.float32),
    "colours": ("u", "bytes (vertices, 3)", (None, 3), np.uint8),
    "head": ("f", "floating point (frames, 6)", (None, 6), np.float64),
    "values": ("f", "floating point (frames, channels)", (None, None), np.float32),
    "deltas": ("f", "floating point (channels, vertices, 3)", (None, None, 3), np.float32),
    "inner_lip_pairs": ("iu", "whole numbers (pairs, 2)", (None, 2), np.int64),
}
"""An archive's arrays: kinds of number, in words, lengths of the axes, and the type that :class:`Animation` has."""

REGION = ("iu", "whole numbers (vertices,)", (None,), np.int64)
"""The same of each region."""

OF_ARCHIVE = re.compile(f"about|region_.*|{'|'.join(ARRAYS)}")
"""The entries of an archive; any others are not read."""

OF_TOPOLOGY = ("template", "faces", "colours", "inner_lip_pairs")
"""Facts that hold for one topology only, as regions do."""


@dataclass(frozen=True)
class About:
    """The facts of an archive that are no arrays: its entry ``about``."""

    name: str
    frame_rate: float
    unit: str
    sample_rate: int
    metadata: Mapping[str, str]
    space: Any = None


class AnimationFacts(TypedDict, total=False):
    """Facts that a bare array of vertices lacks, as the fields of :class:`Animation`; any of them may be missing."""

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
        overrides: facts that take precedence over an archive's.
        defaults: facts that neither the file nor ``overrides`` have; of another topology only where they hold for
            any.
    """
    overrides = overrides or {}
    if path.suffix == ".npz":
        animation = read_archive(path)
        facts = complete(complete(overrides, facts_of(animation)), defaults)
        with located(path):
            if "template" in overrides:
                _refuse_other_face(animation.still().vertices, facts)
            return replace(animation, **facts)
    check_known(path, "format of a motion", [path.suffix], (".npz", ".npy"))
    with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused before it is used
        stored = open_vertices(path)
        vertices = stored.view(MotionMap) if stored.dtype == np.float32 else stored.astype(np.float32)
    facts = complete(overrides, defaults)
    if "frame_rate" not in facts:
        raise OptionError.naming(f"{path}: an array has no frame rate; give {{frame_rate}} or {{checkpoint}}")
    if "template" not in facts:
        facts = {**facts, "template": np.array(vertices[0], np.float32)}
    with located(path):
        _refuse_other_face(vertices, facts)
        return Animation(name=path.stem, vertices=vertices, **facts)


def _refuse_other_face(vertices: npt.NDArray[np.floating], facts: AnimationFacts) -> None:
    first, template = vertices[0], facts["template"]
    if first.shape == template.shape and np.isfinite(first).all():
        laid = robust_align(first, template, scale=True)
        apart = np.median(np.linalg.norm(laid.apply(first) - template, axis=-1))
        if not (0.5 < laid.scale < 2 and apart < 0.3 * face_size(template)):
            raise FaceDiffError(
                f"its first frame does not lie on the neutral face, which is {laid.scale:.3g} times as large; "
                "expected absolute vertices in the order and unit of the mesh"
            )


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
    """Facts, completed by others: of another topology, the frame rate and the unit only."""
    if defaults is None:
        return facts
    alike = (
        "template" not in facts or "template" not in defaults or facts["template"].shape == defaults["template"].shape
    )
    names = ("frame_rate", "unit", *(OF_TOPOLOGY if alike else ()))
    shared_facts: dict[str, Any] = {name: defaults[name] for name in names if defaults.get(name) is not None}  # type: ignore[literal-required]
    regions = {**(defaults.get("regions", {}) if alike else {}), **facts.get("regions", {})}
    return {**shared_facts, **facts, "regions": regions}  # type: ignore[typeddict-item]


def write_archive(path: Path, animation: Animation) -> None:
    """Write an animation to one .npz file, which ``numpy.load`` opens without pickle.

    The entries are the arrays of :class:`Animation` under their own names, ``region_<name>`` for each region, and
    ``about``: JSON with name, frame rate, unit, sample rate and metadata.
    """
    animation.refuse_not_finite()
    arrays: dict[str, Any] = {name: getattr(animation, name) for name in ARRAYS if getattr(animation, name) is not None}
    space = {} if animation.values is None else {"space": animation.space.state()}
    arrays |= {f"region_{name}": indices for name, indices in animation.regions.items()}
    about = {
        "format": FORMAT,
        "name": animation.name,
        "frame_rate": animation.frame_rate,
        "unit": animation.unit,
        "sample_rate": animation.sample_rate,
        "metadata": dict(animation.metadata),
        **space,
    }
    arrays["about"] = np.array(json_text(path, about, indent=None))
    with atomic(path) as temporary, zipfile.ZipFile(temporary, "w", allowZip64=True) as archive:
        for name, array in arrays.items():
            # As numpy.savez does, but for a motion in a file, which is never read as a whole.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                if isinstance(array, MotionMap):
                    write_header(stream, array.shape)
                    for _, vertices in stretches_of(array):
                        stream.write(np.ascontiguousarray(vertices, "<f4").tobytes())
                else:
                    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def read_archive(path: Path) -> Animation:
    """Read a file of :func:`write_archive`."""
    expected = "expected an animation that `facediff animate … -o hello.npz` wrote"
    arrays = read_arrays(path, _Entries())
    absent_entries = [name for name in ("vertices", "template", "about") if name not in arrays]
    if absent_entries:
        raise FaceDiffError(f"{path}: has no {', '.join(absent_entries)}; {expected}")
    source, remedy = f"{path}: its entry about", "write the file again"
    about = parse_json(str(arrays.pop("about")), source, remedy=remedy)
    if isinstance(about, dict):
        check_format(source, about.get("format"), FORMAT)
    facts = dict(vars(read_record(About, about, source, remedy=remedy, strict=False)))
    facts["frame_rate"] = float(facts["frame_rate"])
    count = len(np.atleast_1d(arrays["template"]))
    checked = {name: _checked(path, name, array, count) for name, array in arrays.items()}
    regions = {name.removeprefix("region_"): array for name, array in checked.items() if name.startswith("region_")}
    parts: dict[str, Any] = {name: checked[name] for name in ARRAYS if name in checked and checked[name].size}
    values, deltas, space = parts.pop("values", None), parts.pop("deltas", None), facts.pop("space")
    if values is not None:
        with located(path):
            parts["channels"] = Channels(Space.from_state(space), values, parts["vertices"], deltas)
    with located(path):
        animation = Animation(**parts, regions=regions, **facts)
        animation.refuse_not_finite()
    return animation


class _Entries:
    """The names of an archive's entries."""

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and OF_ARCHIVE.fullmatch(name) is not None


def _checked(path: Path, name: str, array: npt.NDArray[Any], count: int) -> npt.NDArray[Any]:
    """One array of an archive in the type that :class:`Animation` has; indices name one of ``count`` vertices."""
    kinds, expectation, lengths, number_type = ARRAYS.get(name, REGION)
    fits = array.ndim == len(lengths) and all(
        length in (None, size) for size, length in zip(array.shape, lengths, strict=True)
    )
    if not array.size and name not in ("vertices", "template"):
        return np.zeros([length or 0 for length in lengths], number_type)  # an empty array may have any shape
    last = 255 if name == "colours" else count - 1
    fits = fits and array.dtype.kind in kinds and (kinds == "f" or 0 <= array.min() <= array.max() <= last)
    if not fits:
        raise FaceDiffError(
            f"{path}: its {name} are {array.dtype} of shape {array.shape}; expected {expectation}; write the file again"
        )
    with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
        return array.astype(number_type, copy=False)
