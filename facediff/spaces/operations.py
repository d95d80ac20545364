"""Operations on motion in parameters: order of channels, frame rate and form of rotations.

Values are (T, C), one column for each channel of a space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from facediff.errors import FaceDiffError
from facediff.spaces.rotations import convert, slerp
from facediff.spaces.space import WIDTHS, Form, Rotation, Space
from facediff.utils import ranges
from facediff.utils.limits import quoted
from facediff.utils.numerics import Array, Floats

Values = Floats

FLOOR = 1e-4
"""Standard deviation below which a channel counts as dead, as a share of the largest one."""


def permuted(values: Values, source: Space, target: Space) -> tuple[Values, Space]:
    """Values in the order of another space's channels, by name without case.

    Channels that the source lacks are 0, and the returned space declares them as absent, which differs from a channel
    at rest. Channels that the target lacks are left out.

    Example:
        >>> from facediff.spaces.layouts import layout
        >>> values, space = permuted(np.ones((1, 51)), layout("arkit_51"), layout("arkit"))
        >>> values.sum(), space.absent
        (np.float64(51.0), ('tongueOut',))
    """
    column = {name.casefold(): index for index, name in enumerate(source.channels)}
    columns = [column.get(name.casefold()) for name in target.channels]
    forms = {turn.joint: turn.form for turn in source.rotations}
    versions = {source.version, target.version} - {""}
    if (
        source.kind != target.kind
        or len(versions) > 1
        or any(forms.get(turn.joint, turn.form) != turn.form for turn in target.rotations)
        or all(index is None for index in columns)
    ):
        raise FaceDiffError(
            f"space: is {source.kind} {source.version} with rotations {forms}; expected {target.kind} "
            f"{target.version} with the channels {quoted(list(target.channels))} and their form of rotations: convert "
            f"rotations first, and other kinds through vertices"
        )
    result = np.zeros((len(values), len(columns)), values.dtype)
    for row, index in enumerate(columns):
        if index is not None:
            result[:, row] = values[:, index]
    unknown = {name.casefold() for name in source.absent}
    unknown |= {name.casefold() for name, index in zip(target.channels, columns, strict=True) if index is None}
    lacking = [name for name in target.channels if name.casefold() in unknown]
    lacking += [name for name in target.absent if name not in target.channels]
    version = source.version or target.version
    return result, replace(target, version=version, rig=source.rig, rig_hash=source.rig_hash, absent=tuple(lacking))


def at_rest(space: Space) -> Array:
    """Values (C,) of a space at rest; all 0 but for rotations of six numbers and quaternions."""
    rest = np.zeros(len(space.channels))
    for turn in space.rotations:
        rest[list(turn.channels)] = convert(np.zeros((1, 3)), "axis_angle", turn.form)[0]
    return rest


def with_apples_mouth(weights: Values, names: Sequence[str]) -> Values:
    """Audio2Face's weights (T, K) in Apple's meaning, whose ``mouthClose`` is added to ``jawOpen``.

    NVIDIA's closes the mouth over an open jaw, which both of Apple's together do.
    """
    weights = weights.copy()
    if {"jawOpen", "mouthClose"} <= {*names}:
        weights[:, names.index("jawOpen")] += weights[:, names.index("mouthClose")]
    return weights


def with_rotations(values: Values, space: Space, form: Form, joints: tuple[str, ...] = ()) -> tuple[Array, Space]:
    """Values with their rotations in another form.

    Args:
        values: (T, C).
        space: their space.
        form: of the result.
        joints: that are converted; all if empty.
    """
    from facediff.spaces.layouts import AXES

    columns, channels, turns = np.asarray(values, np.float64), list(space.channels), []
    for turn in sorted(space.rotations, key=lambda turn: turn.start, reverse=True):  # later ones keep their places
        if (joints and turn.joint not in joints) or turn.form == form:
            turns.append((turn.joint, turn.form, channels[turn.start]))
            continue
        run = slice(turn.start, turn.start + WIDTHS[turn.form])
        turned = convert(columns[:, run], turn.form, form)
        columns = np.concatenate([columns[:, : run.start], turned, columns[:, run.stop :]], axis=1)
        channels[run] = [f"{turn.joint}_{axis}" for axis in AXES[form]]
        turns.append((turn.joint, form, channels[turn.start]))
    rotations = tuple(Rotation(joint, channels.index(first), kind) for joint, kind, first in reversed(turns))
    return columns, replace(space, channels=tuple(channels), rotations=rotations)


@ranges.checked
def resampled(values: Values, space: Space, frame_rate: ranges.FrameRate, new_rate: ranges.FrameRate) -> Array:
    """Values at another frame rate: weights linearly, rotations on the shortest way between two of them (SO(3)).

    The last frame is the last one that does not lie after the motion's end.

    Args:
        values: (T, C).
        space: their space.
        frame_rate: frames a second of these.
        new_rate: frames a second of the result.
    """
    old_times = np.arange(len(values)) / frame_rate
    # The small share keeps a frame that rounding puts just after the end.
    new_times = np.arange(int(old_times[-1] * new_rate + 1e-6) + 1) / new_rate if len(values) else old_times
    return at_times(values, space, old_times, new_times)


def at_times(values: Values, space: Space, times: Array, new_times: Array) -> Array:
    """Values at other times, as :func:`resampled` interpolates; before the first and after the last frame, these.

    Args:
        values: (T, C).
        space: their space.
        times: (T,) seconds, ascending.
        new_times: (S,) seconds.
    """
    numbers = np.asarray(values, np.float64)
    position = np.interp(new_times, times, np.arange(len(times)))
    before = np.minimum(position.astype(np.int64), len(times) - 1)
    after = np.minimum(before + 1, len(times) - 1)
    share = position - before
    result = (1.0 - share)[:, None] * numbers[before] + share[:, None] * numbers[after]
    for turn in space.rotations:
        quaternions = convert(numbers[:, list(turn.channels)], turn.form, "quaternion")
        between = slerp(quaternions[before], quaternions[after], share)
        turned = convert(between, "quaternion", turn.form)
        # Between frames only: a frame's own numbers stay as they are, such as an angle beyond π.
        inside = (share > 0)[:, None]
        result[:, list(turn.channels)] = np.where(inside, turned, result[:, list(turn.channels)])
    return np.asarray(result)
