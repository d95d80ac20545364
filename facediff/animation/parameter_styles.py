"""Motion in parameters after ``--style``: a take of Live Link Face, BEAT's files, or arrays with their layout.

For models of channels with and without PyTorch alike.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.animation.archives import read_archive
from facediff.animation.style_files import open_style, with_layout
from facediff.errors import FaceDiffError, OptionError
from facediff.spaces import Space
from facediff.spaces.files import ParameterClip, even, read_parameters
from facediff.spaces.layouts import LAYOUTS, layout
from facediff.spaces.operations import permuted, resampled
from facediff.utils.arrays import read_arrays

PARAMETER_FILES = (".csv", ".json", ".npy", ".npz", ".pt")
"""Suffixes of motion in parameters; ``.pt`` are ARTalk's style clips, which need PyTorch."""


def recorded_parameters(source: str, frame_rate: float) -> ParameterClip | None:
    """Motion in parameters of a style: ``clip.json``, or ``clip.npy@flame_artalk`` with its layout.

    None if it is none: a name, a style vector, or an animation of vertices.

    Args:
        source: a file, with ``@`` and its layout if it does not say that itself.
        frame_rate: frames a second of an array, if its layout has no rate.
    """
    path, stated = with_layout(source)
    if path.suffix not in PARAMETER_FILES or (stated is None and not path.is_file()):
        return None
    if not path.is_file():
        raise OptionError.naming(f"{{style}} {path}: no such file")
    if path.suffix == ".pt":
        raise OptionError.naming(f"{{style}} {path}: is read by checkpoints only; give the clip as .npy@LAYOUT")
    if path.suffix == ".npz" and stated is None and "template" in read_arrays(path, {"template"}):
        animation = read_archive(path)
        if animation.values is None:
            return None
        return ParameterClip(animation.name, animation.values, animation.space, animation.frame_rate)
    if path.suffix == ".npy" and open_style(path).array.ndim == 1:
        return None
    if stated is None and path.suffix in (".npy", ".npz"):
        try:
            return read_parameters(path)  # which says what layouts fit
        except FaceDiffError as error:
            raise OptionError.naming(f"{{style}} {error}, as in {path.name}@LAYOUT") from error
    without_rate = path.suffix == ".npy" and stated in LAYOUTS and LAYOUTS[stated].frame_rate is None
    return read_parameters(path, layout=stated, frame_rate=frame_rate if without_rate else None)


def channels_of(recorded: ParameterClip, space: Space, frame_rate: float) -> npt.NDArray[np.float32]:
    """Motion in parameters (T, C) in the order of a model's space and at its frame rate.

    What phones do not record, such as a tongue that goes up, is at 0.
    """
    if space.is_vertices:
        raise OptionError.naming(
            f"{{style}} {recorded.name}: is motion in parameters, and this model takes vertices; give such a motion"
        )
    recorded = even(recorded)  # an app drops rows
    values, ordered_space = permuted(recorded.values, recorded.space, space)
    unrecorded = {*space.channels} - {*layout("live_link").channels} if space.kind == "arkit" else set()
    lacking = [
        name for name in ordered_space.absent if name in space.channels and name not in {*space.absent, *unrecorded}
    ]
    if lacking:
        raise OptionError.naming(
            f"{{style}} {recorded.name}: lacks {', '.join(lacking[:4])}{' …' if len(lacking) > 4 else ''}; give a "
            f"motion with the model's channels"
        )
    if abs(recorded.frame_rate - frame_rate) > 1e-6:
        values = resampled(values, space, recorded.frame_rate, frame_rate)
    return values.astype(np.float32)
