"""A mouth that comes to rest where nobody speaks: the openness of each frame, applied to the model's motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facediff.data.voice_activity import Openness, VoiceGate


class MouthAtRest:
    """Brings the mouth of one face to rest in pauses; the upper face keeps its motion.

    Where the gate is open, the motion is bit for bit the model's.

    Args:
        gate: finds speech.
        template: neutral face (V, 3); at rest, the mouth is its mouth.
        regions: vertex indices by name, ``upper_face`` among them.
        frame_rate: of the motion.
    """

    def __init__(
        self,
        gate: VoiceGate,
        template: npt.NDArray[np.floating],
        regions: Mapping[str, npt.NDArray[np.integer]],
        frame_rate: float,
    ) -> None:
        from facediff.editing.expressiveness import ALL, region_factors

        self.gate, self.frame_rate = gate, frame_rate
        self.template = np.asarray(template, np.float32)
        # Everything that speech moves, fading into the upper face as regions fade elsewhere.
        weights = region_factors(self.template, regions, {"upper_face": 0.0, ALL: 1.0})
        self.weights = weights.astype(np.float32)[:, None]

    def openness(self) -> Openness:
        """The openness of a recording that has not begun yet."""
        return Openness(self.gate, self.frame_rate)

    def apply(self, vertices: npt.NDArray[np.float32], openness: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Vertices (T, V, 3) with the mouth as far at rest as the openness (T,) says."""
        pausing = np.flatnonzero(openness < 1)
        if not len(pausing):
            return vertices
        made = np.array(vertices, np.float32)
        for frame in pausing:  # one at a time: all of them may be much memory
            made[frame] -= (1 - openness[frame]) * self.weights * (vertices[frame] - self.template)
        return made
