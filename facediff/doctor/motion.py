"""Looking at one file of motion."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.doctor.findings import Finding, Severity

CHUNK = 16
"""Frames that are read at a time."""
SAMPLED = 16
"""Frames, evenly spread, whose distance from the template is measured."""
STILL = 1e-6
"""A clip moves if some coordinate changes by more than this share of the face's size."""
FAR = 0.1
"""Mean distance of the vertices from the template, as a share of the face's size, that no speech causes."""
NEAR = 0.005
"""Below this share a frame is so near to its own template that nobody else's is looked at."""
NEARER = 0.5
"""Whoever's template is nearer than this share of the distance from one's own is the owner of the motion."""

Array = npt.NDArray[np.floating]


@dataclass
class MotionFacts:
    """What a file of motion holds.

    Attributes:
        frames: frames on disk; None if the file cannot be used.
        n_vertices: vertices of each frame; None if the file says nothing sensible.
        findings: what is wrong with it.
    """

    frames: int | None = None
    n_vertices: int | None = None
    findings: list[Finding] = field(default_factory=list)

    def add(self, severity: Severity, kind: str, where: str, message: str) -> None:
        """Note a finding."""
        self.findings.append(Finding(severity, kind, where, message))


def look_at_motion(
    path: Path, where: str, n_vertices: int, subject: str, templates: Mapping[str, Array], *, quick: bool
) -> MotionFacts:
    """Check one file.

    Args:
        path: the file.
        where: what it is called in findings.
        n_vertices: vertices that the corpus has.
        subject: whose motion it should be.
        templates: neutral faces (V, 3) by subject.
        quick: read the header only.
    """
    facts = MotionFacts()
    try:
        array = open_array(path)
    except Exception as error:  # NumPy's header parser raises all sorts of things on damaged files
        facts.add("error", "motion_unreadable", where, unreadable(path, error))
        return facts
    facts.n_vertices = vertices_of(array)
    if not np.issubdtype(array.dtype, np.floating):
        facts.add(
            "error", "motion_dtype", where, f"holds {array.dtype}, expected floating-point vertices; write it anew"
        )
        return facts
    if facts.n_vertices != n_vertices:
        found = "which is no number of vertices" if facts.n_vertices is None else f"{facts.n_vertices} vertices"
        facts.add(
            "error",
            "motion_shape",
            where,
            f"has shape {array.shape}, {found}; expected (frames, {3 * n_vertices}), {n_vertices} vertices: it belongs "
            f"to another topology or is no motion",
        )
        return facts
    if not len(array):
        facts.add("error", "motion_empty", where, "has no frame; get it anew or remove the clip")
        return facts
    if array.dtype == np.float16:
        facts.add("warning", "motion_dtype", where, "is in half precision, some three digits; get it in float32")
    facts.frames = len(array)
    if not quick:
        _look_inside(facts, array.reshape(len(array), n_vertices, 3), where, subject, templates)
    return facts


def open_array(path: Path) -> npt.NDArray[Any]:
    """A ``.npy`` file, memory-mapped.

    Raises:
        ValueError: if it is something else; NumPy raises further kinds of errors on damaged files.
    """
    if not path.is_file():
        raise ValueError("it is no regular file")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's advice on headers by Python 2
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(array, np.ndarray):
        array.close()
        raise ValueError("it is an archive")
    return array


def unreadable(path: Path, error: Exception) -> str:
    """The sentence for a file that NumPy cannot open."""
    if "mmap length" in str(error):
        return f"is cut short: its {path.stat().st_size} bytes are fewer than its header says; copy it anew"
    return f"not a readable NumPy array ({error}); expected .npy with (frames, 3 x vertices) floats, copy it anew"


def vertices_of(array: npt.NDArray[Any]) -> int | None:
    """Vertices of the frames of (T, 3V) or (T, V, 3); None for any other shape."""
    if array.ndim == 3 and array.shape[2] == 3:
        return int(array.shape[1]) or None
    if array.ndim == 2 and array.shape[1] and array.shape[1] % 3 == 0:
        return int(array.shape[1]) // 3
    return None


def _look_inside(facts: MotionFacts, array: Array, where: str, subject: str, templates: Mapping[str, Array]) -> None:
    bad, first_bad, moved = 0, 0, 0.0
    start: npt.NDArray[np.float32] | None = None
    for first in range(0, len(array), CHUNK):
        with np.errstate(all="ignore"):  # what float32 cannot hold is infinite for the models too
            chunk = np.asarray(array[first : first + CHUNK], np.float32)
        finite = np.isfinite(chunk).all((1, 2))
        if not finite.all():
            first_bad = first_bad if bad else first + int(np.argmin(finite))
            bad += int((~finite).sum())
            chunk = chunk[finite]
        if len(chunk):
            start = chunk[0].copy() if start is None else start
            moved = max(moved, float(np.abs(chunk - start).max()))
    if bad:
        facts.add(
            "error",
            "motion_not_finite",
            where,
            f"{bad} of {len(array)} frames hold NaN or infinity, the first is frame {first_bad} (counted from 0); get "
            f"the clip anew or remove it",
        )
    if start is None:
        return
    if len(array) > 1 and moved <= STILL * size_of(start):
        facts.add("error", "motion_still", where, "never moves: all frames are equal; get the clip anew or remove it")
    if subject in templates:
        _compare_with_templates(facts, array, where, subject, templates)


def _compare_with_templates(
    facts: MotionFacts, array: Array, where: str, subject: str, templates: Mapping[str, Array]
) -> None:
    picks = np.unique(np.linspace(0, len(array) - 1, SAMPLED).astype(int))
    frames = np.array(array[picks], np.float64)
    frames = frames[np.isfinite(frames).all((1, 2))]
    template = np.asarray(templates[subject], np.float64)
    size = size_of(template)
    if not len(frames) or not size:
        return
    share = float(np.median([distance(frame, template) for frame in frames])) / size
    mean = frames.mean(axis=0)
    distances = {name: distance(mean, np.asarray(other, np.float64)) for name, other in templates.items()}
    nearest = min(distances, key=lambda name: distances[name])
    if share > NEAR and distances[nearest] < NEARER * distances[subject]:
        facts.add(
            "error",
            "motion_of_another",
            where,
            f"lies nearer to the template of {nearest} than to that of {subject}: one of the two files bears the wrong "
            f"name, or two templates are swapped in templates.pkl",
        )
    elif share > FAR:
        scale = size_of(mean) / size
        scaled = "" if 0.8 < scale < 1.25 else f" and are {scale:.3g} times as large"
        facts.add(
            "error",
            "motion_far_from_template",
            where,
            f"its frames lie {share:.0%} of the face's size away from {subject}'s template{scaled}, where speech moves "
            f"a face by a few percent: another unit, another normalisation, head motion left in, or the template of "
            f"somebody else; prepare motion and templates.pkl together",
        )


def size_of(vertices: npt.NDArray[np.floating]) -> float:
    """Diagonal of the bounding box of vertices (V, 3)."""
    return float(np.linalg.norm(np.ptp(np.asarray(vertices, np.float64), axis=0)))


def distance(frame: npt.NDArray[np.float64], template: npt.NDArray[np.float64]) -> float:
    """Mean distance between corresponding vertices of two faces (V, 3)."""
    return float(np.linalg.norm(frame - template, axis=1).mean())
