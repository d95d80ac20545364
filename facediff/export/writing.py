"""The one place where takes become files, whatever the format."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from facediff.animation import Animation, metres_per_unit
from facediff.errors import FaceDiffError, MissingExtraError, choices
from facediff.export import arrays, glb, obj, page, ply, point_cache, usd, video, weights
from facediff.export.format import ExportOptions, Format, check_free, folder_of, numbered, speech_name, staged
from facediff.utils.files import check_writable

FORMATS: Mapping[str, Format] = {
    ".glb": glb.FORMAT,
    ".usdc": usd.BINARY,
    ".usda": usd.TEXT,
    ".obj": obj.FORMAT,
    ".ply": ply.FORMAT,
    ".pc2": point_cache.PC2,
    ".mdd": point_cache.MDD,
    ".mp4": video.FORMAT,
    ".html": page.FORMAT,
    ".csv": weights.FORMAT,
    ".npz": arrays.TAKE,
    ".npy": arrays.VERTICES,
}


def check_export(path: Path, options: ExportOptions, n_samples: int = 1) -> None:
    """Refuse what can be refused before any work is done.

    Args:
        path: the file that is wanted; its suffix chooses the format.
        options: the choices.
        n_samples: how many takes there will be.

    Raises:
        FaceDiffError: if the suffix is unknown, the format has no place for a choice, the set of shapes is missing, or
            the place cannot be written.
        MissingExtraError: if a package is missing.
    """
    if not path.suffix:
        raise FaceDiffError(f"{path}: has no suffix, which names the format; give one, such as {path.name}.glb")
    if path.suffix not in FORMATS:
        raise FaceDiffError(f'{path}: there is no format "{path.suffix}": {choices(path.suffix.lower(), FORMATS)}')
    if n_samples < 1:
        raise FaceDiffError(f"{path}: there is no take to write; give at least one")
    made = FORMATS[path.suffix]
    check_space(path, made, options)
    if path.suffix == ".csv":
        if options.shapes is None:
            raise weights.missing_shapes(path)
        if not options.shapes.exists():
            raise FaceDiffError(f"{options.shapes}: no such folder or file; expected the set of shapes for {path}")
    if not 0 < options.tolerance_mm < float("inf"):
        raise FaceDiffError(f"tolerance of {options.tolerance_mm:g} mm: expected more than 0, such as 0.05")
    if made.package is not None and importlib.util.find_spec(made.package[0]) is None:
        raise MissingExtraError(*made.package, f"writing {path.suffix}")
    for target in targets(path, made, n_samples):
        check_writable(target)
        if made.folder:
            check_free(folder_of(target))


def check_space(path: Path, made: Format, options: ExportOptions) -> None:
    """Refuse a unit or an axis that the format has no place for.

    Raises:
        FaceDiffError: saying which it takes.
    """
    if options.unit is not None:
        metres = metres_per_unit(options.unit)
        if made.unit == "none":
            raise FaceDiffError(f"{path}: {path.suffix} holds no lengths; leave the unit away")
        if made.unit == "m" and metres != 1:
            raise FaceDiffError(
                f"{path}: {path.suffix} is in metres by its standard; leave the unit away, and let the program that "
                f"reads it scale"
            )
    if options.up is not None and options.up not in made.ups:
        told = f"has {made.ups[0]} up by definition" if made.ups else "holds no axes"
        raise FaceDiffError(f"{path}: {path.suffix} {told}; leave the axis away")


def write_animations(path: Path, takes: Sequence[Animation], options: ExportOptions | None = None) -> list[Path]:
    """Write takes in the format that the suffix names: every file appears whole, all of them or none.

    Args:
        path: the file. Several takes in a format that shows one become ``NAME_take1.glb``, ``NAME_take2.glb`` …; a
            format of many files makes a folder (``hello.obj`` gives ``hello_obj/``).
        takes: at least one.
        options: the choices; the defaults if None.

    Returns:
        What was written, files and folders, the animations before what lies beside them.

    Raises:
        FaceDiffError: as :func:`check_export`; if a motion is not finite, a mesh is missing, something that facediff
            did not write is in the way, or the disk is full.
    """
    options = options or ExportOptions()
    check_export(path, options, len(takes))
    made = FORMATS[path.suffix]
    for animation in takes:
        check_animation(animation, made)
    groups = [takes] if made.several else [[animation] for animation in takes]
    goals = targets(path, made, len(takes))
    for goal, animation in zip(goals, takes, strict=False):
        for beside in named_by_nobody(goal, animation):
            check_free(beside)
    sounds = [sound_of(goal, made, group[0], options) for goal, group in zip(goals, groups, strict=True)]
    with staged(path) as hidden:
        for goal, group, sound in zip(goals, groups, sounds, strict=True):
            made.write(hidden / goal.name, group, options, sound)
        written = {file.name for file in hidden.iterdir()}
    first = [(folder_of(goal) if made.folder else goal).name for goal in goals]
    return [path.with_name(name) for name in [*first, *sorted(written - set(first))]]


def check_animation(animation: Animation, made: Format) -> None:
    """Refuse a take that would make a broken file.

    Raises:
        FaceDiffError: naming the take and what is wrong with it.
    """
    animation.refuse_not_finite()
    if not np.isfinite(animation.template).all():
        raise FaceDiffError(f"{animation.name}: its template holds NaN or infinity; give a sound mesh")
    if animation.colours is not None and animation.colours.shape != animation.template.shape:
        raise FaceDiffError(
            f"{animation.name}: its vertex colours have shape {animation.colours.shape}; expected {animation.template.shape}"
        )
    if made.needs_mesh:
        _ = animation.triangles


def targets(path: Path, made: Format, n_samples: int) -> list[Path]:
    """The files that a user asked for."""
    return [path] if made.several else numbered(path, n_samples)


def sound_of(path: Path, made: Format, animation: Animation, options: ExportOptions) -> str | None:
    """The name of the .wav that goes with a file; None where there is to be none."""
    if not made.sound_beside or not options.speech or animation.speech is None:
        return None
    return f"{path.stem}.wav" if made.folder else speech_name(path)


def named_by_nobody(path: Path, animation: Animation) -> list[Path]:
    """What comes along with a file, beside the speech, without having been asked for by name."""
    if path.suffix in (".pc2", ".mdd") and animation.faces is not None:
        return [path.with_suffix(".obj")]
    return [path.with_suffix(".json")] if path.suffix == ".csv" else []
