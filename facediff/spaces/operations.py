"""Exact operations on motion in parameters: other orders, rates and forms of rotation, and standardisation.

Values are (T, C), one column for each channel of a space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.spaces.rotations import convert, slerp
from facediff.spaces.space import WIDTHS, Form, Rotation, Space
from facediff.utils import ranges
from facediff.utils.limits import quoted

Array = npt.NDArray[np.float64]
Values = npt.NDArray[np.floating]

FLOOR = 1e-4
"""Standard deviation below which a channel counts as dead, as a share of the largest one."""


def check_values(values: Values, space: Space) -> None:
    """Refuse values that are not (frames, channels) of a space."""
    if values.ndim != 2 or values.shape[1] != len(space.channels):
        raise FaceDiffError(
            f"motion: has shape {values.shape}; expected (frames, {len(space.channels)}) as the space has channels"
        )


def permuted(values: Values, source: Space, target: Space) -> tuple[Values, Space]:
    """Values in the order of another space's channels, by name whatever its case.

    Channels that the source lacks are 0, and the space that is returned declares them as absent: an absent channel is
    something else than one that rests. Channels that the target lacks are left out, and so are the source's rotations
    that the target does not have in the same form.

    Args:
        values: (T, C) in the source's order.
        source: their space.
        target: whose channels are returned, under its names.

    Example:
        >>> from facediff.spaces.layouts import layout
        >>> values, space = permuted(np.ones((1, 51)), layout("arkit_51"), layout("arkit"))
        >>> values.sum(), space.absent
        (np.float64(51.0), ('tongueOut',))
    """
    check_values(values, source)
    if source.kind != target.kind or (source.version and target.version and source.version != target.version):
        raise FaceDiffError(
            f"space: is {source.kind} {source.version}; expected {target.kind} {target.version}, whose channels mean "
            f"something else: go through vertices"
        )
    column = {name.casefold(): index for index, name in enumerate(source.channels)}
    place = [column.get(name.casefold()) for name in target.channels]
    for turn in target.rotations:
        forms = {one.joint: one.form for one in source.rotations}
        if turn.joint in forms and forms[turn.joint] != turn.form:
            raise FaceDiffError(
                f"space: writes the {turn.joint} as {forms[turn.joint]}; expected {turn.form}: convert it first"
            )
    if all(index is None for index in place):
        raise FaceDiffError(f"space: has none of the channels {quoted(list(target.channels))}; check its layout")
    gone = {name.casefold() for name in source.absent}
    absent = [
        name for name, index in zip(target.channels, place, strict=True) if index is None or name.casefold() in gone
    ]
    result = np.zeros((len(values), len(place)), values.dtype)
    for to, index in enumerate(place):
        if index is not None:
            result[:, to] = values[:, index]
    beyond = [name for name in target.absent if name not in absent and name not in target.channels]
    own = replace(target, version=source.version or target.version, rig=source.rig, rig_hash=source.rig_hash)
    return result, replace(own, absent=(*absent, *beyond))


def truncated(values: Values, space: Space, counts: dict[str, int]) -> tuple[Values, Space]:
    """The leading coefficients of families of channels, such as 50 of FLAME's 100 expressions.

    A basis is ordered by variance, so that this is the same face with less detail and no refit.

    Args:
        values: (T, C).
        space: their space.
        counts: coefficients that are kept, by the family's name: ``{"expression": 50}``.
    """
    check_values(values, space)
    dropped: set[str] = set()
    for family, count in counts.items():
        members = {
            name for name in space.channels if name.rpartition("_")[0] == family and name.rpartition("_")[2].isdecimal()
        }
        if count > len(members) or count < 0:
            raise FaceDiffError(f"space: has {len(members)} coefficients of {family}; expected at least {count}")
        dropped |= {name for name in members if int(name.rpartition("_")[2]) >= count}
    kept = [index for index, name in enumerate(space.channels) if name not in dropped]
    turns = tuple(replace(turn, start=kept.index(turn.start)) for turn in space.rotations)
    channels = tuple(space.channels[index] for index in kept)
    return values[:, kept], replace(space, channels=channels, rotations=turns)


def with_rotations(values: Values, space: Space, form: Form, joints: tuple[str, ...] = ()) -> tuple[Array, Space]:
    """Values whose rotations are written in another form.

    Args:
        values: (T, C).
        space: their space.
        form: the form that is returned.
        joints: those that are rewritten; all if empty.
    """
    from facediff.spaces.layouts import AXES

    check_values(values, space)
    columns: list[Array] = []
    channels: list[str] = []
    turns: list[Rotation] = []
    starts = {turn.start: turn for turn in space.rotations}
    index = 0
    while index < len(space.channels):
        turn = starts.get(index)
        if turn is None:
            columns.append(np.asarray(values[:, index : index + 1], np.float64))
            channels.append(space.channels[index])
            index += 1
            continue
        old = np.asarray(values[:, list(turn.channels)], np.float64)
        names = [space.channels[channel] for channel in turn.channels]
        chosen = form if not joints or turn.joint in joints else turn.form
        if chosen != turn.form:
            old, names = convert(old, turn.form, chosen), [f"{turn.joint}_{axis}" for axis in AXES[chosen]]
        turns.append(Rotation(turn.joint, len(channels), chosen))
        columns.append(old)
        channels += names
        index += WIDTHS[turn.form]
    return np.concatenate(columns, axis=1), replace(space, channels=tuple(channels), rotations=tuple(turns))


@ranges.checked
def resampled(values: Values, space: Space, frame_rate: ranges.FrameRate, new_rate: ranges.FrameRate) -> Array:
    """Values at another frame rate: weights linearly, rotations on the shortest way between two of them (SO(3)).

    The last frame is the last one that does not lie after the motion's end.

    Args:
        values: (T, C).
        space: their space.
        frame_rate: frames a second.
        new_rate: frames a second of what is returned.
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
    check_values(values, space)
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


@dataclass(frozen=True, eq=False)
class Standardisation:
    """Mean and standard deviation of each channel.

    Channels that hardly move (ARKit's tongueOut, cheekPuff) would be blown up by their own deviation: below the floor,
    they are divided by 1 and stay near 0.

    Attributes:
        mean: (C,).
        deviation: (C,) what is divided by.
        dead: channels without motion.
    """

    mean: Array
    deviation: Array
    dead: tuple[int, ...] = ()

    @classmethod
    def measured(cls, values: Values) -> Standardisation:
        """Of all frames (T, C)."""
        numbers = np.asarray(values, np.float64)
        deviation = numbers.std(axis=0)
        still = deviation <= FLOOR * deviation.max(initial=0.0)
        return cls(numbers.mean(axis=0), np.where(still, 1.0, deviation), tuple(map(int, np.flatnonzero(still))))

    def apply(self, values: Values) -> Array:
        """Standardised values (T, C)."""
        return np.asarray((values - self.mean) / self.deviation, np.float64)

    def undo(self, values: Values) -> Array:
        """The inverse of :meth:`apply`."""
        return np.asarray(values * self.deviation + self.mean, np.float64)
