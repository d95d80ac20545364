"""One video: its landmarks, times and sound as files, and the parts in which its face can be used."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.person.importer import MIN_SECONDS, read_entry_speech
from facediff.data.track.face import MILLIMETRES, PosedFaces, pose
from facediff.data.track.model import FaceModel, read_face_model
from facediff.data.track.options import TrackingOptions
from facediff.data.track.tracker import FaceTracker
from facediff.data.track.video import Picture, read_pictures
from facediff.errors import FaceDiffError
from facediff.utils.arrays import ArrayWriter, open_array, read_arrays
from facediff.utils.batch import FileTask
from facediff.utils.files import atomic
from facediff.utils.jobs import PerWorker

Array = npt.NDArray[np.float64]

LANDMARKS = 478
BLOCK = 256  # frames that are posed at a time
MOST_MISSED = 0.2  # share of frames without a face
MOST_TURNED, TURNED = 0.1, 35.0  # share of frames, degrees
OTHERS_SEEN = 0.2  # share of the checks that may show a second face
LONGEST_GAP = 0.2  # seconds that are interpolated
SCALE_JUMP, CENTRE_JUMP, SHAPE_JUMP = 0.06, 0.5, 2.5
"""Steps from frame to frame at which the video is cut: of the face's scale, of its centre in widths of a face, and of
the face without lips in millimetres, which is another person."""
FACE_WIDTH = 150.0  # millimetres
STILL_POINTS = (6, 168, 197, 195, 5, 4, 33, 133, 362, 263, 127, 356, 234, 454, 10, 151)
"""Points of the nose, the corners of the eyes and the outline above the mouth."""


def video_tracker(options: TrackingOptions) -> PerWorker[FileTask, list[Path]]:
    """What tracks a video and writes its files; each worker loads the model once."""
    return PerWorker(partial(_load, options))


def _load(options: TrackingOptions) -> Any:  # noqa: ANN401 - a partial
    return partial(_track, read_face_model(options.task), options)


def landmark_file(output: Path) -> Path:
    """The file of landmarks that belongs to a file of times, presence and sound."""
    return output.with_suffix(".npy")


def _track(model: FaceModel, options: TrackingOptions, task: FileTask) -> list[Path]:
    """Write the landmarks of a video, frame by frame, then times, presence, sound and counts."""
    speech = read_entry_speech(task.source)
    face = {None: "largest", "left": "1"}.get(options.face, options.face) or "largest"
    tracker = FaceTracker(model, face, options.min_face)
    times: list[float] = []
    presence: list[float] = []
    checks, crowds, repeated = 0, 0, 0
    last: Picture | None = None
    target = landmark_file(task.output)
    with atomic(target) as temporary, ArrayWriter(temporary, (LANDMARKS, 3)) as writer:
        for time, picture in read_pictures(task.source):
            if not times or time >= times[0] + checks:  # once a second
                checks, crowds = checks + 1, crowds + (len(tracker.faces(picture)) > 1)
            sample = picture[::8, ::8]
            repeated += last is not None and sample.shape == last.shape and np.array_equal(sample, last)
            last = sample
            landmarks, logit = tracker.landmarks(picture) or (np.full((LANDMARKS, 3), np.nan), math.nan)
            writer.write(landmarks[None])
            times.append(time)
            presence.append(logit)
    if options.face is None and crowds > OTHERS_SEEN * checks:
        raise FaceDiffError(
            f"{task.source}: shows several faces; say which with --face largest, left, or its number from the left"
        )
    with atomic(task.output) as temporary, temporary.open("wb") as stream:
        np.savez(stream, times=np.array(times), presence=np.array(presence), speech=speech, repeated=repeated)
    return [task.output, target]


@dataclass(frozen=True, eq=False)
class Recording:
    """A video that was tracked."""

    source: Path  # the video
    landmarks: npt.NDArray[np.float32]  # (T, 478, 3) in pixels, NaN where no face was seen; in a file
    times: Array  # (T,) seconds from the first frame
    presence: Array  # (T,) logit of a face, NaN where none was seen
    speech: npt.NDArray[np.float32]  # (S,) at 16 kHz, from the first frame on
    repeated: int  # frames that show the picture before them

    @classmethod
    def open(cls, task: FileTask) -> Recording:
        """The files of :func:`video_tracker`."""
        landmarks = open_array(landmark_file(task.output))
        arrays = read_arrays(task.output, ("times", "presence", "speech", "repeated"))
        times = arrays["times"] - arrays["times"][0] if len(landmarks) else arrays["times"]
        return cls(task.source, landmarks, times, arrays["presence"], arrays["speech"], int(arrays["repeated"]))

    @property
    def frame_rate(self) -> float:
        """Frames a second, on average."""
        return (len(self.times) - 1) / max(float(self.times[-1]), 1e-6)

    @property
    def missed(self) -> int:
        """Frames without a face."""
        return int(np.isnan(self.presence).sum())

    def posed(self, model: FaceModel) -> Iterator[PosedFaces]:
        """The faces laid onto the canonical face, in blocks of frames."""
        for first in range(0, len(self.landmarks), BLOCK):
            yield pose(self.landmarks[first : first + BLOCK], MILLIMETRES * model.canonical, model.weights)


@dataclass(frozen=True, eq=False)
class RecordingSummary:
    """Measures of all frames of a recording."""

    parts: list[tuple[int, int]]  # first frame, and frame after the last, of the parts without cuts and long gaps
    face_pixels: float  # median width of the face
    sample: npt.NDArray[np.float32]  # (N, 478, 3) landmarks of frames evenly spread over the parts


def summarise(recording: Recording, model: FaceModel, sample_size: int) -> RecordingSummary:
    """Find the usable parts of a recording; a video that cannot be used is refused."""
    count, source = len(recording.times), recording.source
    if count < 2 or recording.missed > MOST_MISSED * count:
        raise FaceDiffError(
            f"{source}: shows no face in {recording.missed} of {count} frames; expected a face in at least 80 % of "
            f"them, of at least 50 pixels (--min-face of data track), seen from the front"
        )
    blocks = list(recording.posed(model))
    scales, centres, angles = (
        np.concatenate([getattr(block, name) for block in blocks]) for name in ("scales", "centres", "angles")
    )
    turned = np.nanmean(np.abs(angles[:, :2]).max(axis=1) > TURNED)
    still = np.concatenate([block.faces[:, STILL_POINTS] for block in blocks])
    frames = np.flatnonzero(np.isfinite(scales))
    steps = np.diff(frames)
    widths = FACE_WIDTH * scales[frames]
    with np.errstate(invalid="ignore"):
        breaks = (
            (np.diff(recording.times[frames]) > LONGEST_GAP + 1 / recording.frame_rate)
            | (np.abs(np.diff(np.log(scales[frames]))) > SCALE_JUMP * steps)
            | (np.linalg.norm(np.diff(centres[frames], axis=0), axis=1) > CENTRE_JUMP * widths[1:] * steps)
            | (np.sqrt(np.square(np.diff(still[frames], axis=0)).sum(-1).mean(-1)) > SHAPE_JUMP * steps)
        )
    starts = [0, *(np.flatnonzero(breaks) + 1)]
    parts = [(int(frames[a]), int(frames[b - 1]) + 1) for a, b in zip(starts, [*starts[1:], len(frames)], strict=True)]
    parts = [(a, b) for a, b in parts if recording.times[b - 1] - recording.times[a] >= MIN_SECONDS]
    if not parts or turned > MOST_TURNED:
        fault = f"has no {MIN_SECONDS:g} s of one face without a cut"
        if turned > MOST_TURNED:
            fault = f"the head is turned by more than {TURNED:g}° in {turned:.0%} of the frames"
        raise FaceDiffError(f"{source}: {fault}; expected a person who speaks towards the camera")
    usable = np.concatenate([frames[(frames >= a) & (frames < b)] for a, b in parts])
    picks = usable[np.linspace(0, len(usable) - 1, min(sample_size, len(usable))).astype(int)]
    return RecordingSummary(parts, float(np.median(widths)), np.asarray(recording.landmarks[picks]))
