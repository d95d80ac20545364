"""Checking one clip: its motion, its speech, and whether they belong together.

Worker processes import this, so it imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.data.check.findings import Findings, relative
from facediff.data.storage import ClipFolder, ClipMotion
from facediff.errors import FaceDiffError
from facediff.speech.audio import SAMPLE_RATE, open_sound, read_speech, refuse_cut_short
from facediff.utils.checksums import sha256

if TYPE_CHECKING:
    from facediff.data.packed.reader import PackedCorpus

BLOCK = 64  # frames that are read at a time
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
class Rules:
    """Where clips lie, the expected properties of every clip, and whether headers only are read (``quick``)."""

    root: Path
    storage: ClipFolder | PackedCorpus
    n_vertices: int
    stored_frame_rate: float
    templates: Mapping[str, Array]
    quick: bool


@dataclass
class ClipInfo:
    """The properties of one clip; None for those that cannot be read."""

    name: str
    frames: int | None = None  # on disk
    seconds: float | None = None  # of speech
    hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 by file; empty where headers only are read
    findings: Findings = field(default_factory=Findings)


def examine(rules: Rules, clip: tuple[str, str]) -> ClipInfo:
    """Read a clip (name, subject) as training does; every exception becomes a finding."""
    name, subject = clip
    info, storage = ClipInfo(name), rules.storage
    motion_path, sound_path = rules.root / f"vertices_npy/{name}.npy", rules.root / f"wav/{name}.wav"
    if isinstance(storage, ClipFolder):
        motion_path, sound_path = storage.path_of(name), storage.sound_path(name)
    hashed = isinstance(storage, ClipFolder) and not rules.quick
    with info.findings.guard("motion_unreadable", motion_path, rules.root):
        motion = storage.open(name)
        if not rules.quick:
            _check_motion(info.findings, rules, motion, relative(motion_path, rules.root), subject)
        info.frames = motion.frames
        if hashed:
            info.hashes[relative(motion_path, rules.root)] = sha256(motion_path)
    with info.findings.guard("sound_unreadable", sound_path, rules.root):
        info.seconds = _seconds_in_header(rules, name, sound_path) if rules.quick else None
        if not info.seconds:
            speech = read_speech(sound_path) if isinstance(storage, ClipFolder) else storage.whole_speech(name)
            info.seconds = len(speech) / SAMPLE_RATE
            if not speech.any():
                message = "is silent throughout; get the recording again or remove the clip"
                info.findings.error("sound_silent", relative(sound_path, rules.root), message)
        if hashed:
            info.hashes[relative(sound_path, rules.root)] = sha256(sound_path)
    if info.frames is not None and info.seconds is not None:
        compare_lengths(info, rules.stored_frame_rate, info.frames, info.seconds)
    return info


def _seconds_in_header(rules: Rules, name: str, path: Path) -> float | None:
    if not isinstance(rules.storage, ClipFolder):
        sound = rules.storage.record.clips[name].sound
        return sound.samples / sound.rate
    refuse_cut_short(path)
    with suppress(FaceDiffError), open_sound(path) as file:
        return float(file.frames / file.samplerate)
    return None  # of other containers than libsndfile's all is read


def _check_motion(findings: Findings, rules: Rules, motion: ClipMotion, where: str, subject: str) -> None:
    """Read all frames of a clip, and compare them with the speakers' templates."""
    if getattr(motion, "dtype", None) == np.float16:
        findings.warning("motion_dtype", where, "is in half precision, some three digits; get it in float32")
    template = np.asarray(rules.templates.get(subject, np.zeros((rules.n_vertices, 3))), np.float32)
    start = motion.offsets(range(1), template)[0]
    largest = 0.0
    for first in range(0, motion.frames, BLOCK):
        block = motion.offsets(range(first, min(first + BLOCK, motion.frames)), template)
        largest = max(largest, float(np.abs(block - start).max()))
    if motion.frames > 1 and largest <= STILL * _size(template + start):
        findings.error("motion_still", where, "never moves: all frames are equal; get the clip again or remove it")
    size = _size(template)
    if not size:
        return
    picks = np.unique(np.linspace(0, motion.frames - 1, SAMPLED).astype(int)).tolist()
    offsets = motion.offsets(picks, template).astype(np.float64)
    share = float(np.median(_distances(offsets))) / size
    mean = template + offsets.mean(axis=0)
    distances = {name: float(_distances(mean - face)) for name, face in rules.templates.items()}
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


def _distances(offsets: Array) -> Any:  # noqa: ANN401 - a number, or one for each frame
    """Mean length of offsets (…, V, 3)."""
    return np.linalg.norm(offsets, axis=-1).mean(axis=-1)


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
