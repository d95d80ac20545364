"""Channels of one speaker as vertices, for models that generate channels: with PyTorch, exported, and live."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from facediff.spaces.rotations import convert
from facediff.spaces.space import Space
from facediff.utils.numerics import Floats

Array = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ChannelDecoder:
    """From absolute channels of a speaker to vertices, head turns and weights at rest.

    Example:
        >>> space = Space("linear", ("jawOpen",))
        >>> decoder = ChannelDecoder(space, np.zeros(1), np.zeros((2, 3)), np.ones((1, 2, 3)))
        >>> decoder.vertices(np.full((1, 1, 1), 0.5)).tolist()
        [[[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]]
    """

    space: Space
    resting: Floats  # (C,) values of the channels at rest
    neutral: Floats  # (V, 3) the face at rest
    deltas: Floats  # (K, V, 3) displacements of the vertices at 1 of each channel of :attr:`Space.face`

    def vertices(self, points: Floats) -> Array:
        """Absolute vertices (T, V, 3) of absolute channels (T, C, 1); the head as a whole stays where it is."""
        weights = (points[..., 0] - self.resting)[:, list(self.space.face)].astype(np.float32)
        moved = weights @ np.asarray(self.deltas, np.float32).reshape(len(self.deltas), -1)
        moved = moved.reshape(len(points), *self.neutral.shape)
        moved += self.neutral
        return moved

    @staticmethod
    def values(points: Floats) -> Array:
        """Channels (T, C) as animations keep them."""
        return np.ascontiguousarray(points[..., 0], np.float32)

    def head_turns(self, points: Floats) -> npt.NDArray[np.float64] | None:
        """How the head turns as a whole (T, 3), axis-angle in radians; None where no channel says it."""
        turn = next((turn for turn in self.space.rotations if turn.joint == "head"), None)
        return None if turn is None else convert(points[:, list(turn.channels), 0], turn.form, "axis_angle")

    @cached_property
    def rest_weights(self) -> Array:
        """How far each channel (C,) goes to rest in pauses: 1 in the lower face, else 0."""
        upper = {*self.space.region("upper_face"), *self.space.region("eyes")}
        weights = np.zeros(len(self.space.channels), np.float32)
        weights[[channel for channel in self.space.face if channel not in upper]] = 1.0
        return weights
