"""Animation controls: expressiveness, procedural blinks, gaze and head sway, acting, and keys over time."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.limits import FRAME_RATES

# What edits an animation is imported where it is asked for: most animations have no controls.
if TYPE_CHECKING:
    from facediff.editing.direction import Direction


UNCHECKED = FRAME_RATES[1]
"""Frame rate by which frames and timecodes of keys are read before that of the animation is known: any may be right."""


@dataclass(frozen=True)
class AnimationControls:
    """What is changed in a finished animation. Everything is off by default.

    Attributes:
        expressiveness: scales the motion: ``1.2``, or by region, ``upper_face=1.5,lips=0.9``.
        blinks: blinks a minute.
        gaze: largest angle of wandering eyes in degrees.
        sway: largest angle of a swaying head in degrees.
        eyes: file that says where lids and eyeballs are; the built-in puppet needs none.
        seed: seed of blinks, gaze, sway and acting; that of the sample if None.
        direction: keys over time, or their file; see :mod:`facediff.editing.direction`.
        acting: brows, head and lids that move with the speech, by the name of a kind of acting with its options.

    Raises:
        FaceDiffError: naming the option whose value is impossible, or the file that is missing.

    Example:
        >>> AnimationControls(blinks=20, seed=1).is_off
        False
    """

    expressiveness: str | None = None
    blinks: ranges.BlinkRate | None = None
    gaze: ranges.GazeAngle | None = None
    sway: ranges.SwayAngle | None = None
    eyes: Path | None = None
    seed: ranges.Seed | None = None
    direction: Path | Direction | None = None
    acting: str | None = None

    def __post_init__(self) -> None:
        ranges.check_fields(self)
        _ = self.factors
        if isinstance(self.direction, Path) and not self.direction.exists():
            raise FaceDiffError(f"--direction {self.direction}: no such file; expected keys over time, .json or .csv")
        if self.eyes is not None and not self.eyes.is_file():
            raise FaceDiffError(
                f"--eyes {self.eyes}: no such file; expected .json or .npz (see docs/animation_controls.md)"
            )
        for option, idle, users in (
            ("--controls-seed", self.seed is not None and not self.is_procedural, "--blinks, --gaze or --sway"),
            ("--eyes", self.eyes is not None and self.is_off, "--expressiveness, --blinks or --gaze"),
        ):
            if idle:
                raise FaceDiffError(f"{option}: has no effect without {users}; give one of them, or omit it")
        if (keys := self.keys()) is not None:
            for name in ("expressiveness", "blinks", "gaze", "sway"):
                if getattr(self, name) is not None:
                    keys.refuse_both(name)
            if self.acting is None and "acting" in keys.channels:
                raise FaceDiffError(f"{keys.source}: channel acting: has no effect without --acting; give it as well")

    def keys(self, frame_rate: float | None = None) -> Direction | None:
        """The keys over time; None if there are none, or each recording of a folder has its own.

        Args:
            frame_rate: of frames and timecodes, where the keys do not say it; not checked yet if None.

        Raises:
            FaceDiffError: naming the file, the row and the field that is wrong.
        """
        if not isinstance(self.direction, Path):
            return self.direction
        if self.direction.is_dir():
            return None
        from facediff.editing.direction import read_direction

        return read_direction(self.direction, UNCHECKED if frame_rate is None else frame_rate)

    @property
    def is_procedural(self) -> bool:
        """Whether something is drawn at random: blinks, gaze, sway or acting."""
        if (self.blinks, self.gaze, self.sway, self.acting) != (None, None, None, None):
            return True
        if isinstance(self.direction, Path) and self.direction.is_dir():
            return True
        keys = self.keys()
        return keys is not None and any(keys.under(name) for name in ("blinks", "gaze", "sway"))

    @property
    def is_off(self) -> bool:
        """Whether nothing is changed."""
        options = (self.expressiveness, self.blinks, self.gaze, self.sway, self.direction, self.acting)
        return all(option is None for option in options)

    @property
    def factors(self) -> dict[str, float]:
        """The factors of expressiveness by region."""
        if self.expressiveness is None:
            return {}
        from facediff.editing.expressiveness import read_factors

        return read_factors(self.expressiveness)

    @property
    def without_keys(self) -> AnimationControls:
        """The controls without their keys over time."""
        if self.direction is None:
            return self
        made = copy(self)
        object.__setattr__(made, "direction", None)
        return made
