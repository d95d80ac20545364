"""Videos of a face that is coded in the pictures' brightness, and a tracker that reads it: no model is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from scipy.spatial import Delaunay

from facediff.data.track import corpus, recording
from facediff.data.track.model import POINTS, FaceModel
from facediff.data.track.topology import EYE_CORNERS, EYELID_PAIRS, INNER_LIPS, IRIS, LEFT_LIDS, LIP_PAIRS, RIGHT_LIDS
from facediff.data.track.tracker import Face

BLOCK = 16
RATE = 25


@dataclass(frozen=True)
class Look:
    """The face of a picture: gap of the lips and scale from 0 to 1, yaw in degrees, and how many faces there are."""

    gap: float = 0.0
    scale: float = 0.5
    yaw: float = 0.0
    faces: int = 1

    def picture(self) -> np.ndarray:
        """(16, 64, 3), a block of one brightness for each number."""
        values = (self.gap, self.scale, self.yaw / 90 + 0.5, self.faces / 4)
        row = np.repeat([16 + round(220 * value) for value in values], BLOCK).astype(np.uint8)
        return np.broadcast_to(row[None, :, None], (BLOCK, 4 * BLOCK, 3)).copy()

    @classmethod
    def of(cls, picture: np.ndarray) -> Look:
        """What a picture that was compressed shows."""
        values = (picture[4:12].mean(axis=(0, 2)).reshape(4, BLOCK)[:, 4:12].mean(axis=1) - 16) / 220
        return cls(
            float(values[0].clip(0)), float(values[1]), float((values[2] - 0.5) * 90), round(float(values[3]) * 4)
        )


def canonical_face() -> np.ndarray:
    """468 points in centimetres with mouth and eyes where their numbers say."""
    random = np.random.default_rng(1)
    x, y = random.uniform(-7, 7, POINTS), random.uniform(-8, 8, POINTS)
    points = np.stack([x, y, 5 - 0.08 * (x**2 + y**2)], axis=1)

    def ring(numbers: Sequence[int], centre: tuple[float, float], width: float, height: float) -> None:
        angles = np.linspace(np.pi, -np.pi, len(numbers), endpoint=False)
        points[list(numbers), 0] = centre[0] + width * np.cos(angles)
        points[list(numbers), 1] = centre[1] + height * np.sin(angles)
        points[list(numbers), 2] = 4

    ring(INNER_LIPS, (0, -4), 2.4, 0)
    ring(RIGHT_LIDS, (-3.2, 3), 1.4, 0.5)
    ring(LEFT_LIDS, (3.2, 3), -1.4, 0.5)
    return points


def face_model() -> FaceModel:
    """A stand-in for the file that users download."""
    points = canonical_face()
    weights = np.zeros(POINTS)
    weights[[*EYE_CORNERS["right"], *EYE_CORNERS["left"], 1, 4, 6, 168, 10]] = 0.1
    triangles = Delaunay(points[:, :2]).simplices.astype(np.int64)
    return FaceModel(b"", b"", points, triangles, weights, "0" * 64)


class CodedTracker:
    """Landmarks in pixels of the face that a picture codes."""

    def __init__(self, model: FaceModel, face: str = "largest", smallest: float = 50.0) -> None:
        self.points = model.canonical

    def faces(self, picture: np.ndarray) -> list[Face]:
        """As many as the picture codes."""
        return [Face(np.array([0.0, 0, 60, 60]), np.zeros((2, 2)), 0.9)] * Look.of(picture).faces

    def landmarks(self, picture: np.ndarray) -> tuple[np.ndarray, float] | None:
        """Points of the face; none where there is no face."""
        look = Look.of(picture)
        if not look.faces:
            return None
        face = self.points.copy()
        for upper, lower in LIP_PAIRS:
            face[upper, 1] += look.gap / 2
            face[lower, 1] -= look.gap / 2
        irises = [face[list(EYE_CORNERS[side])].mean(axis=0) for side in IRIS for _ in range(5)]
        rims = np.tile([[0, 0, 0], [0.6, 0, 0], [0, 0.6, 0], [-0.6, 0, 0], [0, -0.6, 0]], (2, 1))
        face = np.concatenate([face, irises + rims])
        angle = np.radians(look.yaw)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        return (face @ turn.T * (1, -1, -1)) * 20 * look.scale + (300, 200, 0), 15.0


def use_coded_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Track such pictures instead of faces."""
    monkeypatch.setattr(recording, "FaceTracker", CodedTracker)
    for module in (corpus, recording):
        monkeypatch.setattr(module, "read_face_model", lambda path: face_model())


def talking(seconds: float, *, seed: int = 0, rate: float = RATE, **look: float) -> list[Look]:
    """A mouth that opens and closes."""
    times = np.arange(round(seconds * rate)) / rate
    gaps = np.clip(np.sin(2 * np.pi * 1.5 * times + seed) + 0.3 * np.sin(2 * np.pi * 0.4 * times), 0, 1) * 0.9
    return [Look(float(gap), **look) for gap in gaps]  # type: ignore[arg-type]


def babble(seconds: float, seed: int = 0) -> np.ndarray:
    """Sound (S,) at 16 kHz with pauses."""
    times = np.arange(round(seconds * 16_000)) / 16_000
    noise = np.random.default_rng(seed).normal(0, 0.1, len(times))
    return (noise * (np.sin(2 * np.pi * 0.7 * times) > -0.6)).astype(np.float32)


def write_coded_video(
    path: Path,
    pictures: Sequence[np.ndarray],
    *,
    times: Sequence[float] | None = None,
    sound: np.ndarray | None = None,
    sound_start: float = 0.0,
    audible: bool = True,
    hole: tuple[float, float] | None = None,
) -> Path:
    """A video with pictures at any times, and sound that may begin later.

    Args:
        path: the file.
        pictures: of the frames.
        times: of the frames, in seconds; 25 a second if None.
        sound: (S,) at 16 kHz; some noise if None.
        sound_start: time at which it begins.
        audible: whether there is a sound track.
        hole: seconds between which the sound's packets were lost.
    """
    times = np.arange(len(pictures)) / RATE if times is None else times
    sound = babble(float(times[-1]) + 1 / RATE) if sound is None else sound
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=1000, options={"crf": "4", "preset": "ultrafast"})
        video.height, video.width = pictures[0].shape[:2]
        video.time_base = video.codec_context.time_base = Fraction(1, 1000)
        audio = container.add_stream("aac", rate=16_000, layout="mono") if audible else None
        for time, picture in zip(times, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = round(1000 * time), Fraction(1, 1000)
            container.mux(video.encode(frame))
        container.mux(video.encode())
        if audio is not None:
            for first in range(0, len(sound), 1024):
                chunk = av.AudioFrame.from_ndarray(sound[None, first : first + 1024], format="fltp", layout="mono")
                chunk.sample_rate, chunk.time_base = 16_000, Fraction(1, 16_000)
                chunk.pts = round(16_000 * sound_start) + first
                if hole is not None and hole[0] <= first / 16_000 <= hole[1]:
                    continue
                container.mux(audio.encode(chunk))
            container.mux(audio.encode())
    return path


def write_people(root: Path, videos: dict[str, list[list[Look]]]) -> Path:
    """Folders of videos by person."""
    for name, films in videos.items():
        (root / name).mkdir(parents=True)
        for number, looks in enumerate(films):
            write_coded_video(root / name / f"film{number}.mp4", [look.picture() for look in looks])
    return root


__all__ = ["EYELID_PAIRS", "CodedTracker", "Look", "babble", "talking", "use_coded_faces", "write_coded_video"]
