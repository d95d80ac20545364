"""Looking at one clip: its motion, its speech, and whether they go together.

Worker processes import this, so it imports nothing heavy.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.check.findings import Finding, Severity, relative
from facediff.errors import FaceDiffError
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.files import sha256

# Looking at one file of motion.

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
    except FaceDiffError as error:
        facts.add("error", "motion_unreadable", where, str(error).removeprefix(f"{path}: "))
        return facts
    facts.n_vertices = vertices_of(array.shape)
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


# Looking at one file of speech.

BLOCK = 1 << 16
"""Samples of all channels together that are decoded at a time."""
OPEN_END = 0xFFFF0000
"""Programs that write to a pipe put a size like this into the header, for they do not know it yet."""


@dataclass
class SoundFacts:
    """What a file of speech holds.

    Attributes:
        seconds: its length; None if the file cannot be used.
        sample_rate: samples a second.
        channels: 1 for mono.
        findings: what is wrong with it.
    """

    seconds: float | None = None
    sample_rate: int | None = None
    channels: int | None = None
    findings: list[Finding] = field(default_factory=list)


def look_at_sound(path: Path, where: str, *, quick: bool) -> SoundFacts:
    """Check one file.

    Args:
        path: the file.
        where: what it is called in findings.
        quick: read the header only.
    """
    facts = SoundFacts()

    def error(kind: str, message: str) -> SoundFacts:
        facts.findings.append(Finding("error", kind, where, message))
        return facts

    if not path.is_file():
        return error("sound_unreadable", "is no regular file; put the recording there")
    try:
        if not path.stat().st_size:
            return error("sound_empty", "the file is empty; get the recording anew")
        import soundfile

        with soundfile.SoundFile(path) as file:
            frames, rate, channels = file.frames, file.samplerate, file.channels
            short = shortfall(path)
            if short is not None:
                return error("sound_truncated", f"is cut short: {short} bytes are missing at its end; copy it anew")
            if not frames or not rate:
                return error("sound_empty", "holds no samples; get the recording anew")
            if not quick:
                _listen(facts, file, where, frames)
    except Exception as problem:  # the decoder raises its own and others on damaged files
        return error(
            "sound_unreadable", f"not a readable sound file ({problem}); expected a .wav recording, copy it anew"
        )
    facts.sample_rate, facts.channels = int(rate), int(channels)
    if not any(finding.severity == "error" for finding in facts.findings):
        facts.seconds = frames / rate
    return facts


def _listen(facts: SoundFacts, file: object, where: str, frames: int) -> None:
    """Decode the whole file."""
    heard, finite, loudest = 0, True, 0.0
    for block in file.blocks(max(1, BLOCK // file.channels), dtype="float32", always_2d=True):  # type: ignore[attr-defined]
        heard += len(block)
        finite = finite and bool(np.isfinite(block).all())
        loudest = max(loudest, float(np.abs(block).max(initial=0.0)))
    if heard < frames:
        message = f"only {heard} of {frames} samples can be decoded: it is cut short or damaged; copy it anew"
        facts.findings.append(Finding("error", "sound_truncated", where, message))
    elif not finite:
        message = "holds samples that are not finite numbers; convert it anew"
        facts.findings.append(Finding("error", "sound_not_finite", where, message))
    elif loudest == 0:
        message = "is silent from end to end; get the recording anew or remove the clip"
        facts.findings.append(Finding("error", "sound_silent", where, message))


def shortfall(path: Path) -> int | None:
    """Bytes by which a wav file is shorter than its header says; None if it is whole, or no wav file.

    Decoders pass over this in silence and give what there is.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(12)
        if len(head) < 12 or head[:4] != b"RIFF" or head[8:] != b"WAVE":
            return None
        while len(chunk := stream.read(8)) == 8:
            name, length = struct.unpack("<4sI", chunk)
            end = stream.tell() + length
            if name == b"data":
                return end - size if end > size and length < OPEN_END else None
            if end >= size:
                return None
            stream.seek(end + length % 2)
    return None


SLIGHT = 0.1
"""Seconds by which the lengths of speech and motion may differ without a word."""
MUCH = (0.5, 0.1)
"""Speech and motion that differ by more than so many seconds and by more than this share do not belong together."""

LENGTHS = ("length", "speech_shorter", "speech_longer")
"""Kinds of findings about motion and speech that do not last equally long."""


@dataclass(frozen=True)
class ClipFiles:
    """The files of one clip.

    Attributes:
        name: the clip's name.
        subject: whose face it is.
        motion: its motion; None if there is none.
        sound: its speech; None if there is none.
    """

    name: str
    subject: str
    motion: Path | None
    sound: Path | None


@dataclass(frozen=True)
class Rules:
    """What every clip is held against.

    Attributes:
        root: the corpus folder.
        n_vertices: vertices of its meshes.
        stored_frame_rate: motion frames a second on disk.
        templates: neutral faces (V, 3) by subject.
        quick: read headers only.
    """

    root: Path
    n_vertices: int
    stored_frame_rate: float
    templates: Mapping[str, Array]
    quick: bool


@dataclass
class ClipFacts:
    """What one clip holds.

    Attributes:
        name: the clip's name.
        frames: frames on disk; None if they cannot be used.
        n_vertices: vertices of each frame; None if that cannot be told.
        seconds: length of the speech; None if it cannot be used.
        sample_rate: of the speech.
        channels: of the speech.
        hashes: SHA-256 by file, relative to the corpus folder; empty where headers only are read.
        findings: what is wrong with it.
    """

    name: str
    frames: int | None = None
    n_vertices: int | None = None
    seconds: float | None = None
    sample_rate: int | None = None
    channels: int | None = None
    hashes: dict[str, str] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def examine(rules: Rules, clip: ClipFiles) -> ClipFacts:
    """Check one clip; whatever goes wrong becomes a finding."""
    facts = ClipFacts(clip.name)
    try:
        if clip.motion is not None:
            _examine_motion(facts, rules, clip, clip.motion)
        if clip.sound is not None:
            _examine_sound(facts, rules, clip.sound)
        if facts.frames is not None and facts.seconds is not None:
            facts.findings += compare_lengths(clip.name, facts.frames, rules.stored_frame_rate, facts.seconds)
    except Exception as error:  # one strange clip must not end the check of all others
        message = f"could not be checked ({type(error).__name__}: {error}); get its files anew"
        facts.findings.append(Finding("error", "clip_unreadable", clip.name, message))
    return facts


def _examine_motion(facts: ClipFacts, rules: Rules, clip: ClipFiles, path: Path) -> None:
    where = relative(path, rules.root)
    motion = look_at_motion(path, where, rules.n_vertices, clip.subject, rules.templates, quick=rules.quick)
    facts.frames, facts.n_vertices = motion.frames, motion.n_vertices
    facts.findings += motion.findings
    _hash(facts, rules, path, where)


def _examine_sound(facts: ClipFacts, rules: Rules, path: Path) -> None:
    where = relative(path, rules.root)
    sound = look_at_sound(path, where, quick=rules.quick)
    facts.seconds, facts.sample_rate, facts.channels = sound.seconds, sound.sample_rate, sound.channels
    facts.findings += sound.findings
    _hash(facts, rules, path, where)


def _hash(facts: ClipFacts, rules: Rules, path: Path, where: str) -> None:
    if not rules.quick and path.is_file() and path.stat().st_size:
        facts.hashes[where] = sha256(path)


def compare_lengths(name: str, frames: int, frame_rate: float, seconds: float) -> list[Finding]:
    """What is to be said about motion and speech of one clip that do not last equally long.

    Args:
        name: the clip.
        frames: motion frames on disk.
        frame_rate: how many of them make a second.
        seconds: length of the speech.
    """
    lasts = frames / frame_rate
    lengths = f"the motion lasts {lasts:.2f} s ({frames} frames at {frame_rate:g} a second), the speech {seconds:.2f} s"
    difference = abs(lasts - seconds)
    if difference <= SLIGHT:
        return []
    if difference > MUCH[0] and difference > MUCH[1] * max(lasts, seconds):
        confused = next((rate for rate in (2.0, 0.5) if is_about(frames / seconds, rate * frame_rate)), None)
        hint = f", as if there were {confused * frame_rate:g} frames a second" if confused else ""
        return [
            Finding(
                "error",
                "length",
                name,
                f"{lengths}{hint}: they do not belong together, or one of them is cut; get the clip anew or remove it",
            )
        ]
    if seconds < lasts:
        message = f"{lengths}: the speech is filled up with silence at its end"
    else:
        message = f"{lengths}: the end of the speech is left out"
    return [Finding("warning", "speech_shorter" if seconds < lasts else "speech_longer", name, message)]


def is_about(value: float, other: float) -> bool:
    """Whether two rates are the same but for the few frames by which clips differ."""
    return abs(value / other - 1) < 0.1
