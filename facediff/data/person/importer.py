"""From a reconstructed video to a corpus entry."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.audio import SAMPLE_RATE, fit_length, read_speech, samples_for
from facediff.data.person.frames import (
    Auxiliary,
    check_faces,
    into_coordinates,
    lay_onto_corpus,
    read_auxiliary,
    scratch_array,
)
from facediff.data.person.motion import (
    Motion,
    Neutral,
    Stabilised,
    choose_neutral,
    cut_points,
    loudness,
    middle_face,
    read_motion,
    read_stable,
    read_template,
    splits,
    stabilise,
)
from facediff.data.prepare.motion import resample_frames, resampled_length
from facediff.data.prepare.runner import (
    MANIFEST,
    version,
    write_clip,
    write_templates,
)
from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, stable_vertices
from facediff.mesh.alignment import chunks
from facediff.utils.files import (
    atomic_folder,
    check_writable,
    describe_files,
    scratch_folder,
    write_json,
    write_rows,
)

# Writing a person's corpus entry: all of it, or nothing.


@dataclass(frozen=True)
class EntryClip:
    """One clip to write.

    Attributes:
        name: ``<person>_s01``.
        split: ``train``, ``val`` or ``test``.
        start: its first frame.
        stop: the frame after its last one.
    """

    name: str
    split: str
    start: int
    stop: int


def check_output(path: Path) -> None:
    """Refuse, before any work is done, a folder that is not empty or cannot be made.

    Raises:
        FaceDiffError: saying which.
    """
    if path.exists() and not path.is_dir():
        raise FaceDiffError(f"{path}: is a file; expected the name of a new folder")
    if path.is_dir() and any(path.iterdir()):
        raise FaceDiffError(f"{path}: is not empty; choose a new folder, or remove this one")
    check_writable(path / "manifest.json")
    check_writable(path.with_name(f".{path.name}.probe"))


def write_entry(
    folder: Path,
    *,
    name: str,
    clips: Sequence[EntryClip],
    frames: npt.NDArray[np.floating],
    speech: npt.NDArray[np.float32],
    template: npt.NDArray[np.floating],
    frame_rate: float,
    facts: dict[str, Any],
) -> None:
    """Write an entry in the layout that every corpus has, and its manifest.

    Args:
        folder: where to.
        name: the person.
        clips: how the frames are cut.
        frames: (T, V, 3) absolute vertices; may be memory-mapped.
        speech: (S,) at 16 kHz; missing samples at its end become zeros.
        template: (V, 3) neutral face.
        frame_rate: frames a second.
        facts: what else the manifest shall say.
    """
    # 16-bit sound ends at full scale: turn down a recording that goes beyond as a whole.
    speech = speech / max(1.0, float(np.abs(speech).max(initial=0.0)))
    for clip in clips:
        first = samples_for(clip.start, frame_rate)
        part = fit_length(speech[first:], samples_for(clip.stop, frame_rate) - first)
        write_clip(folder, clip.name, frames[clip.start : clip.stop], part)
    write_templates(folder / "templates.pkl", {name: template.astype(np.float32)})
    rows = [
        {"clip": clip.name, "subject": name, "sentence": clip.name.rpartition("_")[2], "split": clip.split}
        for clip in clips
    ]
    write_rows(folder / "clips.csv", rows, line_end="\n")
    files = describe_files(folder, workers=2)
    write_json(folder / MANIFEST, {"facediff": version(), "corpus": "person", "person": name, **facts, "files": files})


# What an import did, for people and for the manifest.


@dataclass(frozen=True)
class Report:
    """What an import did. Lengths are in the unit of the corpus unless said otherwise.

    Attributes:
        name: the person.
        frames: frames that were read.
        seconds: how long they last.
        frame_rate: their frames a second.
        corpus_frame_rate: frames a second that were written.
        has_head_motion: whether there was head motion to remove; parameters without global pose have none.
        rotation_max: largest angle of the head from its mean pose, in degrees.
        rotation_rms: root mean square of these angles, in degrees.
        translation_max: largest distance of the head from its mean place.
        translation_rms: root mean square of these distances.
        stable_vertices: how many vertices told the head's motion.
        stable_source: where they are from.
        jitter: root-mean-square distance of the stable vertices from their median, head motion removed.
        scale: corpus units to a unit of the motion, as used.
        measured_scale: the same, as measured between the person's neutral face and the corpus's mean face.
        topology_residual: what is left between these two, as a share of the face's size.
        faces_compared: whether the triangles were compared as well.
        template_source: where the neutral face is from.
        template_frames: the frames it is the median of; empty if it was given.
        mismatch: seconds by which sound outlasts motion (negative: motion outlasts sound).
        clips: clips that were written.
        splits: how many of them in each split.
        frames_written: frames that were written.
        warnings: what the user should look at.
        notes: other remarks.
    """

    name: str
    frames: int
    seconds: float
    frame_rate: float
    corpus_frame_rate: float
    has_head_motion: bool
    rotation_max: float
    rotation_rms: float
    translation_max: float
    translation_rms: float
    stable_vertices: int
    stable_source: str
    jitter: float
    scale: float
    measured_scale: float
    topology_residual: float
    faces_compared: bool
    template_source: str
    template_frames: list[int]
    mismatch: float
    clips: int
    splits: dict[str, int]
    frames_written: int
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def state(self) -> dict[str, Any]:
        """Plain data, for the manifest."""
        return asdict(self)

    def lines(self, unit: str | None) -> list[str]:
        """The report in words.

        Args:
            unit: the corpus's unit of length; "corpus units" if None.
        """
        of = unit or "corpus units"
        splits = ", ".join(f"{count} {split}" for split, count in self.splits.items())
        compared = "triangles equal" if self.faces_compared else "triangles not compared"
        told = f"told by {self.stable_vertices} vertices {self.stable_source}"
        head = [
            ("rotation removed", f"at most {self.rotation_max:.3f}°, RMS {self.rotation_rms:.3f}°"),
            ("translation removed", f"at most {self.translation_max:.4g} {of}, RMS {self.translation_rms:.4g} {of}"),
        ]
        none = [("head motion", "none in it: the parameters' global pose is left out")]
        rows = [
            ("read", f"{self.frames} frames at {self.frame_rate:g} frames/s, {self.seconds:.2f} s"),
            *(head if self.has_head_motion else none),
            ("stable vertices", f"{told}; they still jitter by {self.jitter:.3g} {of} RMS"),
            ("scale", f"{self.scale:.6g} (measured {self.measured_scale:.6g})"),
            ("topology", f"residual {self.topology_residual:.3f} of the face's size, {compared}"),
            ("template", self.template_source),
            (
                "sound and motion",
                f"sound is {abs(self.mismatch):.2f} s {'longer' if self.mismatch >= 0 else 'shorter'}",
            ),
            ("written", f"{self.clips} clips ({splits}), {self.frames_written} frames at {self.corpus_frame_rate:g}/s"),
        ]
        return [
            *(f"{title:<21}{text}" for title, text in rows),
            *(f"note: {note}" for note in self.notes),
            *(f"warning: {warning}" for warning in self.warnings),
        ]


Speech = npt.NDArray[np.float32]

MIN_SECONDS = 2.0
MIN_CLIP_SECONDS = 1.0
SILENCE = 1e-4
MISMATCH = 0.1
"""Sound and motion may differ in length by this share; more is an error."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]{0,63}")


@dataclass(frozen=True)
class Fitted:
    """A person's frames on the way into the corpus.

    Attributes:
        made: frames without head motion, still in the motion's coordinates.
        neutral: the neutral face.
        place: from the neutral face's coordinates to the corpus's.
        measured_scale: scale of the best similarity between the neutral face and the corpus's mean face.
        residual: what that similarity leaves, as a share of the face's size.
        faces_compared: whether the triangles could be compared with the corpus's.
    """

    made: Stabilised
    neutral: Neutral
    place: Similarity
    measured_scale: float
    residual: float
    faces_compared: bool


@dataclass(frozen=True)
class Request:
    """The arguments of :func:`import_person`, which explains them."""

    motion: Path
    audio: Path
    name: str
    corpus: Path
    output: Path
    frame_rate: float
    corpus_frame_rate: float | None
    template: Path | None
    stable: str | None
    flame: Path | None
    scale: float | None
    clip_seconds: float
    progress: bool


def import_person(
    motion: Path,
    *,
    audio: Path,
    name: str,
    corpus: Path,
    output: Path,
    frame_rate: float,
    corpus_frame_rate: float | None = None,
    template: Path | None = None,
    stable: str | None = None,
    flame: Path | None = None,
    scale: float | None = None,
    clip_seconds: float = 8.0,
    progress: bool = False,
) -> Report:
    """Turn the reconstruction of one person's video into a corpus entry that fits an existing corpus.

    Args:
        motion: folder of .obj or .ply files, .npy of vertices, or FLAME parameters (.hdf5, .npy).
        audio: the video, or its sound.
        name: the person's name, without underscore.
        corpus: folder of the auxiliary corpus.
        output: folder to make.
        frame_rate: frames a second of the motion.
        corpus_frame_rate: frames a second of the corpus, where its manifest does not say.
        template: neutral face (.obj, .ply, .npy) in the motion's unit; found in the motion if None.
        stable: file of the vertices that move with the skull only; found in the motion if None.
        flame: FLAME model file, for FLAME parameters.
        scale: corpus units to a unit of the motion; measured if None.
        clip_seconds: length of the clips, about.
        progress: whether to show a progress bar.

    Returns:
        what was done.

    Raises:
        FaceDiffError: for anything that is wrong with files or arguments; nothing is left behind then.
    """
    output = output.expanduser().absolute()
    request = Request(
        motion,
        audio,
        name,
        corpus,
        output,
        frame_rate,
        corpus_frame_rate,
        template,
        stable,
        flame,
        scale,
        clip_seconds,
        progress,
    )
    _check_arguments(request)
    check_output(output)
    known = read_auxiliary(corpus, name=name, frame_rate=corpus_frame_rate)
    speech = _read_speech(audio)
    with scratch_folder(output) as scratch, atomic_folder(output) as folder:
        return _import(request, known, speech, folder, scratch)


def _import(request: Request, known: Auxiliary, speech: Speech, folder: Path, scratch: Path) -> Report:
    read = read_motion(
        request.motion,
        n_vertices=known.n_vertices,
        frame_rate=request.frame_rate,
        scratch=scratch / "read.npy",
        flame=request.flame,
        progress=request.progress,
    )
    warnings = _check_lengths(request, len(speech), len(read.frames))
    fitted = _fit(request, read, known, speech, scratch)
    frames = _move(fitted.made.frames, fitted.neutral.placing.then(fitted.place))
    frames = _at_rate(frames, request.frame_rate, known.frame_rate, scratch / "rate.npy")
    clips = _clips(request, speech, len(frames), known.frame_rate)
    report = _report(request, read, known, fitted, clips, len(speech), warnings)
    write_entry(
        folder,
        name=request.name,
        clips=clips,
        frames=frames,
        speech=speech,
        template=fitted.place.apply(fitted.neutral.face),
        frame_rate=known.frame_rate,
        facts={
            "frame_rate": known.frame_rate,
            "n_vertices": known.n_vertices,
            "unit": known.unit,
            "report": report.state(),
        },
    )
    return report


def _fit(request: Request, read: Motion, known: Auxiliary, speech: Speech, scratch: Path) -> Fitted:
    """Take out the head's motion, find the neutral face, and find the way into the corpus's coordinates."""
    given = None if request.template is None else read_template(request.template, known)
    told = None if request.stable is None else read_stable(request.stable, known.n_vertices)
    compared = check_faces(request.motion, read.faces, known)
    with _naming(request.motion):
        for _ in chunks(read.frames):
            pass  # every frame is finite
        stable = stable_vertices(read.frames) if told is None else told
        face = middle_face(read, stable)
        lay_onto_corpus(request.motion, face, known)  # before the long work
        made = stabilise(read, face, stable, scratch / "stable.npy")
    source = request.template or request.motion
    with _naming(source):
        neutral = choose_neutral(read, made, given, speech, request.frame_rate)
        best, residual = lay_onto_corpus(source, neutral.face, known)
    place = into_coordinates(neutral.face, best, request.scale)
    return Fitted(made, neutral, place, best.scale, residual, compared)


def _check_arguments(request: Request) -> None:
    if not NAME.fullmatch(request.name):
        raise FaceDiffError(
            f"--name {request.name!r}: expected letters, digits and dashes, at most 64, with no dash first"
        )
    numbers = {
        "--frame-rate": request.frame_rate,
        "--corpus-frame-rate": request.corpus_frame_rate,
        "--scale": request.scale,
        "--clip-seconds": request.clip_seconds,
    }
    for option, number in numbers.items():
        if number is not None and not (math.isfinite(number) and number > 0):
            raise FaceDiffError(f"{option} {number:g}: expected a positive number")
    if request.clip_seconds < MIN_CLIP_SECONDS:
        raise FaceDiffError(f"--clip-seconds {request.clip_seconds:g}: expected at least {MIN_CLIP_SECONDS:g}")


def _read_speech(path: Path) -> Speech:
    speech = read_speech(path)
    if float(np.abs(speech).max()) < SILENCE:
        raise FaceDiffError(f"{path}: holds only silence; expected the speech of the video")
    return speech


def _check_lengths(request: Request, samples: int, frames: int) -> list[str]:
    """Warnings about the lengths of sound and motion.

    Raises:
        FaceDiffError: if they are too short, or differ by more than a tenth.
    """
    sound, motion = samples / SAMPLE_RATE, frames / request.frame_rate
    lengths = (
        f"the motion lasts {motion:.2f} s ({frames} frames at {request.frame_rate:g}/s) and the sound {sound:.2f} s"
    )
    if abs(sound - motion) > MISMATCH * max(sound, motion):
        raise FaceDiffError(
            f"{request.motion} and {request.audio}: {lengths}; expected the same stretch of video; check --frame-rate"
        )
    if min(sound, motion) < MIN_SECONDS:
        raise FaceDiffError(
            f"{request.motion}: {lengths}; expected at least {MIN_SECONDS:g} s, and better about a minute"
        )
    if abs(sound - motion) > 2 / request.frame_rate + 0.1:
        return [f"{lengths}; what one has over the other is left out at the end"]
    return []


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put a path before the messages of errors that do not name a file."""
    try:
        yield
    except FaceDiffError as error:
        if str(error).startswith(str(path)):
            raise
        raise FaceDiffError(f"{path}: {error}") from error


def _move(frames: npt.NDArray[np.floating], way: Similarity) -> npt.NDArray[np.floating]:
    """Map frames where they are, chunk by chunk."""
    for part, chunk in chunks(frames):
        frames[part] = way.apply(chunk)
    return frames


def _at_rate(
    frames: npt.NDArray[np.floating], rate_in: float, rate_out: float, scratch: Path
) -> npt.NDArray[np.floating]:
    if rate_in == rate_out:
        return frames
    shape = (resampled_length(len(frames), rate_in, rate_out), *frames.shape[1:])
    return resample_frames(frames, rate_in, rate_out, out=scratch_array(scratch, shape))


def _clips(request: Request, speech: Speech, frames: int, frame_rate: float) -> list[EntryClip]:
    """Cut what both sound and motion cover."""
    covered = min(frames, max(1, round(len(speech) / SAMPLE_RATE * frame_rate)))
    cuts = cut_points(loudness(speech, covered, frame_rate), request.clip_seconds * frame_rate)
    width = max(2, len(str(len(cuts))))
    return [
        EntryClip(f"{request.name}_s{i:0{width}d}", split, *cut)
        for i, (cut, split) in enumerate(zip(cuts, splits(len(cuts)), strict=True), start=1)
    ]


def _report(
    request: Request,
    read: Motion,
    known: Auxiliary,
    fitted: Fitted,
    clips: list[EntryClip],
    samples: int,
    warnings: list[str],
) -> Report:
    made, scale, seconds = fitted.made, fitted.place.scale, len(read.frames) / request.frame_rate
    return Report(
        name=request.name,
        frames=len(read.frames),
        seconds=seconds,
        frame_rate=request.frame_rate,
        corpus_frame_rate=known.frame_rate,
        has_head_motion=read.has_head_motion,
        rotation_max=float(np.degrees(made.turns.max())),
        rotation_rms=float(np.degrees(_rms(made.turns))),
        translation_max=scale * float(made.shifts.max()),
        translation_rms=scale * _rms(made.shifts),
        stable_vertices=len(made.stable),
        stable_source="found to move least" if request.stable is None else f"of {request.stable}",
        jitter=scale * made.jitter,
        scale=scale,
        measured_scale=fitted.measured_scale,
        topology_residual=fitted.residual,
        faces_compared=fitted.faces_compared,
        template_source=fitted.neutral.source,
        template_frames=fitted.neutral.frames,
        mismatch=samples / SAMPLE_RATE - seconds,
        clips=len(clips),
        splits=dict(Counter(clip.split for clip in clips)),
        frames_written=clips[-1].stop,
        warnings=warnings,
        notes=read.notes,
    )


def _rms(values: npt.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.square(values).mean()))
