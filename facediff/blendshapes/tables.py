"""Weights as CSV."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from facediff.blendshapes.arkit import ARKIT, ROTATIONS, live_link_name
from facediff.blendshapes.weights import Weights
from facediff.errors import FaceDiffError
from facediff.files import atomic, check_writable

FORMAT = "facediff blendshape weights 1"
DAY = 24 * 3600


def write_live_link(path: Path, weights: Weights) -> None:
    """Write a table as Epic's app Live Link Face records it, and what it cannot say beside it.

    A row for each frame: timecode, number of values (61), ARKit's 52 names in order, turns of head and eyes. Names
    without a shape and all turns are 0; ``<name>.json`` declares them, and holds the frame rate and each frame's
    residual. Both files appear whole or not at all.

    Raises:
        FaceDiffError: if a file cannot be written.
    """
    column = {name: index for index, name in enumerate(weights.names)}
    header = ["Timecode", "BlendShapeCount", *map(live_link_name, ARKIT), *ROTATIONS]
    rows = (
        [
            timecode(frame, weights.frame_rate),
            str(len(ARKIT) + len(ROTATIONS)),
            *(f"{values[column[name]]:.8f}" if name in column else "0.00000000" for name in ARKIT),
            *("0.00000000" for _ in ROTATIONS),
        ]
        for frame, values in enumerate(weights.values)
    )
    _write_both(path, header, rows, _about(weights, in_table=ARKIT, rotations=True))


def write_weights(path: Path, weights: Weights) -> None:
    """Write a plain table, and ``<name>.json`` beside it: time in seconds, every weight, residuals in millimetres.

    Raises:
        FaceDiffError: if a file cannot be written.
    """
    header = ["time", *weights.names, "residual_rms_mm", "residual_max_mm"]
    rows = (
        [
            f"{frame / weights.frame_rate:.6f}",
            *(f"{value:.8f}" for value in values),
            f"{weights.residual_rms_mm[frame]:.6f}",
            f"{weights.residual_max_mm[frame]:.6f}",
        ]
        for frame, values in enumerate(weights.values)
    )
    _write_both(path, header, rows, _about(weights, in_table=weights.names, rotations=False))


def timecode(frame: int, frame_rate: float) -> str:
    """HH:MM:SS:FF.mmm of a frame, from midnight on; a broken frame rate counts as the next whole one (no frame drops).

    Frames are counted within the second, and the digits after the point are thousandths of a frame, always 0 here.
    """
    whole = max(1, round(frame_rate))
    seconds = frame // whole % DAY
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}:{frame % whole:02d}.000"


def _about(weights: Weights, in_table: Sequence[str], *, rotations: bool) -> dict[str, object]:
    """What a table does not say."""
    return {
        "format": FORMAT,
        "frame_rate": weights.frame_rate,
        "frames": len(weights.values),
        "absent": list(weights.absent),
        "absent_means": "no shape was given under these names: their weights are 0 and say nothing",
        "still": list(weights.still),
        "not_in_table": [name for name in weights.names if name not in in_table],
        **(
            {"rotations": "head and eyes were not solved for: their columns are 0 and say nothing"} if rotations else {}
        ),
        "amplitude_mm": round(weights.amplitude_mm, 6),
        "residual_rms_mm": [round(float(value), 6) for value in weights.residual_rms_mm],
        "residual_max_mm": [round(float(value), 6) for value in weights.residual_max_mm],
        "metadata": dict(weights.metadata),
    }


def _write_both(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]], about: dict[str, object]) -> None:
    if path.suffix.lower() != ".csv":
        raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected a table .csv')
    # Both, before one is there.
    for file in (path, path.with_suffix(".json")):
        check_writable(file)
    with atomic(path.with_suffix(".json")) as beside, atomic(path) as temporary:
        with temporary.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)
        beside.write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
