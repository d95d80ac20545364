"""From the reconstruction of one speaker's video to a corpus entry: the steps in order, the report, and the files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from facediff.data.manifest import FORMAT
from facediff.data.person.fitting import (
    Array,
    Speech,
    choose_neutral,
    into_coordinates,
    lay_onto_corpus,
    loudness,
    middle_face,
    read_motion,
    read_stable,
    read_target_corpus,
    scratch_array,
    stabilise,
)
from facediff.data.preparation import MANIFEST, version, write_clip, write_templates
from facediff.data.reconstructions import resample_frames, resampled_length
from facediff.errors import FaceDiffError, counted, damaged
from facediff.mesh import stable_vertices
from facediff.mesh.alignment import chunks
from facediff.speech.audio import SAMPLE_RATE, fit_length, read_speech, samples_for
from facediff.utils import ranges
from facediff.utils.checksums import describe_files
from facediff.utils.files import check_writable, put_in_place, refuse_content, scratch_folder
from facediff.utils.plain_files import write_json, write_rows

MIN_SECONDS = 2.0
SILENCE = 1e-4  # loudest sample below which a recording counts as silent
MISMATCH = 0.1  # speech and motion may differ in length by this share; more is an error
SLACK = 0.25  # how far a cut may lie from an equal division, as a share of a clip
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]{0,63}")


@ranges.checked
def import_person(
    motion: Path,
    *,
    audio: Path,
    name: str,
    corpus: Path,
    output: Path,
    frame_rate: ranges.FrameRate,
    template: Path | None = None,
    stable: str | None = None,
    flame: Path | None = None,
    clip_seconds: ranges.ClipLength = 8.0,
) -> ImportReport:
    """Turn the reconstruction of one speaker's video into a corpus entry that fits an existing corpus.

    Args:
        motion: .npy of vertices, or FLAME parameters (.hdf5, .npy).
        audio: the video, or its sound.
        name: the speaker's name, without underscore.
        corpus: folder of the corpus that the speaker is to join.
        output: folder to make.
        frame_rate: frames per second of the motion.
        template: neutral face (.npy) in the motion's unit; found in the motion if None.
        stable: file of the vertices that move with the skull only; found in the motion if None.
        flame: FLAME model file, for FLAME parameters.
        clip_seconds: approximate length of the clips.

    Returns:
        the report of the import.
    """
    output = check_entry(name, output)
    target = read_target_corpus(corpus, name)
    speech = read_entry_speech(audio)
    with scratch_folder(output) as scratch:
        read = read_motion(motion, len(target.mean), scratch / "read.npy", flame)
        warnings = _check_lengths(motion, audio, len(speech), len(read.frames), frame_rate)
        skull = None if stable is None else read_stable(stable, len(target.mean))
        with damaged(motion, "get the motion again"):
            for _ in chunks(read.frames):
                pass  # refuses frames that are not finite
            still = stable_vertices(read.frames) if skull is None else skull
            face = middle_face(read, still)
            lay_onto_corpus(motion, face, target)  # another topology is refused before the long work
            stabilised = stabilise(read, face, still, scratch / "stable.npy")
        with damaged(template or motion, "choose another neutral face"):
            neutral = choose_neutral(read, stabilised, template, speech, frame_rate, target.lip_pairs)
            best, residual = lay_onto_corpus(template or motion, neutral.face, target)
        to_corpus = into_coordinates(neutral.face, best)
        frames, whole = stabilised.frames, neutral.placing.then(to_corpus)
        for part, chunk in chunks(frames):
            frames[part] = whole.apply(chunk)
        if frame_rate != target.frame_rate:
            length = resampled_length(len(frames), frame_rate, target.frame_rate)
            resampled = scratch_array(scratch / "rate.npy", (length, *frames.shape[1:]))
            frames = resample_frames(frames, frame_rate, target.frame_rate, out=resampled)
        clips = cut(name, speech, len(frames), target.frame_rate, clip_seconds)
        report = ImportReport(
            name=name,
            frames=len(read.frames),
            seconds=len(read.frames) / frame_rate,
            frame_rate=frame_rate,
            corpus_frame_rate=target.frame_rate,
            has_head_motion=read.has_head_motion,
            rotation_max=float(np.degrees(stabilised.turns.max())),
            rotation_rms=float(np.degrees(_rms(stabilised.turns))),
            translation_max=to_corpus.scale * float(stabilised.shifts.max()),
            translation_rms=to_corpus.scale * _rms(stabilised.shifts),
            stable_vertices=len(still),
            stable_source="found to move least" if stable is None else f"of {stable}",
            jitter=to_corpus.scale * stabilised.jitter,
            scale=to_corpus.scale,
            measured_scale=best.scale,
            topology_residual=residual,
            template_source=neutral.source,
            template_frames=neutral.frames,
            mismatch=len(speech) / SAMPLE_RATE - len(read.frames) / frame_rate,
            clips=len(clips),
            splits=dict(Counter(clip.split for clip in clips)),
            frames_written=clips[-1].stop,
            warnings=warnings,
        )
        entry = scratch / output.name
        for clip in clips:
            first = samples_for(clip.start, target.frame_rate)
            spoken = fit_length(speech[first:], samples_for(clip.stop, target.frame_rate) - first)
            write_clip(entry, clip.name, frames[clip.start : clip.stop], spoken)
        write_templates(entry / "templates.pkl", {name: to_corpus.apply(neutral.face).astype(np.float32)})
        fields = {"frame_rate": target.frame_rate, "n_vertices": len(target.mean), "unit": target.unit}
        write_entry_manifest(entry, name, clips, fields, asdict(report))
        put_in_place(entry, output, replace=False)
    return report


def check_entry(name: str, output: Path) -> Path:
    """The folder of an entry; before any work, names of another form and folders that exist are refused."""
    path = output.expanduser().absolute()
    if not NAME.fullmatch(name):
        raise FaceDiffError(f"--name {name!r}: expected letters, digits and dashes, at most 64, with no dash first")
    refuse_content(path)
    check_writable(path / "manifest.json")
    check_writable(path.with_name(f".{path.name}.probe"))
    return path


def read_entry_speech(path: Path) -> Speech:
    """The speech of a video or a sound file; silence is refused.

    16-bit sound ends at full scale: a recording that goes beyond is turned down as a whole.
    """
    speech = read_speech(path)
    loudest = float(np.abs(speech).max(initial=0.0))
    if loudest < SILENCE:
        raise FaceDiffError(f"{path}: holds only silence; expected the speech of the video")
    return speech / np.float32(max(1.0, loudest))


def _check_lengths(motion: Path, audio: Path, samples: int, frames: int, frame_rate: float) -> list[str]:
    """Warnings about the lengths of speech and motion; an error if they are too short, or differ by over a tenth."""
    sound_seconds, motion_seconds = samples / SAMPLE_RATE, frames / frame_rate
    lengths = (
        f"the motion lasts {motion_seconds:.2f} s ({frames} frames at {frame_rate:g}/s) and the sound "
        f"{sound_seconds:.2f} s"
    )
    difference = abs(sound_seconds - motion_seconds)
    too_different = difference > MISMATCH * max(sound_seconds, motion_seconds)
    if too_different or min(sound_seconds, motion_seconds) < MIN_SECONDS:
        raise FaceDiffError(
            f"{motion} and {audio}: {lengths}; expected the same stretch of video; check --frame-rate, and record at "
            f"least {MIN_SECONDS:g} s"
        )
    if difference > 2 / frame_rate + 0.1:
        return [f"{lengths}; the end of the longer one is left out"]
    return []


# Cutting into clips.


@dataclass(frozen=True)
class EntryClip:
    """One clip to write, ``<identity>_s01``: the frames from ``start`` to before ``stop``."""

    name: str
    split: str
    start: int
    stop: int


def cut(name: str, speech: Speech, frames: int, frame_rate: float, clip_seconds: float) -> list[EntryClip]:
    """Cut what both speech and motion cover into clips."""
    covered = min(frames, max(1, round(len(speech) / SAMPLE_RATE * frame_rate)))
    cuts = cut_points(loudness(speech, covered, frame_rate), clip_seconds * frame_rate)
    width = max(2, len(str(len(cuts))))
    return [
        EntryClip(f"{name}_s{i:0{width}d}", split, *cut)
        for i, (cut, split) in enumerate(zip(cuts, splits(len(cuts)), strict=True), start=1)
    ]


def cut_points(loud: Array, clip_frames: float) -> list[tuple[int, int]]:
    """Divide frames of loudness (T,) into clips of about ``clip_frames``, each cut at the quietest frame near its end.

    Returns:
        first frame and frame after the last of every clip; together they are all frames.
    """
    clips = max(1, round(len(loud) / clip_frames))
    length = len(loud) / clips
    cuts = [0]
    for i in range(1, clips):
        first = max(cuts[-1] + 1, round((i - SLACK) * length))
        window = loud[first : max(first + 1, round((i + SLACK) * length))]
        quiet = np.flatnonzero(window == window.min())
        cuts.append(first + int(quiet[len(quiet) // 2]))  # the middle of the pause
    return list(zip(cuts, [*cuts[1:], len(loud)], strict=True))


def splits(clips: int) -> list[str]:
    """Split of every clip: the last 15 % ``test``, the 10 % before them ``val``, the rest ``train``.

    With four clips or more there is at least one of each; fewer are all ``train``.
    """
    if clips < 4:
        return ["train"] * clips
    test, val = max(1, round(0.15 * clips)), max(1, round(0.10 * clips))
    return ["train"] * (clips - val - test) + ["val"] * val + ["test"] * test


# The report, for users and for the manifest.


@dataclass(frozen=True)
class ImportReport:
    """The outcome of an import. Lengths are in the unit of the corpus unless said otherwise."""

    name: str
    frames: int  # frames that were read
    seconds: float
    frame_rate: float
    corpus_frame_rate: float  # frames per second that were written
    has_head_motion: bool
    rotation_max: float  # largest angle of the head from its mean pose, in degrees
    rotation_rms: float  # root mean square of these angles, in degrees
    translation_max: float  # largest distance of the head from its mean place
    translation_rms: float  # root mean square of these distances
    stable_vertices: int  # from how many vertices the head's motion was measured
    stable_source: str  # how they were chosen
    jitter: float  # root-mean-square distance of the stable vertices from their median, head motion removed
    scale: float  # corpus units to a unit of the motion, as used
    measured_scale: float  # the same, as measured between the speaker's neutral face and the corpus's mean face
    topology_residual: float  # residual between these two faces, as a share of the face's size
    template_source: str  # how the neutral face was obtained
    template_frames: list[int]  # the frames it is the median of; empty if it was given
    mismatch: float  # seconds by which the sound is longer than the motion (negative: shorter)
    clips: int
    splits: dict[str, int]
    frames_written: int
    warnings: list[str] = field(default_factory=list)  # what the user should check

    def lines(self, unit: str | None) -> list[str]:
        """The report as lines of text.

        Args:
            unit: the corpus's unit of length; "corpus units" if None.
        """
        of = unit or "corpus units"
        clips = counted(self.clips, "clip")
        splits = ", ".join(f"{count} {split}" for split, count in self.splits.items())
        stable = f"{self.stable_vertices} vertices {self.stable_source}, which jitter by {self.jitter:.3g} {of} RMS"
        head = [
            ("rotation removed", f"at most {self.rotation_max:.3f}°, RMS {self.rotation_rms:.3f}°"),
            ("translation removed", f"at most {self.translation_max:.4g} {of}, RMS {self.translation_rms:.4g} {of}"),
        ]
        none = [("head motion", "none: the parameters' global pose is left out")]
        rows = [
            ("read", f"{self.frames} frames at {self.frame_rate:g} frames/s, {self.seconds:.2f} s"),
            *(head if self.has_head_motion else none),
            ("stable vertices", stable),
            ("scale", f"{self.scale:.6g} (measured {self.measured_scale:.6g})"),
            ("topology", f"residual {self.topology_residual:.3f} of the face's size"),
            ("template", self.template_source),
            (
                "sound and motion",
                f"sound is {abs(self.mismatch):.2f} s {'longer' if self.mismatch >= 0 else 'shorter'}",
            ),
            ("written", f"{clips} ({splits}), {self.frames_written} frames at {self.corpus_frame_rate:g}/s"),
        ]
        return [
            *(f"{title:<21}{text}" for title, text in rows),
            *(f"warning: {warning}" for warning in self.warnings),
        ]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def write_entry_manifest(
    folder: Path, name: str, clips: Sequence[EntryClip], fields: Mapping[str, object], report: Mapping[str, object]
) -> None:
    """Write the table of an entry's clips and, when all other files are there, its manifest."""
    rows = [
        {"clip": clip.name, "subject": name, "sentence": clip.name.rpartition("_")[2], "split": clip.split}
        for clip in clips
    ]
    write_rows(folder / "clips.csv", rows, line_end="\n")
    about = {"facediff": version(), "format": FORMAT, "corpus": "person", "person": name, **fields, "report": report}
    write_json(folder / MANIFEST, {**about, "files": describe_files(folder, workers=2)})
