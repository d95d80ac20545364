"""Animation controls: expressiveness, procedural blinks, gaze and head sway, acting, and keys over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from facediff.animation.options import AnimationControls, DirectionLike
from facediff.errors import OptionError, refuse_idle

# What edits an animation is imported where it is asked for: most animations have no controls.
if TYPE_CHECKING:
    from facediff.editing.controls.direction import Direction


def check_controls(controls: AnimationControls) -> None:
    """Refuse animation controls that contradict each other, and files that do not exist."""
    if controls.expressiveness is not None:
        from facediff.editing.controls.expressiveness import read_factors

        read_factors(controls.expressiveness)
    for option, path, expected in (
        ("direction", keys_file(controls.direction), "keys over time, .json or .csv, or a mood such as calm"),
        ("eyes", controls.eyes, ".json (see docs/animation_controls.md)"),
    ):
        if path is not None and not Path(path).is_file():
            raise OptionError(option, f"no such file; expected {expected}", path)
    for option, idle, users in (
        ("controls_seed", not is_procedural(controls), "{blinks}, {gaze}, {sway} or {acting}"),
        ("eyes", controls.is_off, "{expressiveness}, {blinks}, {gaze} or {acting}"),
    ):
        refuse_idle(f"has no effect without {users}", **{option: idle and getattr(controls, option) is not None})
    if (keys := keys_of(controls.direction)) is not None:
        for name in ("expressiveness", "blinks", "gaze", "sway", *keys.instead_of):
            if getattr(controls, name) is not None:
                keys.refuse_both(name)
        if controls.acting is None and "acting" in keys.channels:
            raise OptionError("", f"{keys.source}: channel acting: has no effect without {{acting}}; give it as well")


def keys_file(direction: DirectionLike | None) -> Path | None:
    """The file of keys over time; None where the keys themselves or a mood were given."""
    if not isinstance(direction, str | Path):
        return None
    from facediff.editing.controls.direction import is_mood

    return None if is_mood(direction) else Path(direction)


def keys_of(direction: DirectionLike | None) -> Direction | None:
    """The keys over time; None if there are none."""
    if direction is None:
        return None
    from facediff.editing.controls.direction import Direction, read_direction

    if isinstance(direction, str | Path):
        return read_direction(direction)
    return direction if isinstance(direction, Direction) else Direction.parse(direction, "direction")


def is_procedural(controls: AnimationControls) -> bool:
    """Whether something is drawn at random: blinks, gaze, sway or acting."""
    if (controls.blinks, controls.gaze, controls.sway, controls.acting) != (None, None, None, None):
        return True
    keys = keys_of(controls.direction)
    return keys is not None and any(keys.under(name) for name in ("blinks", "gaze", "sway"))
