"""Looking at one clip: its motion, its speech, and whether they go together.

Worker processes import this, so it imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from facediff.doctor.findings import Finding, relative
from facediff.doctor.motion import Array, look_at_motion
from facediff.doctor.sound import look_at_sound
from facediff.files import sha256

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
