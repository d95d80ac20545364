"""Animation controls: expressiveness, and procedural blinks, gaze and head sway, applied to finished animations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils import ranges

# What edits an animation is imported where it is asked for: most animations have no controls.
if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.editing.eyes import Eyes


@dataclass(frozen=True)
class AnimationControls:
    """What is changed in a finished animation. Everything is off by default.

    Attributes:
        expressiveness: scales the motion: ``1.2``, or by region, ``upper_face=1.5,lips=0.9``.
        blinks: blinks a minute.
        gaze: largest angle of wandering eyes in degrees.
        sway: largest angle of a swaying head in degrees.
        eyes: file that says where lids and eyeballs are; the built-in puppet needs none.
        seed: seed of blinks, gaze and sway; that of the sample if None.

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

    def __post_init__(self) -> None:
        ranges.check_fields(self)
        _ = self.factors
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

    @property
    def is_procedural(self) -> bool:
        """Whether something is drawn at random: blinks, gaze or sway."""
        return (self.blinks, self.gaze, self.sway) != (None, None, None)

    @property
    def is_off(self) -> bool:
        """Whether nothing is changed."""
        return self.expressiveness is None and self.blinks is None and self.gaze is None and self.sway is None

    @property
    def factors(self) -> dict[str, float]:
        """The factors of expressiveness by region."""
        if self.expressiveness is None:
            return {}
        from facediff.editing.expressiveness import read_factors

        return read_factors(self.expressiveness)

    def check(
        self,
        template: npt.NDArray[np.floating],
        faces: npt.NDArray[np.integer] | None,
        regions: Mapping[str, object],
        name: str,
    ) -> None:
        """Refuse what cannot work on a face (V, 3), (F, 3), which errors call ``name``, before anything is sampled.

        Raises:
            FaceDiffError: if a region is unknown, or blinks or gaze are wanted and the eyes are not known.
        """
        if self.expressiveness is not None:
            from facediff.editing.expressiveness import check_factors

            check_factors(self.factors, regions, name)
        self._needed_eyes(template, faces)

    def apply(self, animation: Animation, *, seed: int = 0) -> Animation:
        """The animation with everything changed that is asked for; the very same one if nothing is.

        Expressiveness comes first, then gaze, blinks, and last the head, which takes everything along.

        Args:
            animation: a finished animation.
            seed: seed of blinks, gaze and sway, unless the controls have their own.

        Raises:
            FaceDiffError: naming the option that does not fit the animation, or if its head sways already.
        """
        if self.is_off:
            return animation
        from facediff.editing.procedural import PROCEDURAL, SWAYS, add_blinks, add_gaze, add_sway

        if SWAYS in animation.metadata.get(PROCEDURAL, ""):
            raise FaceDiffError(
                f"{animation.name}: its head sways already; apply the controls to the animation as it was before"
            )
        seed = seed if self.seed is None else self.seed
        eyes = self._needed_eyes(animation.template, animation.faces)
        # Expressiveness must not scale procedural motion, a blink must be able to shut eyes that gaze has opened, and
        # all of them need the head in the pose of the neutral face, which sway leaves.
        if self.expressiveness is not None:
            from facediff.editing.expressiveness import scale_regions

            animation = scale_regions(animation, self.factors, eyes)
        if self.gaze is not None and eyes is not None:
            animation = add_gaze(animation, eyes, degrees=self.gaze, seed=seed)
        if self.blinks is not None and eyes is not None:
            animation = add_blinks(animation, eyes, rate=self.blinks, seed=seed)
        if self.sway is not None:
            animation = add_sway(animation, degrees=self.sway, seed=seed)
        return animation

    def _needed_eyes(self, template: npt.NDArray[np.floating], faces: npt.NDArray[np.integer] | None) -> Eyes | None:
        """The face's eyes, if anything needs them; expressiveness only works better where they are known."""
        asking = "--blinks" if self.blinks is not None else "--gaze" if self.gaze is not None else None
        if asking is None and self.expressiveness is None:
            return None
        from facediff.editing.eyes import GIVE, eyes_for

        eyes = eyes_for(template, faces, self.eyes)
        if asking is None:
            return eyes
        if eyes is None:
            raise FaceDiffError(
                f"{asking}: needs to know where lids and eyeballs are, which is known for the built-in puppet only; "
                f"{GIVE}"
            )
        if self.blinks is not None:
            eyes.lids()
        if self.gaze is not None and not eyes.eyeballs:
            raise FaceDiffError(f"--gaze: {eyes.source} does not say which vertices are the eyeballs; add them")
        return eyes
