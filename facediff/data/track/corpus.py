"""From videos of people to a corpus: track them, cut them into clips, and write motion, speech and what goes with them.

Tracks are kept in a hidden folder of the corpus, so that a run that was stopped goes on, and further people can be
added to a corpus that is there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import read_clip_table, read_manifest, read_templates
from facediff.data.manifest import FORMAT
from facediff.data.person.fitting import loudness, neutral_frames
from facediff.data.person.importer import NAME, cut_points, splits
from facediff.data.preparation import MANIFEST, version, write_clip, write_mesh, write_templates
from facediff.data.track.face import (
    MILLIMETRES,
    filled,
    horizontal_gaze,
    iris_width,
    median_face,
    pair_distances,
    pose,
    resampled,
    smooth_by_region,
    smooth_soft,
)
from facediff.data.track.model import LICENCE, POINTS, SHA256, FaceModel, read_face_model
from facediff.data.track.options import TrackingOptions
from facediff.data.track.recording import Recording, RecordingSummary, summarise, video_tracker
from facediff.data.track.topology import BROWS, EYELID_PAIRS, LIP_PAIRS, LIPS, UPPER_FACE, without_webs
from facediff.errors import FaceDiffError, counted, note, refuse_idle
from facediff.speech.audio import SAMPLE_RATE, VIDEOS, fit_length, samples_for
from facediff.utils.arrays import open_array
from facediff.utils.batch import FileTask, Recipe, begin_folder, run_batch
from facediff.utils.checksums import describe_files
from facediff.utils.files import atomic, locked
from facediff.utils.licences import KNOWN, Licence, commercial_use, read_licences
from facediff.utils.plain_files import write_json, write_rows

Array = npt.NDArray[np.float64]

CORPUS = "people"
MESH = "people.ply"
STATE, LOCK, TRACKS = "track.json", ".track.lock", ".tracks"
METRES = 1e-3  # to a millimetre
CLOSED = 1e-3  # metres between lips that count as closed
CONTEXT = 32  # frames on either side of a clip that its smoothing sees
SAMPLE = 600  # frames of a person of which the median face is made
IRIS = 11.7  # millimetres that people's irises measure
SMALL_FACE, SLOW, REPEATED, OPEN, NOISY_BROWS = 80, 24, 0.05, 0.9, 1.4
"""Limits of warnings: pixels, frames a second, share of pictures, share of frames, difference ratio."""
CHANNELS = ("head_npy", "gaze_npy", "confidence_npy")


@dataclass(frozen=True)
class PersonReport:
    """What became of a person's videos."""

    name: str
    clips: int
    seconds: float
    splits: dict[str, int]
    iris: float  # millimetres
    neutral_gap: float  # millimetres between the lips of the neutral face
    warnings: tuple[str, ...]

    def line(self) -> str:
        """The report in a line."""
        parts = ", ".join(f"{count} {split}" for split, count in self.splits.items())
        parts = parts if self.clips > 1 else "in no split; more video gives more clips"
        return (
            f"{self.name}: {counted(self.clips, 'clip')} ({parts}), {self.seconds / 60:.1f} min; irises measure "
            f"{self.iris:.1f} mm, lips of the neutral face are {self.neutral_gap:.1f} mm apart"
        )


@dataclass(frozen=True)
class TrackingReport:
    """The clips that were written, and the videos that could not be used, with the reasons."""

    people: tuple[PersonReport, ...]
    failed: dict[str, str]
    first: Recording  # the first video that was used
    digest: str  # SHA-256 of the face model

    @property
    def warnings(self) -> list[str]:
        """Faults of the videos and the model, a sentence each."""
        version = f"the face model has SHA-256 {self.digest}; the limits of tracking were measured with {SHA256}"
        people = [f"{person.name}: {text}" for person in self.people for text in person.warnings]
        return [*([] if self.digest == SHA256 else [version]), *people]

    def lines(self) -> list[str]:
        """The report, a line each."""
        return [
            *(person.line() for person in self.people),
            *(f"warning: {text}" for text in self.warnings),
            *(f"not used: {problem}" for problem in self.failed.values()),
        ]


def find_videos(source: Path, name: str | None) -> dict[str, list[Path]]:
    """Videos by person: of a file or a folder of one person, or of a folder with a folder for each."""
    if source.is_file():
        videos = {name or source.stem: [source]}
    else:
        folders = sorted(path for path in source.iterdir() if path.is_dir() and not path.name.startswith("."))
        direct = videos_in(source)
        videos = {name or source.resolve().name: direct} if direct else {path.name: videos_in(path) for path in folders}
        refuse_idle(f"{source} has a folder for each person, whose names are theirs", name=bool(name and not direct))
        videos = {person: files for person, files in videos.items() if files and not (direct and folders)}
    for person in videos:
        if not NAME.fullmatch(person):
            raise FaceDiffError(
                f"{source}: {person!r} cannot be a person's name; expected letters, digits and dashes: give --name, or "
                f"rename the folder"
            )
    if not videos:
        raise FaceDiffError(
            f"{source}: holds no videos ({', '.join(VIDEOS)}), or folders beside them; expected one person's videos, "
            f"or a folder each"
        )
    return videos


def videos_in(folder: Path) -> list[Path]:
    """Videos of a folder by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEOS and not p.name.startswith("."))


def track_people(
    videos: Mapping[str, Sequence[Path]],
    out: Path,
    options: TrackingOptions,
    *,
    workers: int | None = None,
    scheduler: str | None = "",
    progress: bool = False,
) -> TrackingReport:
    """Track people's videos, and write them as a corpus or add them to one.

    Args:
        videos: of each person.
        out: folder to make, to continue or to add to.
        options: how faces are tracked.
        workers: videos at a time.
        scheduler: where; see :func:`facediff.utils.jobs.run_tasks`.
        progress: whether to show a progress bar.
    """
    model = read_face_model(options.task)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out / LOCK, "facediff data track"):
        recipe = {"corpus": CORPUS, "model": model.digest, **options.settings}
        manifest = read_manifest(out)
        begin_folder(out, STATE, recipe, "facediff data track", manifest.get("options") if manifest else None)
        tasks = tracking_tasks(videos, out / TRACKS, model, options)
        changes = [(task, task.change()) for task in chain.from_iterable(tasks.values())]
        pending = [task for task, change in changes if change or not task.output.exists()]
        for task, change in changes:
            if change and task.output.exists():
                note(f"{task.source}: replaces the clips of {task.source.name}, since {change}")
        execution: dict[str, Any] = {"workers": workers, "scheduler": scheduler, "writes": out}
        title = "tracking" if progress else ""
        failed: dict[str, str] = {}
        with closing(
            run_batch(video_tracker(options), pending, record=FileTask.record, progress=title, **execution)
        ) as outcomes:
            failed |= {str(task): outcome.problem for task, outcome in outcomes if outcome.problem}
        writer = PeopleWriter(out, model, options)
        reports = [
            report
            for name, person in tasks.items()
            if (report := writer.add(name, [task for task in person if str(task) not in failed], failed))
        ]
        if not reports:
            raise FaceDiffError(next(iter(failed.values())))
        writer.finish({**manifest.get("people", {}), **{report.name: asdict(report) for report in reports}}, recipe)
        (out / STATE).unlink()
    return TrackingReport(tuple(reports), failed, writer.recordings[0], model.digest)


def import_video(video: Path, name: str, corpus: Path, out: Path, clip_seconds: float) -> TrackingReport:
    """Track a person's video as an entry that any data module takes next to the people of a corpus.

    Args:
        video: the video.
        name: the person's name.
        corpus: corpus of people, whose settings are used.
        out: folder to make.
        clip_seconds: approximate length of a clip.
    """
    facts = read_manifest(corpus)
    if facts.get("corpus") != CORPUS:
        raise FaceDiffError(f"{corpus}: is no corpus of `facediff data track`, which videos need; give meshes")
    settings = {
        key.removeprefix("--").replace("-", "_"): value for key, value in facts["options"].items() if "--" in key
    }
    options = TrackingOptions(**{**settings, "clip_seconds": clip_seconds})
    report = track_people(find_videos(video, name), out, options)
    write_json(out / MANIFEST, {**read_manifest(out), "corpus": "person", "person": name})
    return report


def tracking_tasks(
    videos: Mapping[str, Sequence[Path]], tracks: Path, model: FaceModel, options: TrackingOptions
) -> dict[str, list[FileTask]]:
    """A task for each video, with its output in a hidden folder."""
    recipe = Recipe(("track", str(options.face), str(options.min_face)), {"model": model.digest})
    return {
        name: [FileTask(path, tracks / name / f"{path.name}.npz", recipe) for path in files]
        for name, files in videos.items()
    }


@dataclass(frozen=True, eq=False)
class WrittenClip:
    """A clip on disk: its row of ``clips.csv``, and series (T,) by which a neutral face and warnings are found."""

    row: dict[str, Any]
    gaps: Array  # between the lips, in metres
    loud: Array  # loudness of the speech
    speed: Array  # of the face, in metres a frame
    difference_ratio: float  # of the brows


class PeopleWriter:
    """Writes people into a corpus.

    Args:
        out: folder of the corpus.
        model: that the videos were tracked with.
        options: how.
    """

    def __init__(self, out: Path, model: FaceModel, options: TrackingOptions) -> None:
        self.out, self.model, self.options = out, model, options
        self.triangles = without_webs(model.triangles)
        self.recordings: list[Recording] = []
        self.rows = {name: {"clip": name, **row} for name, row in read_clip_table(out).items()}
        templates = out / "templates.pkl"
        self.templates = (
            {name: face.numpy() for name, face in read_templates(templates).items()} if templates.exists() else {}
        )

    def add(self, name: str, tasks: Sequence[FileTask], failed: dict[str, str]) -> PersonReport | None:
        """Write the clips of a person, in place of those that were there; None if no video can be used.

        Args:
            name: the person's name.
            tasks: the outputs are the person's tracks.
            failed: reasons by video; what cannot be used is added.
        """
        recordings: list[tuple[Recording, RecordingSummary]] = []
        for task in tasks:
            recording = Recording.open(task)
            try:
                summary = summarise(recording, self.model, max(8, SAMPLE // len(tasks)))
                recordings.append((recording, summary))
            except FaceDiffError as error:
                failed[str(task)] = str(error)
        if not recordings:
            return None
        self.recordings += [recording for recording, _ in recordings]
        sample = np.concatenate([summary.sample for _, summary in recordings])
        target = median_face(sample, self.model)
        iris = iris_width(pose(sample, target, self.model.weights).faces)
        scale = METRES * (IRIS / iris if self.options.scale == "iris" else 1.0)
        before = {row["source"] for row in self.rows.values() if row["subject"] == name}
        self._remove(name)
        clips: list[WrittenClip] = []
        for recording, summary in recordings:
            for part in summary.parts:
                for frames in self._cuts(recording, *part):
                    clip_name = f"{name}_s{len(clips) + 1:03d}"
                    clips.append(self._write(clip_name, recording, summary, part, frames, target, scale))
        for clip, split in zip(clips, splits(len(clips)), strict=True):
            clip.row["split"] = split
            self.rows[clip.row["clip"]] = clip.row
        self.templates[name] = self._neutral(clips)
        gaps = np.concatenate([clip.gaps for clip in clips])
        gone = sorted(before - {clip.row["source"] for clip in clips})
        return PersonReport(
            name=name,
            clips=len(clips),
            seconds=len(gaps) / self.options.frame_rate,
            splits=dict(Counter(clip.row["split"] for clip in clips)),
            iris=iris,
            neutral_gap=float(pair_distances(self.templates[name][None])[0]) / METRES,
            warnings=(*warnings(recordings, clips), *(f"the clips of {video} are replaced" for video in gone)),
        )

    def _remove(self, name: str) -> None:
        """Remove the clips of an earlier run."""
        for clip in [clip for clip, row in self.rows.items() if row["subject"] == name]:
            del self.rows[clip]
        for folder, suffix in (("wav", "wav"), ("vertices_npy", "npy"), *((folder, "npy") for folder in CHANNELS)):
            for file in (self.out / folder).glob(f"{name}_s*.{suffix}"):
                file.unlink()

    def _cuts(self, recording: Recording, first: int, stop: int) -> Iterator[tuple[int, int]]:
        """First frame, and frame after the last, of the clips of a part, cut where speech is quiet."""
        rate, times = self.options.frame_rate, recording.times
        start, end = (round(float(times[frame]) * SAMPLE_RATE) for frame in (first, stop - 1))
        frames = max(1, int((times[stop - 1] - times[first]) * rate))
        loud = loudness(fit_length(recording.speech[start:], end - start), frames, rate)
        for cut in cut_points(loud, self.options.clip_seconds * rate):
            low, high = (int(np.searchsorted(times, times[first] + frame / rate - 1e-6)) for frame in cut)
            yield low, stop if cut[1] == frames else high

    def _write(
        self,
        clip: str,
        recording: Recording,
        summary: RecordingSummary,
        part: tuple[int, int],
        frames: tuple[int, int],
        target: Array,
        scale: float,
    ) -> WrittenClip:
        """Write a clip's motion, speech and channels."""
        first, stop = frames
        rate = self.options.frame_rate
        context = slice(max(part[0], first - CONTEXT), min(part[1], stop + CONTEXT))
        times, presence = recording.times[context], recording.presence[context]
        posed = pose(recording.landmarks[context], target, self.model.weights)
        faces = resampled(filled(posed.faces, times), times, rate)
        angles = resampled(filled(posed.angles, times), times, rate)
        if self.options.smoothing == "region":
            faces, angles = smooth_by_region(faces, rate, self.model.triangles), smooth_soft(angles, rate)
        grid = times[0] + np.arange(len(faces)) / rate
        inside = (grid >= recording.times[first] - 1e-6) & (grid <= recording.times[stop - 1] + 1e-6)
        faces, angles, grid = faces[inside], angles[inside], grid[inside]
        confidence = presence[np.interp(grid, times, np.arange(len(times))).round().astype(int)]
        gaze = np.stack([horizontal_gaze(faces), np.zeros(len(faces))], axis=1)
        vertices = scale * faces[:, :POINTS]
        speech = recording.speech[round(grid[0] * SAMPLE_RATE) :]
        speech = fit_length(speech, samples_for(len(faces), rate))
        write_clip(self.out, clip, vertices, speech)
        for folder, values in zip(CHANNELS, (angles, gaze, confidence), strict=True):
            with atomic(self.out / folder / f"{clip}.npy") as temporary:
                np.save(temporary, values.astype(np.float32))
        steps = np.linalg.norm(np.diff(vertices, axis=0, prepend=vertices[:1]), axis=-1).mean(axis=-1)
        row = {
            "clip": clip,
            "subject": clip.rpartition("_")[0],
            "sentence": clip.rpartition("_")[2],
            "split": "",
            "source": recording.source.name,
            "start": f"{grid[0]:.3f}",
            "face_pixels": round(summary.face_pixels),
            "missed": int(np.isnan(recording.presence[first:stop]).sum()),
        }
        loud = loudness(speech, len(faces), rate)
        brows = posed.faces[:, list(BROWS)]
        return WrittenClip(row, pair_distances(vertices), loud, steps, difference_ratio(brows))

    def _neutral(self, clips: Sequence[WrittenClip]) -> npt.NDArray[np.float32]:
        """The median of a person's frames with closed lips, (468, 3) in metres."""
        gaps, loud, speed = (
            np.concatenate([getattr(clip, name) for clip in clips]) for name in ("gaps", "loud", "speed")
        )
        frames = neutral_frames(loud, speed, gaps, CLOSED)
        starts = np.cumsum([0, *(len(clip.gaps) for clip in clips)])
        faces = []
        for frame in frames:
            number = int(np.searchsorted(starts, frame, side="right")) - 1
            motion = open_array(self.out / "vertices_npy" / f"{clips[number].row['clip']}.npy")
            faces.append(motion[frame - starts[number]].reshape(POINTS, 3))
        return np.asarray(np.median(faces, axis=0), np.float32)

    def finish(self, people: Mapping[str, Any], recipe: Mapping[str, Any]) -> None:
        """Write what all clips share, and the manifest."""
        write_templates(self.out / "templates.pkl", self.templates)
        write_mesh(self.out / MESH, METRES * MILLIMETRES * self.model.canonical, self.triangles)
        regions = {"lve": LIPS, "fdd": UPPER_FACE, "inner_lip_pairs": LIP_PAIRS, "eyelid_pairs": EYELID_PAIRS}
        for name, entries in regions.items():
            with atomic(self.out / "regions" / f"{name}.txt") as temporary:
                np.savetxt(temporary, np.asarray(entries), "%d")
        write_rows(self.out / "clips.csv", [self.rows[name] for name in sorted(self.rows)], line_end="\n")
        terms, frame_rate = self.options.licence, self.options.frame_rate
        commercial = "allowed" if self.options.commercial else KNOWN.get(terms.casefold(), "unknown")
        # People who were tracked before may have given other terms.
        stated = read_manifest(self.out).get("licence")
        labels = [*read_licences(self.out / MANIFEST, [stated] if stated else []), Licence("", terms, commercial)]
        terms = "; ".join(dict.fromkeys(term for label in labels for term in label.name.split("; ")))
        manifest = {
            "facediff": version(),
            "format": FORMAT,
            "corpus": CORPUS,
            "frame_rate": frame_rate,
            "n_vertices": POINTS,
            "unit": "m",
            "options": dict(recipe),
            "model": {"sha256": self.model.digest, "licence": LICENCE},
            "licence": Licence(f"corpus {CORPUS}", terms, commercial_use(labels)).state(),
            "people": dict(people),
        }
        names = [path.relative_to(self.out).as_posix() for path in self.out.rglob("[!.]*") if path.is_file()]
        names = [name for name in names if not name.startswith(".") and name not in (STATE, MANIFEST)]
        write_json(self.out / MANIFEST, {**manifest, "files": describe_files(self.out, names, workers=2)})


def difference_ratio(motion: Array) -> float:
    """Root mean square of second differences as a share of the first ones': 1.7 for noise, less for motion."""
    first = np.diff(motion, axis=0)
    scale = np.sqrt(np.nanmean(np.square(first)))
    return float(np.sqrt(np.nanmean(np.square(np.diff(first, axis=0)))) / max(scale, 1e-12))


def warnings(recordings: Sequence[tuple[Recording, RecordingSummary]], clips: Sequence[WrittenClip]) -> Iterator[str]:
    """Warnings about a person's videos."""
    for recording, summary in recordings:
        name = recording.source.name
        if summary.face_pixels < SMALL_FACE:
            yield f"{name}: the face is {summary.face_pixels:.0f} pixels wide; {SMALL_FACE} are exact: film nearer"
        if recording.frame_rate < SLOW:
            yield f"{name}: {recording.frame_rate:.1f} frames a second; below {SLOW}, closures of 60 ms are missed"
        if recording.repeated > REPEATED * len(recording.times):
            yield f"{name}: {recording.repeated} pictures are repeated; use the recording before it was converted"
    gaps = np.concatenate([clip.gaps for clip in clips])
    if np.mean(gaps > CLOSED) > OPEN:
        yield "the mouth is open in more than 90 % of the frames, and the neutral face perhaps; film closed lips too"
    ratio = float(np.median([clip.difference_ratio for clip in clips]))
    if ratio > NOISY_BROWS:
        yield f"the motion of the brows is mostly noise (difference ratio {ratio:.2f}); a larger, evenly lit face helps"
