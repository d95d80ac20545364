"""BEAT's facial motion (.json), and the like that LAM exports."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError, damaged
from facediff.spaces.arkit import ARKIT
from facediff.spaces.files.clips import ParameterClip, checked, rate_of
from facediff.spaces.layouts import LAYOUTS, layout
from facediff.spaces.space import Space
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES, quoted
from facediff.utils.plain_files import load_json, write_json

REMEDY = "expected names and frames with weights, as BEAT and LAM write them"


def read_beat(path: Path) -> ParameterClip:
    """Read BEAT's json: ``names``, and ``frames`` with ``weights`` and ``time``; LAM adds ``metadata``.

    BEAT's first frame has the time 1/60, which is kept as the clip's start. Without times, the metadata states the
    rate.
    """
    content = load_json(path, remedy=REMEDY)
    with damaged(path, REMEDY):
        names, frames = content["names"], content["frames"]
        values = np.array([frame["weights"] for frame in frames], np.float64).reshape(len(frames), len(names))
    space = _space(path, list(map(str, names)))
    metadata = content.get("metadata")
    stated = metadata.get("fps") if isinstance(metadata, dict) else None
    seconds = [frame.get("time") for frame in frames]
    timed = len(seconds) > 0 and None not in seconds
    start, after = 0.0, None
    if stated is not None or not timed:
        stated = rate = check_number(path, "metadata.fps", stated, *FRAME_RATES, remedy=REMEDY)
    if timed:
        times = np.array([check_number(path, "time", time, 0, remedy=REMEDY) for time in seconds])
        rate = rate_of(path, times, [f"frame {number}" for number in range(len(times))], stated)
        start, after = float(times[0]), times - times[0]
        if np.abs(after - np.arange(len(after)) / rate).max() < 0.25 / rate:
            after = None  # evenly spaced: nothing was dropped
    order = next((name for name, entry in LAYOUTS.items() if entry.space.channels == space.channels), "")
    return ParameterClip(path.stem, checked(path, values, rate), space, rate, after, start, layout=order)


def _space(path: Path, names: list[str]) -> Space:
    """ARKit's space with the file's own names in its own order."""
    orders = [entry.space for entry in LAYOUTS.values() if entry.space.channels == tuple(names)]
    if orders:
        return orders[0]
    folded = [name.casefold() for name in names]
    beyond = [name for name in names if name.casefold() not in {arkit.casefold() for arkit in ARKIT}]
    if beyond or len(set(folded)) < len(folded) or not names:
        raise FaceDiffError(f"{path}: has the names {quoted(beyond or names)}; expected ARKit's, each once")
    lacking = tuple(name for name in ARKIT if name.casefold() not in folded)
    return replace(layout("arkit"), channels=tuple(names), absent=lacking)


def write_beat(path: Path, clip: ParameterClip) -> None:
    """Write a clip in a space of ARKit's as BEAT does, in the clip's order."""
    turning = {*clip.space.head, *clip.space.eyes}
    shapes = [
        index
        for index, name in enumerate(clip.space.channels)
        if index not in turning and name not in clip.space.absent
    ]
    times = np.arange(len(clip.values)) / clip.frame_rate if clip.times is None else clip.times
    start = 0.0 if clip.layout == "live_link" else clip.start  # a take's is the time of day
    frames = [
        # Text and back keeps the shortest decimal of each float32 instead of the digits of its float64.
        {"weights": [float(str(weight)) for weight in row[shapes]], "time": start + float(time), "rotation": []}
        for row, time in zip(clip.values, times, strict=True)
    ]
    content: dict[str, Any] = {"names": [clip.space.channels[index] for index in shapes], "frames": frames}
    if len(frames) < 2:  # of one frame, times do not say the rate
        content = {"metadata": {"fps": clip.frame_rate, "frame_count": len(frames)}, **content}
    write_json(path, content)
