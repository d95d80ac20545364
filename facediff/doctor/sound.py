"""Looking at one file of speech."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facediff.doctor.findings import Finding

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
