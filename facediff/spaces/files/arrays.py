"""NumPy's files of FLAME coefficients and ARKit weights, which need a declared layout (.npy, .npz).

An array does not name its columns, and several layouts share a width: DualTalk's predictions and its own ground truth
have jaw and head in opposite order. So no layout is taken from a shape alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged, needs_extra
from facediff.spaces.files.clips import ParameterClip, checked
from facediff.spaces.layouts import LAYOUTS, Layout, find_layout, layouts_of_width
from facediff.utils.arrays import open_array, read_arrays
from facediff.utils.files import atomic
from facediff.utils.hdf5 import HDF5_SUFFIXES, read_frames
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES
from facediff.utils.numerics import Floats

RELEASE = "flame_3dmead_release"
RELEASE_WIDTHS = {"shape": 300, "exp": 100, "global_pose": 3, "jaw": 3}
"""The layout of 3DMEAD's ``shape_pose_cam.hdf5``, and the datasets that are read of it."""

RATES = ("mocap_frame_rate", "fps", "frame_rate")
"""Arrays of an archive that state the frames a second."""


def read_array(path: Path, layout: str | None, frame_rate: float | None = None) -> ParameterClip:
    """Read a ``.npy`` or ``.pt`` (T, width) or (1, T, width), or a ``.npz`` or ``.hdf5`` with the arrays of a layout.

    Args:
        path: the file.
        layout: name of its layout.
        frame_rate: frames a second, for layouts and files that do not state it, and against those that do.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz" or suffix in HDF5_SUFFIXES:
        return _read_archive(path, layout, frame_rate)
    array = _read_tensor(path) if suffix == ".pt" else open_array(path, kinds="fiu")
    if array.ndim == 3 and array.shape[0] == 1:
        array = array[0]
    width = array.shape[1] if array.ndim == 2 else 0
    fitting = layouts_of_width(width)
    entry = None if layout is None else find_layout(layout)
    if entry is None or layout is None or layout not in fitting:
        stated = "has no declared layout" if entry is None else f"is declared as {layout} of {entry.width} columns"
        advice = f"layouts of this width: {', '.join(fitting)}" if fitting else "no layout has so many columns"
        raise FaceDiffError(f"{path}: has {width} columns ({array.shape}) and {stated}; give its layout; {advice}")
    rate = _rate(path, frame_rate, entry)
    numbers = np.asarray(array, np.float64)
    values = checked(path, numbers[:, entry.identity :], rate)
    person = None
    if entry.identity:
        shapes = numbers[:, : entry.identity]
        varies = bool((shapes != shapes[0]).any())
        # 3DMEAD's reconstructions have a shape for each frame, which is one person's all the same.
        person = checked(path, shapes.mean(0, keepdims=True) if varies else shapes[:1], rate)[0]
        if varies and layout != "flame_3dmead":
            raise FaceDiffError(
                f"{path}: its {entry.space.identity} changes from frame to frame; expected one person's"
            )
    return _clip(path, values, entry, rate, layout, person)


def _read_tensor(path: Path) -> npt.NDArray[Any]:
    """The one tensor of a file of PyTorch's, as ARTalk keeps its style clips."""
    from facediff.utils.torch_files import load_tensors

    with needs_extra("torch", "metrics", "reading a tensor of motion (.pt)"):
        content = load_tensors(path, "expected a tensor of motion (.pt)")
    if not hasattr(content, "detach") or not content.is_floating_point():
        raise FaceDiffError(f"{path}: holds a {type(content).__name__}; expected one tensor of numbers")
    return np.asarray(content.detach().double().numpy())


def _read_archive(path: Path, layout: str | None, frame_rate: float | None) -> ParameterClip:
    names = {key for entry in LAYOUTS.values() if entry.arrays for key in (*entry.arrays, entry.identity_array)}
    if path.suffix.lower() in HDF5_SUFFIXES:
        layout = layout or RELEASE
        content: Mapping[str, npt.NDArray[Any]] = read_frames(path, RELEASE_WIDTHS)
    else:
        content = read_arrays(path, {*names, *RATES})
    fitting = [name for name, entry in LAYOUTS.items() if entry.arrays and set(entry.arrays) <= set(content)]
    entry = None if layout is None else find_layout(layout)
    if entry is None or layout is None or layout not in fitting:
        stated = "has no declared layout" if layout is None else f"has not the arrays of {layout}"
        advice = f"layouts with its arrays: {', '.join(fitting)}" if fitting else "expected exp and pose, or the like"
        raise FaceDiffError(f"{path}: {stated}; give its layout; {advice}")
    stated_rate = next((content[key].item() for key in RATES if key in content and content[key].size == 1), None)
    if stated_rate is not None:
        stated_rate = check_number(path, "frame rate", stated_rate, *FRAME_RATES, text=True)
    rate = _rate(path, frame_rate, entry, stated_rate)
    parts = []
    for key, columns in (entry.arrays or {}).items():
        with damaged(f"{path}: {key}", "expected numbers (frames, channels)"):
            array: npt.NDArray[Any] = np.asarray(content[key], np.float64).reshape(*content[key].shape[-2:])
        # Exact for arrays that belong to the layout alone; SMPL-X's poses have the body's joints around the jaw.
        if array.shape[1] < columns.stop or (columns.start == 0 and array.shape[1] != columns.stop):
            raise FaceDiffError(
                f"{path}: {key} has {array.shape[1]} columns; expected {columns.stop} in {layout}; of more, write the "
                f"leading ones"
            )
        parts.append(array[:, columns])
    with damaged(path, "expected as many frames in each array"):
        values = np.concatenate(parts, axis=1)
    person = None
    if entry.identity_array in content:
        shape = np.atleast_2d(np.asarray(content[entry.identity_array], np.float64))
        # A reconstruction has a shape for each frame, which is one person's all the same.
        person = checked(
            path, shape.mean(0, keepdims=True) if path.suffix.lower() in HDF5_SUFFIXES else shape[:1], rate
        )[0]
    return _clip(path, checked(path, values, rate), entry, rate, layout, person)


def _rate(path: Path, given_rate: float | None, entry: Layout, stated: float | None = None) -> float:
    rate = given_rate or stated or entry.frame_rate
    return check_number(path, "frame rate", rate, *FRAME_RATES, remedy="give the frame rate of the video")


def _clip(
    path: Path,
    values: npt.NDArray[np.float32],
    entry: Layout,
    rate: float,
    layout: str,
    person: npt.NDArray[np.float32] | None,
) -> ParameterClip:
    name = path.parent.name if path.stem == "shape_pose_cam" else path.stem
    return ParameterClip(name, values, entry.space, rate, None, 0.0, person, layout, _remarks(values, entry))


def _remarks(values: npt.NDArray[np.float32], entry: Layout) -> tuple[str, ...]:
    """The community's mix-up, with the evidence for it; nothing is changed."""
    notes = []
    turns = {turn.joint: turn for turn in entry.space.rotations if turn.form == "axis_angle"}
    if {"head", "jaw"} <= set(turns):
        head, jaw = (values[:, list(turns[joint].channels)] for joint in ("head", "jaw"))
        # A jaw opens about x, in one direction, and hardly turns about y and z; a head turns about all three.
        if _jaw_like(head) and not _jaw_like(jaw):
            notes.append(
                f"head and jaw may be exchanged: the channels called head turn about x alone, from "
                f"{head[:, 0].min():.2f} to {head[:, 0].max():.2f} rad, and those called jaw by "
                f"{jaw[:, 1].std():.3f} and {jaw[:, 2].std():.3f} rad about y and z; compare the layouts "
                f"{', '.join(layouts_of_width(entry.width))}"
            )
    return tuple(notes)


ONE_AXIS = 0.2
"""A jaw's turns about y and z are less than this share of those about x."""
BACKWARDS = -0.05
"""Radians that a jaw closes beyond its rest."""


def _jaw_like(turns: npt.NDArray[np.float32]) -> bool:
    about_x = float(turns[:, 0].std())
    return (
        about_x > 0 and float(turns[:, 1:].std(0).max()) < ONE_AXIS * about_x and float(turns[:, 0].min()) > BACKWARDS
    )


def write_array(path: Path, clip: ParameterClip, layout: str = "") -> None:
    """Write a clip in a layout; the inverse of :func:`read_array`.

    Args:
        path: the ``.npy`` or ``.npz`` file.
        clip: with the layout's channels in its order; the coefficients of a person it does not have are zero.
        layout: name of the layout; the clip's own if empty.
    """
    name, archive = layout or clip.layout, path.suffix.lower() == ".npz"
    entry = find_layout(name, str(path))
    if clip.space.channels != entry.space.channels or not (entry.arrays if archive else entry.flat):
        raise FaceDiffError(
            f"{path}: {name} has other channels, or {'.npy' if archive else '.npz'} files only; change the clip's "
            f"order or rotations first, or the suffix"
        )
    with atomic(path) as temporary, temporary.open("wb") as stream:
        if not archive:
            person = np.zeros(entry.identity, np.float32) if clip.identity is None else clip.identity
            leading = np.broadcast_to(person, (len(clip.values), entry.identity))
            np.save(stream, np.concatenate([leading, clip.values], axis=1), allow_pickle=False)
            return
        content: dict[str, Floats] = {"fps": np.array(clip.frame_rate)}
        if entry.identity_array and clip.identity is not None:
            content[entry.identity_array] = clip.identity
        first = 0
        for key, columns in (entry.arrays or {}).items():
            # Of SMPL-X's 55 joints only the jaw is known; the body is at rest.
            content[key] = np.zeros((len(clip.values), 165 if columns.start else columns.stop), np.float32)
            width = columns.stop - columns.start
            content[key][:, columns] = clip.values[:, first : first + width]
            first += width
        np.savez(stream, allow_pickle=False, **content)
