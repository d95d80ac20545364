"""A mouth that comes to rest where nobody speaks: the openness of each frame, applied to the model's motion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facediff.speech.voice_activity import Openness, VoiceGate, toward_rest


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
        self.gate, self.frame_rate = gate, frame_rate
        self.template = np.asarray(template, np.float32)
        self.weights = rest_weights(self.template, regions)

    def openness(self) -> Openness:
        """The openness of a recording that has not begun yet."""
        return Openness(self.gate, self.frame_rate)

    def apply(self, vertices: npt.NDArray[np.float32], openness: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Vertices (T, V, 3) with the mouth as far at rest as the openness (T,) says."""
        return toward_rest(vertices, openness, self.template, self.weights)


def rest_weights(
    template: npt.NDArray[np.floating], regions: Mapping[str, npt.NDArray[np.integer]]
) -> npt.NDArray[np.float32]:
    """How far each vertex (V,) of a neutral face (V, 3) goes to rest in pauses: all that speech moves."""
    from facediff.editing.expressiveness import ALL, region_factors

    # Fading into the upper face as regions fade elsewhere.
    return region_factors(np.asarray(template, np.float32), regions, {"upper_face": 0.0, ALL: 1.0}).astype(np.float32)
