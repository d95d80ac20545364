"""How the truth of the built-in corpus moves, next to measurements of people.

A corpus made by rules is worth as much as its motion is like people's. The measures are taken from the stored weights,
gaze and head turns of every clip, so that a change of the rules shows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.storage import RIGS_FOLDER, WEIGHTS_FOLDER
from facediff.errors import damaged
from facediff.utils.arrays import open_array
from facediff.utils.plain_files import read_rows

Array = npt.NDArray[np.float64]

AWAY = 4.0  # Degrees from the listener at which eyes look away
JUMP = 30.0  # Degrees a second that eyes reach in saccades only (Leigh and Zee, "The neurology of eye movements")
NOD = 1.0  # Degrees that the chin goes down in a nod
REMEDY = "remove the folder, and the corpus is made again"
ENOUGH = 300  # Clips, spread over all, that the measures are taken of
FINEST = 8.0  # Hz above which faces hardly move


@dataclass(frozen=True)
class TruthClip:
    """The stored truth of a clip.

    Attributes:
        weights: of the shapes by name, (T,) each.
        gaze: to the left and up in degrees, (T, 2).
        head: pitch, yaw and roll in degrees, (T, 3).
        regions: vertices in mm of the lips and of the upper face, (T, N, 3).
        gaps: largest distance of facing inner lips in mm at the middle of each p, b and m.
    """

    weights: dict[str, Array]
    gaze: Array
    head: Array
    regions: dict[str, Array]
    gaps: list[float]


def measure_truth(root: Path, names: Iterable[str], rate: float) -> list[dict[str, Any]]:
    """Rows with ``measure``, ``value``, ``people`` and ``source``; none where a corpus has no such files.

    Args:
        root: the corpus folder.
        names: its clips.
        rate: motion frames a second.
    """
    if not all((root / f"{part}_npy").is_dir() for part in ("weights", "gaze", "head")):
        return []
    with damaged(f"{root}: the stored truth", REMEDY):
        return _measures(root, sorted(names), rate)


def _measures(root: Path, names: list[str], rate: float) -> list[dict[str, Any]]:
    clips = [clip for clip in _read(root, names[:: max(1, len(names) // ENOUGH)], rate) if len(clip.gaze) > 1]
    minutes = sum(len(clip.gaze) for clip in clips) / rate / 60.0
    if not minutes:
        return []
    blinks = sum(_rises(clip.weights["eyeBlinkLeft"], 0.5, 0.3) for clip in clips)
    jumps = np.concatenate([_jumps(clip.gaze, rate) for clip in clips])
    away = np.mean(np.concatenate([np.linalg.norm(clip.gaze, axis=1) > AWAY for clip in clips]))
    nods = sum(_rises(clip.head[:, 0] - np.median(clip.head[:, 0]), NOD, 0.0) for clip in clips)
    glances = jumps[jumps > AWAY]
    size = f"{glances.mean():.1f}" if len(glances) else "none"
    gaps = [gap for clip in clips for gap in clip.gaps]
    apart = f"{np.quantile(gaps, 0.95):.2f}" if gaps else "none"
    lips, upper = ([clip.regions[name] for clip in clips] for name in ("lips", "upper_face"))
    jaw = _median_frequency([clip.weights["jawOpen"] for clip in clips], rate)
    shares = [_share_above(region, rate, FINEST) for region in (lips, upper)]
    rows = [
        ("blinks a minute", f"{blinks / minutes:.1f}", "26, 10 to 50 by person", "Bentivoglio and others 1997"),
        ("saccades above 1° a minute", f"{np.sum(jumps > 1.0) / minutes:.0f}", "", ""),
        ("glances above 4°, mean size, °", size, "14 to 16", "Lee and others 2002"),
        ("share of the time looking away", f"{away:.2f}", "0.4", "Argyle and Cook 1976"),
        ("nods above 1° a minute", f"{nods / minutes:.0f}", "", ""),
        ("head's pitch, standard deviation, °", f"{np.mean([np.std(clip.head[:, 0]) for clip in clips]):.2f}", "", ""),
        ("lips apart at p, b, m, 95th percentile, mm", apart, "0", "they touch"),
        ("jaw, median frequency of its velocity, Hz", f"{jaw:.1f}", "2 to 7", "Chandrasekaran and others 2009"),
        ("lips, difference ratio", f"{_difference_ratio(lips):.2f}", "", ""),
        ("lips, share of their power above 8 Hz", f"{shares[0]:.3f}", "", ""),
        ("upper face, difference ratio", f"{_difference_ratio(upper):.2f}", "", ""),
        ("upper face, share of its power above 8 Hz", f"{shares[1]:.3f}", "", ""),
    ]
    return [dict(zip(("measure", "value", "people", "source"), row, strict=True)) for row in rows]


def _read(root: Path, names: Iterable[str], rate: float) -> Iterator[TruthClip]:
    """The stored truth of clips with weights."""
    shapes = [row["shape"] for row in read_rows(root / "shapes.csv", remedy=REMEDY)]
    index = {name: _indices(root, file) for name, file in (("lips", "lve.txt"), ("upper_face", "fdd.txt"))}
    pairs = _indices(root, "inner_lip_pairs.txt").reshape(-1, 2)
    points = np.unique(np.concatenate([*index.values(), pairs.ravel()]))
    rigs: dict[str, Array] = {}
    for name in names:
        if not (root / WEIGHTS_FOLDER / f"{name}.npy").is_file():
            continue
        identity = name.rpartition("_")[0]
        if identity not in rigs:
            rigs[identity] = 1000.0 * np.asarray(open_array(root / RIGS_FOLDER / f"{identity}.npy")[:, points])
        rig = rigs[identity]
        weights, gaze, head = (
            np.asarray(open_array(root / f"{part}_npy" / f"{name}.npy"), np.float64)
            for part in ("weights", "gaze", "head")
        )
        vertices = rig[0] + np.einsum("tk,kvc->tvc", weights, rig[1:])
        upper, lower = (vertices[:, np.searchsorted(points, side)] for side in pairs.T)
        gap = np.linalg.norm(upper - lower, axis=-1).max(axis=1)
        phonemes = read_rows(root / "phonemes" / f"{name}.csv", remedy=REMEDY)
        closures = [row for row in phonemes if row["ipa"][:1] in ("p", "b", "m")]
        middles = [int(0.5 * (float(row["start"]) + float(row["end"])) * rate) for row in closures]
        regions = {part: vertices[:, np.searchsorted(points, at)] for part, at in index.items()}
        gaps = [float(gap[min(middle, len(gap) - 1)]) for middle in middles]
        yield TruthClip(dict(zip(shapes, weights.T, strict=True)), gaze, head, regions, gaps)


def _indices(root: Path, file: str) -> npt.NDArray[np.int64]:
    text = (root / "regions" / file).read_text(encoding="ascii").replace("\n", ",")
    return np.array([int(number) for number in text.split(",") if number.strip()])


def _rises(track: Array, high: float, low: float) -> int:
    """How often a track rises above one limit for the first time since it was below the other."""
    marks = np.where(track > high, 1, np.where(track < low, -1, 0))
    marks = marks[marks != 0]
    return int(np.sum((marks[1:] > 0) & (marks[:-1] < 0)))


def _jumps(gaze: Array, rate: float) -> Array:
    """Sizes in degrees of the saccades of a clip."""
    steps = np.diff(gaze, axis=0)
    fast = np.concatenate([[False], np.linalg.norm(steps, axis=1) * rate > JUMP, [False]])
    firsts, lasts = (np.flatnonzero(np.diff(fast.astype(int)) == sign) for sign in (1, -1))
    sizes = [np.linalg.norm(steps[a:b].sum(axis=0)) for a, b in zip(firsts, lasts, strict=True)]
    return np.asarray(sizes, np.float64)


def _difference_ratio(regions: Iterable[Array]) -> float:
    """Size of second over first differences in time, as the metric ``difference_ratio`` has it."""
    sums = np.sum([[np.square(np.diff(region, n, axis=0)).sum() for n in (1, 2)] for region in regions], axis=0)
    return float(np.sqrt(sums[1] / max(sums[0], 1e-30)))


def _spectrum(track: Array, rate: float) -> tuple[Array, Array]:
    """Power of a track (T, …) by frequency, summed over all but time, its mean left out; and the frequencies in Hz."""
    moving = track.reshape(len(track), -1)
    moving = (moving - moving.mean(axis=0)) * np.hanning(len(track))[:, None]
    power: Array = np.square(np.abs(np.fft.rfft(moving, axis=0))).sum(axis=1)
    return power, np.asarray(np.fft.rfftfreq(len(track), 1.0 / rate), np.float64)


def _share_above(tracks: Iterable[Array], rate: float, limit: float) -> float:
    """Share of the power that lies above a frequency."""
    spectra = [_spectrum(track, rate) for track in tracks]
    above = sum(float(power[frequencies > limit].sum()) for power, frequencies in spectra)
    return above / max(sum(float(power.sum()) for power, _ in spectra), 1e-30)


def _median_frequency(tracks: Iterable[Array], rate: float) -> float:
    """The frequency in Hz below which half of the power of the tracks' velocity lies."""
    spectra = [_spectrum(np.diff(track) * rate, rate) for track in tracks]
    power, frequencies = (np.concatenate(part) for part in zip(*spectra, strict=True))
    order = np.argsort(frequencies)
    shares = np.cumsum(power[order])
    return float(frequencies[order][np.searchsorted(shares, 0.5 * shares[-1])])
