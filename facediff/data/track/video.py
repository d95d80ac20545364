"""Pictures of a video with the times at which they are shown."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, needs_extra
from facediff.speech.audio import DEMUXERS
from facediff.utils.limits import brief

Picture = npt.NDArray[np.uint8]

MOST_PICTURES = 120.0
"""Pictures a second that are looked at; of faster videos every second, third … one."""


def read_pictures(path: Path) -> Iterator[tuple[float, Picture]]:
    """Time in seconds and picture (H, W, 3), upright, of each frame; the first of them is at its own time.

    Times are those at which players show the frames: they need not be evenly spaced, and the sound may begin at
    another one.
    """
    with needs_extra("av", "prepare", "reading videos"):
        import av
    try:
        with path.open("rb") as stream, av.open(stream, options={"format_whitelist": DEMUXERS}) as container:
            if not container.streams.video:
                raise FaceDiffError(f"{path}: has no pictures; expected a video of a person")
            track = container.streams.video[0]
            rate = float(track.average_rate or 25)
            step, last = math.ceil(rate / MOST_PICTURES), -math.inf
            for number, frame in enumerate(container.decode(track)):
                time = number / rate if frame.time is None else float(frame.time)
                if number % step or time <= last:
                    continue
                last = time
                picture = frame.to_ndarray(format="rgb24")
                # FFmpeg counts counterclockwise, as NumPy does.
                turned = np.rot90(picture, round(frame.rotation / 90)) if frame.rotation else picture
                yield time, np.ascontiguousarray(turned)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise FaceDiffError(f"{path}: is not a video that can be read ({brief(error)}); convert it to .mp4") from error
