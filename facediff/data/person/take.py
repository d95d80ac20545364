"""A person from a phone: a recording of Live Link Face and its sound as a corpus entry, in step with each other."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.person.fitting import loudness
from facediff.data.person.importer import (
    MIN_SECONDS,
    EntryClip,
    check_entry,
    cut,
    read_entry_speech,
    write_entry_manifest,
)
from facediff.data.preparation import write_speech
from facediff.errors import FaceDiffError, counted
from facediff.spaces.files import ParameterClip, even, read_parameters
from facediff.spaces.files.csv_files import write_live_link
from facediff.speech.audio import SAMPLE_RATE, fit_length
from facediff.utils import ranges
from facediff.utils.cross_correlation import correlations, lagged_correlation, peak
from facediff.utils.files import put_in_place, scratch_folder

Array = npt.NDArray[np.float64]
Speech = npt.NDArray[np.float32]

STEPS = 200.0
"""Times a second at which loudness and the mouth's opening are compared."""
LEAD = 0.012
"""Seconds by which a mouth opens before it is heard: the mean of 26 speakers of the built-in corpus, with sound
and motion in step and 24 to 60 s of each (standard deviation 0.008)."""
SMOOTHING = 0.05
"""Seconds over which loudness is averaged."""
LEAST_SECONDS = 1.0
"""Of both that must overlap for an offset to be considered."""
SURE = 0.3
"""Correlation below which an offset may be chance; with speech in step it is 0.55 to 0.7."""
FOLDER = "recordings"


@dataclass(frozen=True)
class Offset:
    """Where the motion's beginning lies in the sound."""

    seconds: float  # of the sound before the motion begins; negative where the motion begins first
    correlation: float  # of loudness and the mouth's opening there; at most 1
    found: bool  # whether it was found, or stated by the user


@dataclass(frozen=True)
class TakeReport:
    """What an import found and did, for users and for the manifest."""

    name: str
    frame_rate: float
    frames: int
    dropped: int
    offset: Offset
    clips: int
    seconds: float
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """The report, a line each."""
        origin = "found by the mouth's opening and the loudness" if self.offset.found else "as stated"
        before = "the sound begins first" if self.offset.seconds >= 0 else "the motion begins first"
        return [
            f"{self.frames} frames at {self.frame_rate:g} a second, {self.dropped} of them dropped and interpolated",
            f"offset {self.offset.seconds:+.3f} s ({before}), {origin}; correlation {self.offset.correlation:.2f}",
            f"{counted(self.clips, 'clip')}, {self.seconds:.1f} s",
            *(f"warning: {warning}" for warning in self.warnings),
        ]


def mouth_opening(clip: ParameterClip) -> Array:
    """How far the mouth is open (T,): the jaw's opening less the closing of the lips, ARKit's mouthClose."""
    jaw, close = (clip.values[:, clip.space.index(name)].astype(np.float64) for name in ("jawOpen", "mouthClose"))
    return np.asarray(jaw - close)


def find_offset(opening: Array, frame_rate: float, speech: Speech, most_seconds: float) -> Offset:
    """Find where motion begins in its sound by the cross-correlation of the mouth's opening with loudness.

    Both are compared two hundred times a second, each stretch of overlap with its own mean and deviation; a parabola
    through the best three gives the fraction of a step. A mouth opens before it is heard, by
    :data:`LEAD`, which is taken off.

    Args:
        opening: (T,) of the mouth.
        frame_rate: frames a second.
        speech: (S,) at 16 kHz.
        most_seconds: largest offset to consider, either way.
    """
    loud, mouth = _series(opening, frame_rate, speech)
    scores = correlations(loud, mouth, round(most_seconds * STEPS), round(LEAST_SECONDS * STEPS))
    return Offset((peak(scores) + 0.5) / STEPS - LEAD, float(max(scores.max(), -1.0)), found=True)


def _series(opening: Array, frame_rate: float, speech: Speech) -> tuple[Array, Array]:
    """Loudness and the mouth's opening at :data:`STEPS`."""
    steps = int(len(opening) / frame_rate * STEPS)
    mouth = np.interp(np.arange(steps) / STEPS, np.arange(len(opening)) / frame_rate, opening)
    return loudness(speech, int(len(speech) / SAMPLE_RATE * STEPS), STEPS, smoothing=SMOOTHING), mouth


@ranges.checked
def import_take(
    take: Path,
    sound: Path,
    *,
    name: str,
    output: Path,
    offset: ranges.TakeOffset | None = None,
    most_offset: ranges.ClipLength = 10.0,
    clip_seconds: ranges.ClipLength = 8.0,
) -> TakeReport:
    """Turn a recording of Live Link Face and its sound into a corpus entry.

    Args:
        take: the recording (.csv).
        sound: its sound, or the video.
        name: the person's name, without underscore.
        output: folder to make.
        offset: seconds of the sound before the motion begins; found if None.
        most_offset: largest offset to look for, either way.
        clip_seconds: approximate length of the clips.
    """
    output = check_entry(name, output)
    recorded = read_parameters(take)
    if recorded.layout != "live_link":
        raise FaceDiffError(f"{take}: is no recording of Live Link Face; expected its .csv with a timecode")
    speech = read_entry_speech(sound)
    clip = even(recorded)
    warnings = []
    if offset is None:
        best = find_offset(mouth_opening(clip), clip.frame_rate, speech, most_offset)
        if best.correlation < SURE:
            warnings.append(
                f"mouth and loudness go together with {best.correlation:.2f} only (usual: 0.5 and more): look at the "
                f"result, or state the offset with --offset"
            )
    else:
        loud, mouth = _series(mouth_opening(clip), clip.frame_rate, speech)
        lag = round((offset + LEAD) * STEPS - 0.5)
        correlation = max(lagged_correlation(loud, mouth, lag, round(LEAST_SECONDS * STEPS)), -1.0)
        best = Offset(offset, correlation, found=False)
    # Frames within the sound; the sound begins with the first of them.
    times = best.seconds + np.arange(len(clip.values)) / clip.frame_rate
    inside = np.flatnonzero((times >= 0) & (times <= len(speech) / SAMPLE_RATE - 1 / clip.frame_rate))
    if len(inside) < MIN_SECONDS * clip.frame_rate:
        raise FaceDiffError(
            f"{take} and {sound}: overlap by {len(inside) / clip.frame_rate:.2f} s; expected {MIN_SECONDS:g} s at "
            f"least, and better a minute; check that they are one take"
        )
    clip = replace(clip, values=clip.values[inside])
    speech = speech[round(float(times[inside[0]]) * SAMPLE_RATE) :]
    speech = fit_length(speech, round(len(inside) / clip.frame_rate * SAMPLE_RATE))
    turning = {*clip.space.head, *clip.space.eyes}
    beyond = [i for i in range(len(clip.space.channels)) if i not in turning and clip.values[:, i].max() > 1]
    if beyond:
        names = ", ".join(clip.space.channels[i] for i in beyond)
        warnings.append(f"weights above 1, kept as recorded: {names}")
    if not clip.values[:, list(clip.space.head)].any():
        warnings.append("the head does not move: head rotation was probably switched off in the app")
    entries = cut(name, speech, len(clip.values), clip.frame_rate, clip_seconds)
    seconds = len(clip.values) / clip.frame_rate
    report = TakeReport(
        name, clip.frame_rate, len(clip.values), recorded.dropped, best, len(entries), seconds, tuple(warnings)
    )
    with scratch_folder(output) as scratch:
        entry = scratch / output.name
        _write(entry, clip, speech, entries, report)
        put_in_place(entry, output, replace=False)
    return report


def _write(folder: Path, clip: ParameterClip, speech: Speech, entries: list[EntryClip], report: TakeReport) -> None:
    (folder / FOLDER).mkdir(parents=True)
    for entry in entries:
        part = replace(clip, name=entry.name, values=clip.values[entry.start : entry.stop], start=0.0)
        write_live_link(folder / FOLDER / f"{entry.name}.csv", part)
        first, stop = (round(frame / clip.frame_rate * SAMPLE_RATE) for frame in (entry.start, entry.stop))
        write_speech(folder / "wav" / f"{entry.name}.wav", speech[first:stop])
    write_entry_manifest(folder, report.name, entries, {"layout": "live_link"}, asdict(report))
