"""Animation controls on one face: eyes, brows and shapes are found once, for all of its animations.

From top to bottom: the amounts of all controls in each frame, from options, keys and acting together
(:class:`Amounts`); :class:`ControlledFace`, which applies them to whole animations or to a stretch of one; and
:func:`apply_controls` for a finished animation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.controls import keys_of, procedural
from facediff.editing.controls.brows import brows_of, raise_brows
from facediff.editing.controls.direction import METADATA, Direction, channel_of, curve, direction_of
from facediff.editing.controls.expressiveness import ALL, check_factors, read_factors, scaled_regions
from facediff.editing.controls.eyelids import GIVE, Eyes, eyes_for
from facediff.editing.controls.face_shapes import add_shapes, shapes_of
from facediff.editing.controls.procedural import EDITED, PROCEDURAL, SWAYS, Amount, in_words, with_metadata
from facediff.errors import FaceDiffError, OptionError
from facediff.utils.numerics import Array, Floats, Integers

if TYPE_CHECKING:
    from facediff.animation.options import AnimationControls

HEAD = ("head.pitch", "head.yaw", "head.roll")
ACTED = ("brows", "lids", *HEAD)
"""Channels of acting, in the order of its columns."""


@dataclass(frozen=True, eq=False)
class Amounts:
    """How much of everything there is in each frame of a stretch, with all that is random in it."""

    expressiveness: Mapping[str, Amount] = field(default_factory=dict)  # factors by region
    shapes: Mapping[str, Array] = field(default_factory=dict)  # weights (T,) by ARKit's names
    brows: Array | None = None  # millimetres (T,)
    gaze: Array | None = None  # degrees to the face's left and upwards (T, 2)
    lids: Array | None = None  # how far they are shut (T,)
    turns: Array | None = None  # rotations of the head (T, 3), axis-angle in radians
    shifts: Array | None = None  # of the head (T, 3), in head heights
    notes: tuple[tuple[str, str], ...] = ()  # entries of the metadata and their words

    def part(self, frames: slice) -> Amounts:
        """The amounts of some of the frames; the notes stay complete."""

        def cut(value: Any) -> Any:  # noqa: ANN401 - an array of frames, numbers, or arrays by name
            if isinstance(value, Mapping):
                return {name: cut(amount) for name, amount in value.items()}
            return value[frames] if isinstance(value, np.ndarray) else value

        return Amounts(**{name: cut(value) for name, value in vars(self).items()})


class ControlledFace:
    """One face with its controls.

    Args:
        controls: the options.
        direction: keys over time of the controls, with frames turned into seconds; None for none.
        template: the neutral face (V, 3).
        faces: triangles (F, 3).
        regions: vertex indices by name.
        unit: of length.
        name: for errors.
    """

    def __init__(
        self,
        controls: AnimationControls,
        direction: Direction | None,
        template: Floats,
        faces: Integers | None,
        regions: Mapping[str, Integers],
        unit: str,
        name: str,
    ) -> None:
        self.controls, self.direction = controls, direction
        channels = {} if direction is None else direction.channels
        self.factors = read_factors(controls.expressiveness)
        check_factors([*self.factors, *self._parts("expressiveness").values()], regions, name)
        self.eyes = self._needed_eyes(template, faces)
        moves_brows = controls.acting is not None or "brows" in channels
        self.brows = brows_of(template, faces, regions, unit, self.eyes) if moves_brows else None
        shapes = list(self._parts("shape").values())
        self.shapes = shapes_of(template, faces, unit, shapes) if shapes else {}

    def _parts(self, name: str) -> dict[str, str]:
        """The keyed channels of a name, and what they name after the dot, ``all`` if nothing."""
        channels = () if self.direction is None else self.direction.under(name)
        return {channel: channel.partition(".")[2] or ALL for channel in channels}

    def _needed_eyes(self, template: Floats, faces: Integers | None) -> Eyes | None:
        """The face's eyes, if anything needs them; some controls only work better where they are known."""
        controls, keyed = self.controls, {} if self.direction is None else self.direction.channels
        lids = "{blinks}" if controls.blinks is not None else next((n for n in ("blinks", "lids") if n in keyed), None)
        balls = "{gaze}" if controls.gaze is not None else "gaze" if "gaze" in keyed else None
        asking = lids or balls
        helped = controls.acting is not None or "brows" in keyed or self.factors or self._parts("expressiveness")
        if asking is None and not helped:
            return None
        eyes = eyes_for(template, faces, None if controls.eyes is None else Path(controls.eyes))
        if asking is not None and (eyes is None or (balls is not None and not eyes.eyeballs)):
            lacking = (
                "lids and eyeballs of this face are not known" if eyes is None else f"{eyes.source} has no eyeballs"
            )
            raise OptionError.naming(f"{asking if eyes is None else balls}: {lacking}; {GIVE}")
        if lids is not None and eyes is not None:
            eyes.lids()
        return eyes

    def refuse_whole_animation(self) -> None:
        """Refuse, for a stream, controls that depend on the end of the animation."""
        for name in ("blinks", "gaze", "sway"):
            source = "" if self.direction is None else f"{self.direction.source}: channel {name}"
            if control := f"--{name}" if getattr(self.controls, name) is not None else self._parts(name) and source:
                raise FaceDiffError(
                    f"{control}: needs the whole animation; animate a recording, or give --acting, which needs none"
                )

    def amounts(
        self, frames: int, frame_rate: float, *, seed: int = 0, start: int = 0, acting: Array | None = None
    ) -> Amounts:
        """How much of everything there is in a stretch of frames.

        Args:
            frames: how many.
            frame_rate: of them.
            seed: of blinks, gaze and sway, unless the controls have their own; these need all frames of an animation.
            start: the first of them.
            acting: values (frames, 5) of :data:`ACTED` in them, where there is acting.
        """
        controls = self.controls
        seed = seed if controls.controls_seed is None else controls.controls_seed
        times = (start + np.arange(frames)) / frame_rate
        curves = {
            name: curve(keys, times, eased=True)
            for name, keys in ({} if self.direction is None else self.direction.channels).items()
            if channel_of(name).range is not None
        }
        notes: list[tuple[str, str]] = []
        factors: dict[str, Amount] = dict(self.factors)
        factors |= {region: curves[name] for name, region in self._parts("expressiveness").items()}
        if factors:
            words = ", ".join(f"{name} {in_words(value)}" for name, value in factors.items())
            notes.append((EDITED, f"expressiveness ({words})"))
        shapes = {shape: curves[name] for name, shape in self._parts("shape").items()}
        if shapes:
            notes.append((EDITED, "shape keys"))
        poses: dict[str, Array] = {name: curves[name] for name in ACTED if name in curves}
        if acting is not None:
            strength = curves.get("acting", np.ones(frames))
            for name, values in zip(ACTED, acting.T, strict=True):
                # A blink is whole or not at all: its strength is how often it happens.
                values = values * (strength > 0 if name == "lids" else strength)
                limits = channel_of(name).range
                assert limits is not None  # noqa: S101 - for the type checker
                # Keys and acting add up, within the channel's range for keys alone.
                poses[name] = np.clip(poses[name] + values if name in poses else values, limits.least, limits.most)
        gaze, degrees = None, curves.get("gaze", controls.gaze)
        if degrees is not None and self.eyes is not None:
            gaze = procedural.gaze_curve(frames, frame_rate, degrees=degrees, seed=seed)
            notes.append((PROCEDURAL, f"gaze ({in_words(degrees)} degrees, seed {seed})"))
        lids, rate = poses.get("lids"), curves.get("blinks", controls.blinks)
        if rate is not None and self.eyes is not None and self.eyes.closing is not None:
            blinks = procedural.blinks_over_time(frames, frame_rate, rate, seed)
            lids = blinks if lids is None else np.maximum(lids, blinks)
            notes.append((PROCEDURAL, f"blinks ({in_words(rate)} a minute, seed {seed})"))
        turns, shifts, sway = None, np.zeros((frames, 3)), curves.get("sway", controls.sway)
        if any(name in poses for name in HEAD):
            turns = np.deg2rad(np.stack([poses.get(name, np.zeros(frames)) for name in HEAD], axis=1))
        if sway is not None:
            swaying, shifts = procedural.sway_curve(frames, frame_rate, degrees=sway, seed=seed)
            turns = swaying if turns is None else turns + swaying
            notes.append((PROCEDURAL, f"{SWAYS} ({in_words(sway)} degrees, seed {seed})"))
        if self._parts("head"):
            notes.append((EDITED, "head keys"))
        if acting is not None:
            notes.append((PROCEDURAL, f"brow and head acting ({controls.acting}, seed {seed})"))
        return Amounts(factors, shapes, poses.get("brows"), gaze, lids, turns, shifts, tuple(notes))

    def apply(self, animation: Animation, amounts: Amounts) -> Animation:
        """An animation, or a stretch of one, with everything changed that is asked for.

        The order is expressiveness, shapes, brows, gaze, lids, and last the head, which takes everything along.
        """
        if procedural.moves_head(animation):
            raise FaceDiffError(
                f"{animation.name}: its head moves already; apply the controls to the animation as it was before"
            )
        eyes = self.eyes

        def with_vertices(vertices: npt.NDArray[np.float32]) -> Animation:
            return replace(animation, vertices=vertices)

        # Expressiveness must not scale procedural motion, a blink must be able to shut eyes that gaze has opened, and
        # all of them need the head in the pose of the neutral face, which it leaves last.
        if amounts.expressiveness:
            animation = with_vertices(scaled_regions(animation, amounts.expressiveness, eyes))
        if amounts.shapes:
            animation = with_vertices(add_shapes(procedural.copied(animation.vertices), self.shapes, amounts.shapes))
        if self.brows is not None and amounts.brows is not None:
            animation = with_vertices(raise_brows(animation, self.brows, amounts.brows))
        if amounts.gaze is not None and eyes is not None:
            animation = with_vertices(procedural.turn_eyes(animation, eyes, amounts.gaze))
        if amounts.lids is not None and eyes is not None and eyes.closing is not None:
            animation = with_vertices(procedural.shut_lids(animation, eyes, amounts.lids))
        if amounts.turns is not None and amounts.shifts is not None:
            animation = procedural.move_head(animation, amounts.turns, amounts.shifts)
        for key, note in amounts.notes:
            animation = with_metadata(animation, animation.vertices, key, note)
        return self._with_direction(animation)

    def _with_direction(self, animation: Animation) -> Animation:
        """The animation with the direction in its metadata, next to the keys that it was generated with."""
        if self.direction is None:
            return animation
        name, direction = METADATA, self.direction
        if METADATA in animation.metadata:
            before = direction_of(animation)
            if before is None or set(direction.keys) <= set(before.keys):  # of a file from elsewhere, or there already
                return animation
            if set(direction.channels) & set(before.channels):  # both have changed it, one after the other
                name = f"{METADATA}, afterwards"
            else:
                instead_of = (*before.instead_of, *direction.instead_of)
                direction = Direction((*before.keys, *direction.keys), METADATA, instead_of)
        return replace(animation, metadata={**animation.metadata, name: direction.text()})


def apply_controls(animation: Animation, controls: AnimationControls, *, seed: int = 0) -> Animation:
    """A finished animation with controls applied, acting among them; the same object if there are none."""
    if controls.is_off:
        return animation
    direction = keys_of(controls.direction)
    if direction is not None:
        direction.refuse_model_channels()
        before = direction_of(animation)
        repeated = ["these keys"] if before is not None and set(direction.keys) <= set(before.keys) else []
        for option in direction.instead_of:
            replaced = before is not None and option in before.instead_of
            if replaced or f"{option} (" in animation.metadata.get(PROCEDURAL, ""):
                repeated.append(f"the motion of --{option}, which the keys replace (instead_of),")
        if repeated:
            raise FaceDiffError(
                f"{direction.source}: {animation.name} has {repeated[0]} already; give the animation as it was before"
            )
    seed, gestures = seed if controls.controls_seed is None else controls.controls_seed, None
    if controls.acting is not None:
        from facediff.editing.acting import act, read_acting

        gestures = act(read_acting(controls.acting), animation, seed)
    face = ControlledFace(
        *(controls, direction, animation.template, animation.faces, animation.regions, animation.unit, animation.name)
    )
    amounts = face.amounts(len(animation.vertices), animation.frame_rate, seed=seed, acting=gestures)
    return face.apply(animation, amounts)
