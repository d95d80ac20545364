"""A face of three rectangles whose mouth opens in exactly the frames in which the sound clicks."""

from __future__ import annotations

import numpy as np

from facediff.animation import Animation

RATE = 25
SAMPLE_RATE = 16_000
OPEN_FRAMES = (0, 7, 16, 31, 32, 33, 50, 63, 74)
"""At both ends, on both sides of where chunks of frames meet, and one after the other."""
FRAMES = 75
OPENING = 20.0
RED, BLUE = (220, 20, 20), (20, 20, 220)


def rectangle(left: float, right: float, bottom: float, top: float, depth: float) -> np.ndarray:
    """Corners (4, 3) in mm."""
    return np.array([[left, bottom, depth], [right, bottom, depth], [right, top, depth], [left, top, depth]], float)


def clicks(*, speech: bool = True, name: str = "clicks", lower: float = 0.0) -> Animation:
    """The animation: blue throat behind red lips; in an open frame the lower lip is `OPENING` mm further down.

    The middle of the picture shows the lower lip while the mouth is closed, and the throat while it is open.
    """
    throat = rectangle(-50, 50, -50, 50, -5)
    upper_lip = rectangle(-50, 50, 5, 50, 0)
    lower_lip = rectangle(-50, 50, -50, 5, 0)
    template = np.concatenate([throat, upper_lip, lower_lip])
    vertices = np.repeat(template[None], FRAMES, axis=0)
    vertices[:, 8:, 1] -= lower
    vertices[list(OPEN_FRAMES), 8:, 1] -= OPENING
    corners = np.array([[0, 1, 2], [0, 2, 3]])
    sound = np.zeros(FRAMES * SAMPLE_RATE // RATE, np.float32)
    for frame in OPEN_FRAMES:
        start = frame * SAMPLE_RATE // RATE
        sound[start : start + 24] = 0.8 * (-1.0) ** np.arange(24)
    return Animation(
        name=name,
        vertices=vertices.astype(np.float32),
        template=template.astype(np.float32),
        frame_rate=RATE,
        faces=np.concatenate([corners, corners + 4, corners + 8]).astype(np.int32),
        unit="mm",
        speech=sound if speech else None,
        sample_rate=SAMPLE_RATE,
        colours=np.repeat(np.array([BLUE, RED, RED], np.uint8), 4, axis=0),
        inner_lip_pairs=np.array([[4, 11], [5, 10]]),  # the upper lip's lower corners over the lower lip's upper ones
        metadata={"identity": "nobody", "procedural": "all of it"},
    )
