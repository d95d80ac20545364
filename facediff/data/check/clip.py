"""Checking one clip: its motion, its speech, and whether they belong together.

Worker processes import this, so it imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.check.findings import Findings, relative
from facediff.data.storage import open_motion, rig_path
from facediff.errors import FaceDiffError
from facediff.speech.audio import CUT, SAMPLE_RATE, cut_short, open_sound, read_speech
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.checksums import sha256

CHUNK = 16  # frames that are read at a time
SAMPLED = 16  # frames, evenly spread, whose distance from the template is measured
STILL = 1e-6
"""A clip moves if some coordinate changes by more than this share of the face's size."""
FAR = 0.1
"""Mean distance of the vertices from the template, as a share of the face's size, that no speech causes."""
NEAR = 0.005
"""Below this share a frame is so near to its own template that the other templates are not compared."""
NEARER = 0.5
"""Motion belongs to another subject if that subject's template is nearer than this share of the own distance."""

SLIGHT = 0.1  # seconds by which the lengths of speech and motion may differ without a finding
MUCH = (0.5, 0.1)
"""Speech and motion that differ by more than so many seconds and by more than this share do not belong together."""
LENGTHS = ("length", "speech_shorter", "speech_longer")
"""Kinds of findings about motion and speech of different length."""

Array = npt.NDArray[np.floating]


@dataclass(frozen=True)
class ClipFiles:
    """The files of one clip; None for one that is not there."""

    name: str
    subject: str
    motion: Path | None
    sound: Path | None


@dataclass(frozen=True)
class Rules:
    """The expected properties of every clip, and whether headers only are read (``quick``)."""

    root: Path
    n_vertices: int
    stored_frame_rate: float
    templates: Mapping[str, Array]
    quick: bool


@dataclass
class ClipInfo:
    """The properties of one clip; None for those that cannot be read."""

    name: str
    frames: int | None = None  # on disk
    n_vertices: int | None = None
    seconds: float | None = None  # of speech
    sample_rate: int | None = None
    channels: int | None = None
    hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 by file; empty where headers only are read
    findings: Findings = field(default_factory=Findings)


def examine(rules: Rules, clip: ClipFiles) -> ClipInfo:
    """Check one clip; every exception becomes a finding."""
    info = ClipInfo(clip.name)
    try:
        if clip.motion is not None:
            _check_motion(info, rules, clip.motion, clip.subject)
        if clip.sound is not None:
            _check_sound(info, rules, clip.sound)
        if info.frames is not None and info.seconds is not None:
            compare_lengths(info, rules.stored_frame_rate, info.frames, info.seconds)
        for path in (clip.motion, clip.sound):
            if path is not None and not rules.quick and path.is_file() and path.stat().st_size:
                info.hashes[relative(path, rules.root)] = sha256(path)
    except Exception as error:  # one strange clip must not end the check of all others
        message = f"could not be checked ({type(error).__name__}: {error}); get its files again"
        info.findings.error("clip_unreadable", clip.name, message)
    return info


# Motion.


def _check_motion(info: ClipInfo, rules: Rules, path: Path, subject: str) -> None:
    findings, where, expected = info.findings, relative(path, rules.root), rules.n_vertices
    if not path.is_file():  # a pipe would be waited for
        findings.error("motion_unreadable", where, "is no regular file; put the motion there")
        return
    try:
        rig = rig_path(path)
        array: npt.NDArray[Any] = open_array(path)
        if rig is not None:
            motion = open_motion(path, expected)
            array = motion.read(range(1 if rules.quick else motion.frames))
    except FaceDiffError as error:
        findings.error("motion_unreadable", where, str(error).removeprefix(f"{path}: "))
        return
    info.n_vertices = vertices_of(array.shape)
    if not np.issubdtype(array.dtype, np.floating):
        message = f"holds {array.dtype}, expected floating-point vertices; write it again"
        findings.error("motion_dtype", where, message)
        return
    if info.n_vertices != expected:
        topology = "which is no number of vertices" if info.n_vertices is None else f"{info.n_vertices} vertices"
        message = (
            f"has shape {array.shape}, {topology}; expected (frames, {3 * expected}), {expected} vertices: it has "
            f"another topology or is no motion"
        )
        findings.error("motion_shape", where, message)
        return
    if not len(array):
        findings.error("motion_empty", where, "has no frame; get it again or remove the clip")
        return
    if array.dtype == np.float16:
        findings.warning("motion_dtype", where, "is in half precision, some three digits; get it in float32")
    info.frames = len(array) if rig is None else motion.frames
    if not rules.quick:
        check_vertices(findings, array.reshape(len(array), expected, 3), where, subject, rules.templates)


def check_vertices(findings: Findings, motion: Array, where: str, subject: str, templates: Mapping[str, Array]) -> None:
    """Look at all frames (T, V, 3) of a clip, and compare them with the speakers' templates."""
    if _check_frames(findings, motion, where) and subject in templates:
        _compare_with_templates(findings, motion, where, subject, templates)


def _check_frames(findings: Findings, motion: Array, where: str) -> bool:
    """Read all frames (T, V, 3); returns whether any is finite."""
    damaged, first_damaged, largest = 0, 0, 0.0
    start: npt.NDArray[np.float32] | None = None
    for first in range(0, len(motion), CHUNK):
        with np.errstate(all="ignore"):  # what float32 cannot hold is infinite for the models too
            chunk = np.asarray(motion[first : first + CHUNK], np.float32)
        finite = np.isfinite(chunk).all((1, 2))
        if not finite.all():
            first_damaged = first_damaged if damaged else first + int(np.argmin(finite))
            damaged += int((~finite).sum())
            chunk = chunk[finite]
        if len(chunk):
            start = chunk[0].copy() if start is None else start
            largest = max(largest, float(np.abs(chunk - start).max()))
    if damaged:
        message = (
            f"{damaged} of {len(motion)} frames hold NaN or infinity, the first is frame {first_damaged} (counted from "
            f"0); get the clip again or remove it"
        )
        findings.error("motion_not_finite", where, message)
    if start is not None and len(motion) > 1 and largest <= STILL * _size(start):
        findings.error("motion_still", where, "never moves: all frames are equal; get the clip again or remove it")
    return start is not None


def _compare_with_templates(
    findings: Findings, motion: Array, where: str, subject: str, templates: Mapping[str, Array]
) -> None:
    picks = np.unique(np.linspace(0, len(motion) - 1, SAMPLED).astype(int))
    frames = np.array(motion[picks], np.float64)
    frames = frames[np.isfinite(frames).all((1, 2))]
    template = np.asarray(templates[subject], np.float64)
    size = _size(template)
    if not len(frames) or not size:
        return
    share = float(np.median([_distance(frame, template) for frame in frames])) / size
    mean = frames.mean(axis=0)
    distances = {name: _distance(mean, np.asarray(face, np.float64)) for name, face in templates.items()}
    nearest = min(distances, key=lambda name: distances[name])
    if share > NEAR and distances[nearest] < NEARER * distances[subject]:
        message = (
            f"is nearer to the template of {nearest} than to that of {subject}: one of the two files has the wrong "
            f"name, or two templates are swapped in templates.pkl"
        )
        findings.error("motion_of_another", where, message)
    elif share > FAR:
        scale = _size(mean) / size
        scaled = "" if 0.8 < scale < 1.25 else f" and are {scale:.3g} times as large"
        message = (
            f"its frames lie {share:.0%} of the face's size away from {subject}'s template{scaled}, where speech moves "
            f"a face by a few percent: another unit, another normalisation, head motion left in, or the template of "
            f"another speaker; prepare motion and templates.pkl together"
        )
        findings.error("motion_far_from_template", where, message)


def _size(vertices: Array) -> float:
    """Diagonal of the bounding box of vertices (V, 3)."""
    return float(np.linalg.norm(np.ptp(np.asarray(vertices, np.float64), axis=0)))


def _distance(frame: npt.NDArray[np.float64], template: npt.NDArray[np.float64]) -> float:
    """Mean distance between corresponding vertices of two faces (V, 3)."""
    return float(np.linalg.norm(frame - template, axis=1).mean())


# Speech.


def _check_sound(info: ClipInfo, rules: Rules, path: Path) -> None:
    findings, where = info.findings, relative(path, rules.root)
    with findings.guard("sound_unreadable", path, rules.root):
        if (fault := cut_short(path)) is not None:
            findings.error("sound_truncated", where, f"{CUT}: {fault}; copy it again")
            return
        seconds = 0.0
        with suppress(FaceDiffError), open_sound(path) as file:  # of other containers than libsndfile's all is read
            info.sample_rate, info.channels = int(file.samplerate), int(file.channels)
            seconds = file.frames / file.samplerate
        if not rules.quick or not seconds:
            speech = read_speech(path)
            seconds = len(speech) / SAMPLE_RATE
            if not speech.any():
                findings.error(
                    "sound_silent", where, "is silent throughout; get the recording again or remove the clip"
                )
        info.seconds = seconds


# Both together.


def compare_lengths(info: ClipInfo, frame_rate: float, frames: int, seconds: float) -> None:
    """Report motion and speech of different length."""
    motion = frames / frame_rate
    difference = abs(motion - seconds)
    if difference <= SLIGHT:
        return
    lengths = (
        f"the motion lasts {motion:.2f} s ({frames} frames at {frame_rate:g} a second), the speech {seconds:.2f} s"
    )
    if difference > MUCH[0] and difference > MUCH[1] * max(motion, seconds):
        factor = next((factor for factor in (2.0, 0.5) if is_about(frames / seconds, factor * frame_rate)), None)
        hint = f", as if there were {factor * frame_rate:g} frames a second" if factor else ""
        message = (
            f"{lengths}{hint}: they do not belong together, or one of them is cut; get the clip again or remove it"
        )
        info.findings.error("length", info.name, message)
    elif seconds < motion:
        message = f"{lengths}: the speech is filled up with silence at its end"
        info.findings.warning("speech_shorter", info.name, message)
    else:
        info.findings.warning("speech_longer", info.name, f"{lengths}: the end of the speech is left out")


def is_about(value: float, rate: float) -> bool:
    """Whether two rates are equal but for the few frames by which clips differ."""
    return abs(value / rate - 1) < 0.1
