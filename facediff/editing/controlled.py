"""Animation controls on one face: what they need to know of it is found once, for all of its animations.

From top to bottom: the amounts of all controls in each frame, from options, keys and acting together
(:class:`Amounts`); :class:`ControlledFace`, which applies them to whole animations or to a stretch of one; and
:func:`apply_controls`, which does all of that for a finished animation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing import procedural
from facediff.editing.controls import keys_of, refuse_folder
from facediff.editing.direction import METADATA, Direction, channel_of, curve, direction_of
from facediff.editing.eyes import GIVE, Array, Eyes, eyes_for
from facediff.editing.procedural import EDITED, PROCEDURAL, Amount, noted
from facediff.errors import FaceDiffError, OptionError

if TYPE_CHECKING:
    from facediff.animation.options import AnimationControls
    from facediff.editing.brows import Brows
    from facediff.editing.face_shapes import Fields

HEAD = ("head.pitch", "head.yaw", "head.roll")
ACTED = ("brows", "lids", *HEAD)
"""What acting moves, in the order of its columns."""


@dataclass(frozen=True, eq=False)
class Amounts:
    """How much of everything there is in each frame of a stretch.

    Attributes:
        expressiveness: factors by region; empty if nothing is scaled.
        blinks: a minute; None for none. So for gaze and sway, which are in degrees.
        gaze: degrees.
        sway: degrees.
        shapes: weights (T,) by ARKit's names.
        brows: millimetres (T,).
        lids: shares (T,).
        turns: degrees of pitch, yaw and roll (T, 3).
    """

    expressiveness: Mapping[str, Amount] = field(default_factory=dict)
    blinks: Amount | None = None
    gaze: Amount | None = None
    sway: Amount | None = None
    shapes: Mapping[str, Array] = field(default_factory=dict)
    brows: Array | None = None
    lids: Array | None = None
    turns: Array | None = None


class ControlledFace:
    """One face whose animations are controlled.

    Args:
        controls: what is changed.
        direction: keys over time of the controls, with frames turned into seconds; None for none.
        template: the neutral face (V, 3).
        faces: triangles (F, 3).
        regions: vertex indices by name.
        unit: of length.
        name: what errors call it.
    """

    def __init__(
        self,
        controls: AnimationControls,
        direction: Direction | None,
        template: npt.NDArray[np.floating],
        faces: npt.NDArray[np.integer] | None,
        regions: Mapping[str, npt.NDArray[np.integer]],
        unit: str,
        name: str,
    ) -> None:
        self.controls, self.direction = controls, direction
        channels = {} if direction is None else direction.channels
        self.factors: dict[str, float] = {}
        if controls.expressiveness is not None:
            from facediff.editing.expressiveness import read_factors

            self.factors = read_factors(controls.expressiveness)
        keyed = (channel.partition(".")[2] or "all" for channel in self._keys("expressiveness"))
        factors = [*self.factors, *keyed]
        if factors:
            from facediff.editing.expressiveness import check_factors

            check_factors(dict.fromkeys(factors, 1.0), regions, name)
        self.eyes = self._needed_eyes(template, faces)
        self.brows: Brows | None = None
        if controls.acting is not None or "brows" in channels:
            from facediff.editing.brows import brows_of

            self.brows = brows_of(template, faces, regions, unit, self.eyes)

        self.shapes: Fields = {}
        if shapes := [channel.partition(".")[2] for channel in self._keys("shape")]:
            from facediff.editing.face_shapes import shapes_of

            self.shapes = shapes_of(template, faces, unit, shapes)

    def _keys(self, name: str) -> dict[str, object]:
        return {} if self.direction is None else dict(self.direction.under(name))

    def _needed_eyes(self, template: npt.NDArray[np.floating], faces: npt.NDArray[np.integer] | None) -> Eyes | None:
        """The face's eyes, if anything needs them; some controls only work better where they are known."""
        controls = self.controls
        lids = (
            "{blinks}" if controls.blinks is not None else next((n for n in ("blinks", "lids") if self._keys(n)), None)
        )
        balls = "{gaze}" if controls.gaze is not None else "gaze" if self._keys("gaze") else None
        helped = controls.expressiveness is not None or controls.acting is not None
        helped = helped or bool(self._keys("expressiveness") or self._keys("brows"))
        asking = lids or balls
        if asking is None and not helped:
            return None
        eyes = eyes_for(template, faces, None if controls.eyes is None else Path(controls.eyes))
        if asking is None:
            return eyes
        if eyes is None:
            raise OptionError.naming(
                f"{asking}: needs to know where lids and eyeballs are, which is known for the built-in puppet only; "
                f"{GIVE}"
            )
        if lids is not None:
            eyes.lids()
        if balls is not None and not eyes.eyeballs:
            raise OptionError.naming(f"{balls}: {eyes.source} does not say which vertices are the eyeballs; add them")
        return eyes

    def refuse_whole_animation(self) -> None:
        """Refuse, for a stream, what depends on where the animation ends."""
        for name in ("blinks", "gaze", "sway"):
            if getattr(self.controls, name) is not None:
                raise FaceDiffError(
                    f"--{name}: needs the whole animation; give --acting, which needs none, or animate a recording"
                )
            if self._keys(name) and self.direction is not None:
                raise FaceDiffError(
                    f"{self.direction.source}: channel {name}: needs the whole animation; animate a recording"
                )

    def amounts(self, frames: int, frame_rate: float, *, start: int = 0, acted: Array | None = None) -> Amounts:
        """How much of everything there is in a stretch of frames.

        Args:
            frames: how many.
            frame_rate: of them.
            start: the first of them.
            acted: values (frames, 5) of :data:`ACTED` in them, where there is acting.
        """
        controls = self.controls
        times = (start + np.arange(frames)) / frame_rate
        curves = (
            {}
            if self.direction is None
            else {
                name: curve(keys, times, eased=True)
                for name, keys in self.direction.channels.items()
                if channel_of(name).range is not None
            }
        )
        factors: dict[str, Amount] = dict(self.factors)
        factors |= {name.partition(".")[2] or "all": curves[name] for name in self._keys("expressiveness")}

        def of_option(name: str, number: float | None) -> Amount | None:
            return curves.get(name, number)

        poses: dict[str, Array] = {name: curves[name] for name in ACTED if name in curves}
        if acted is not None:
            strength = curves.get("acting", np.ones(frames))
            for name, values in zip(ACTED, acted.T, strict=True):
                # A blink is whole or not at all: its strength is how often it happens.
                values = values * (strength > 0 if name == "lids" else strength)
                limits = channel_of(name).range
                assert limits is not None  # noqa: S101 - for the type checker
                # Keys and acting add up, within what the channel allows for keys alone.
                poses[name] = np.clip(poses[name] + values if name in poses else values, limits.least, limits.most)
        turned = any(name in poses for name in HEAD)
        return Amounts(
            factors,
            of_option("blinks", controls.blinks),
            of_option("gaze", controls.gaze),
            of_option("sway", controls.sway),
            {name.partition(".")[2]: curves[name] for name in self._keys("shape")},
            poses.get("brows"),
            poses.get("lids"),
            np.stack([poses.get(name, np.zeros(frames)) for name in HEAD], axis=1) if turned else None,
        )

    def apply(self, animation: Animation, *, seed: int = 0, start: int = 0, acted: Array | None = None) -> Animation:
        """The animation, or a stretch of one that begins at a frame, with everything changed that is asked for.

        Expressiveness comes first, then shapes, brows, gaze and lids, and last the head, which takes everything along.

        Args:
            animation: of the face, with frames as the model made them.
            seed: of blinks, gaze and sway, unless the controls have their own.
            start: the number of its first frame; blinks, gaze and sway need all frames.
            acted: values (T, 5) of :data:`ACTED`, where there is acting.
        """
        if procedural.moves_head(animation):
            raise FaceDiffError(
                f"{animation.name}: its head moves already; apply the controls to the animation as it was before"
            )
        seed = seed if self.controls.controls_seed is None else self.controls.controls_seed
        frames, rate, eyes = len(animation.vertices), animation.frame_rate, self.eyes
        amounts = self.amounts(frames, rate, start=start, acted=acted)
        # Expressiveness must not scale procedural motion, a blink must be able to shut eyes that gaze has opened, and
        # all of them need the head in the pose of the neutral face, which it leaves last.
        if amounts.expressiveness:
            from facediff.editing.expressiveness import scale_regions

            animation = scale_regions(animation, amounts.expressiveness, eyes)
        if amounts.shapes:
            from facediff.editing.face_shapes import add_shapes

            moved = add_shapes(procedural.copied(animation.vertices), self.shapes, amounts.shapes)
            animation = noted(animation, moved, EDITED, "shape keys")
        if self.brows is not None and amounts.brows is not None:
            from facediff.editing.brows import raise_brows

            animation = replace(animation, vertices=raise_brows(animation, self.brows, amounts.brows))
        if amounts.gaze is not None and eyes is not None:
            animation = procedural.add_gaze(animation, eyes, degrees=amounts.gaze, seed=seed)
        animation = self._with_lids(animation, amounts, seed)
        animation = self._with_head(animation, amounts, seed)
        if acted is not None:
            note = f"brow and head acting ({self.controls.acting}, seed {seed})"
            animation = noted(animation, animation.vertices, PROCEDURAL, note)
        return self._with_direction(animation)

    def _with_lids(self, animation: Animation, amounts: Amounts, seed: int) -> Animation:
        if self.eyes is None or self.eyes.closing is None or (amounts.blinks is None and amounts.lids is None):
            return animation
        if amounts.lids is None and amounts.blinks is not None:
            return procedural.add_blinks(animation, self.eyes, rate=amounts.blinks, seed=seed)
        shut = np.zeros(len(animation.vertices)) if amounts.lids is None else amounts.lids
        if amounts.blinks is not None:
            frames, rate = len(animation.vertices), animation.frame_rate
            shut = np.maximum(shut, procedural.blinks_over_time(frames, rate, amounts.blinks, seed))
            animation = noted(animation, animation.vertices, PROCEDURAL, procedural.blink_words(amounts.blinks, seed))
        return replace(animation, vertices=procedural.shut_lids(animation, self.eyes, shut))

    def _with_head(self, animation: Animation, amounts: Amounts, seed: int) -> Animation:
        if amounts.turns is None:
            if amounts.sway is None:
                return animation
            return procedural.add_sway(animation, degrees=amounts.sway, seed=seed)
        frames = len(animation.vertices)
        turns, shifts = np.deg2rad(amounts.turns), np.zeros((frames, 3))
        if amounts.sway is not None:
            swaying, shifts = procedural.sway_over_time(frames, animation.frame_rate, amounts.sway, seed)
            turns = turns + swaying
            animation = noted(animation, animation.vertices, PROCEDURAL, procedural.sway_words(amounts.sway, seed))
        if self._keys("head"):
            animation = noted(animation, animation.vertices, EDITED, "head keys")
        return procedural.move_head(animation, turns, shifts)

    def _with_direction(self, animation: Animation) -> Animation:
        """The direction in the metadata, next to what the animation was made with; that a model follows is there."""
        if self.direction is None:
            return animation
        name, direction = METADATA, self.direction
        if METADATA in animation.metadata:
            before = direction_of(animation)
            if before is None:  # of a file from elsewhere
                return animation
            if set(direction.keys) <= set(before.keys):
                return animation
            if set(direction.channels) & set(before.channels):  # both have changed it, one after the other
                name = f"{METADATA}, afterwards"
            else:
                instead_of = (*before.instead_of, *direction.instead_of)
                direction = Direction((*before.keys, *direction.keys), METADATA, instead_of)
        return replace(animation, metadata={**animation.metadata, name: direction.text()})


def apply_controls(animation: Animation, controls: AnimationControls, *, seed: int = 0) -> Animation:
    """A finished animation with controls applied, acting among them; the same object if there are none.

    Args:
        animation: with frames as the model made them.
        controls: what is changed.
        seed: of blinks, gaze, sway and acting, unless the controls have their own.
    """
    if controls.is_off:
        return animation
    refuse_folder(controls.direction)
    direction = keys_of(controls.direction, animation.frame_rate)
    if direction is not None:
        direction.refuse_model_channels()
        before = direction_of(animation)
        if before is not None and set(direction.keys) <= set(before.keys):
            raise FaceDiffError(
                f"{direction.source}: {animation.name} has these keys already; give the animation as it was before"
            )
        for option in direction.instead_of:
            turned = before is not None and option in before.instead_of
            if turned or f"{option} (" in animation.metadata.get(PROCEDURAL, ""):
                raise FaceDiffError(
                    f"{direction.source}: instead_of: the keys do what --{option} did, and {animation.name} has that "
                    f"already; give the animation as it was before"
                )
    acted = None
    if controls.acting is not None:
        from facediff.editing.acting import act, read_acting

        acted = act(
            read_acting(controls.acting), animation, seed if controls.controls_seed is None else controls.controls_seed
        )
    face = ControlledFace(
        controls,
        direction,
        animation.template,
        animation.faces,
        animation.regions,
        animation.unit,
        animation.name,
    )
    return face.apply(animation, seed=seed, acted=acted)
