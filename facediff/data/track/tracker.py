"""Landmarks of a face in the pictures of a video, as Google's face landmarker finds them.

The face is detected in the first picture, and again where it was lost; between, the landmarks of a picture give the
region in which the next picture's are sought.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.track.model import FaceModel, session
from facediff.errors import needs_extra

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.uint8]

DETECTOR_SIZE, LANDMARKER_SIZE = 128, 256  # pixels of the networks' images
MARGIN = 1.5  # side of the region round a face, in sides of its box
SCORE = 0.5  # least score of a detection
OVERLAP = 0.3  # two boxes that share more than this part of their union are one face
EYES = (33, 263)  # outer corners of the right and left eye


def anchor_centres() -> Array:
    """Centres of the detector's 896 anchors, (896, 2) in shares of the image."""
    grids = []
    for cells, count in ((16, 2), (8, 6)):
        places = (np.arange(cells) + 0.5) / cells
        grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
        grids.append(np.repeat(grid, count, axis=0))
    return np.concatenate(grids)


@dataclass(frozen=True)
class Face:
    """A face that was detected, in pixels of the picture."""

    box: Array  # left, top, right, bottom
    eyes: Array  # (2, 2) the right and the left eye
    score: float  # of the detector, 0 to 1

    @property
    def centre(self) -> Array:
        """Centre of the box, (2,)."""
        return (self.box[:2] + self.box[2:]) / 2

    @property
    def size(self) -> float:
        """The longer side of the box."""
        return float(max(self.box[2:] - self.box[:2]))

    def overlap(self, second: Face) -> float:
        """Intersection over union of the boxes."""
        sides = np.minimum(self.box[2:], second.box[2:]) - np.maximum(self.box[:2], second.box[:2])
        shared = float(np.prod(np.maximum(sides, 0)))
        areas = [float(np.prod(face.box[2:] - face.box[:2])) for face in (self, second)]
        return shared / (sum(areas) - shared)


@dataclass(frozen=True)
class Region:
    """A square of the picture, turned so that the eyes are level: centre (2,), side in pixels, angle in radians."""

    centre: Array
    side: float
    angle: float

    @classmethod
    def around(cls, points: Array, eyes: Array) -> Region:
        """The square round points (N, 2) in the axes of the line through the eyes (2, 2), with a margin."""
        angle = angle_of(eyes)
        turn = rotation(-angle)
        low, high = (end(points @ turn.T, axis=0) for end in (np.min, np.max))
        return cls(turn.T @ ((low + high) / 2), float(max(high - low)) * MARGIN, angle)

    def to_picture(self, points: Array) -> Array:
        """Points (N, 2 or 3) of the crop of LANDMARKER_SIZE² pixels in pixels of the picture; z is scaled alike."""
        scale = self.side / LANDMARKER_SIZE
        flat = (points[:, :2] - LANDMARKER_SIZE / 2) * scale @ rotation(self.angle).T + self.centre
        return np.concatenate([flat, points[:, 2:] * scale], axis=1)


def angle_of(eyes: Array) -> float:
    """Angle of the line from the right eye to the left eye, (2, 2)."""
    across = eyes[1] - eyes[0]
    return float(np.arctan2(across[1], across[0]))


def rotation(angle: float) -> Array:
    """A turn in the plane of the picture."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


class FaceTracker:
    """Finds the landmarks of one face, picture by picture.

    Args:
        model: the networks.
        face: which face to follow where several are found: ``largest``, or its number from the left, from 1.
        smallest: pixels of the smallest face.
    """

    def __init__(self, model: FaceModel, face: str = "largest", smallest: float = 50.0) -> None:
        with needs_extra("cv2", "render", "tracking faces"):
            import cv2
        self.cv2: Any = cv2
        self.detector, self.landmarker = session(model.detector), session(model.landmarker)
        self.face, self.smallest = face, smallest
        self.anchors = anchor_centres()
        self.region: Region | None = None

    def landmarks(self, picture: Picture) -> tuple[Array, float] | None:
        """Landmarks (478, 3) in pixels of a picture (H, W, 3), x to the right and y down, and the logit of a face.

        None where no face is seen.
        """
        if self.region is not None and (result := self._follow(picture, self.region)):
            return result
        face = chosen(self.faces(picture), self.face)
        if face is None:
            return None
        # The detector's region is rough: the landmarks in it give a better one.
        self._follow(picture, Region(face.centre, face.size * MARGIN, angle_of(face.eyes)))
        return None if self.region is None else self._follow(picture, self.region)

    def _follow(self, picture: Picture, region: Region) -> tuple[Array, float] | None:
        """The landmarks in a region, and the region for the next picture; None if it shows no face."""
        scale = region.side / LANDMARKER_SIZE
        turn = rotation(region.angle) * scale
        shift = region.centre - turn @ np.full(2, LANDMARKER_SIZE / 2)
        image = self._cut(picture, np.column_stack([turn, shift]), LANDMARKER_SIZE, self.cv2.BORDER_REPLICATE)
        points, presence, _ = self.landmarker.run(None, {"image": image[None] / np.float32(255)})
        landmarks = region.to_picture(points.reshape(-1, 3).astype(np.float64))
        if presence.item() <= 0:
            self.region = None
            return None
        self.region = Region.around(landmarks[:, :2], landmarks[list(EYES), :2])
        return landmarks, float(presence.item())

    def _cut(self, picture: Picture, to_picture: Array, size: int, border: int) -> npt.NDArray[np.float32]:
        """A square of ``size`` pixels of the picture, whose points ``to_picture`` (2, 3) takes to the picture's."""
        flags = self.cv2.INTER_LINEAR | self.cv2.WARP_INVERSE_MAP
        cut = self.cv2.warpAffine(picture, to_picture, (size, size), flags=flags, borderMode=border)
        return np.asarray(cut, np.float32)

    def faces(self, picture: Picture) -> list[Face]:
        """All faces of a picture: in the whole of it or, where it shows none, in smaller squares."""
        height, width = picture.shape[:2]
        sides = [max(height, width), min(height, width), min(height, width) / 2]
        for side in sides:
            corners = [(x, y) for y in steps(height, side) for x in steps(width, side)]
            detections = sorted(
                (face for corner in corners for face in self._detect(picture, corner, side)),
                key=lambda face: -face.score,
            )
            faces: list[Face] = []
            for face in detections:
                if face.size >= self.smallest and all(face.overlap(rival) <= OVERLAP for rival in faces):
                    faces.append(face)
            if faces:
                return faces
        return []

    def _detect(self, picture: Picture, corner: tuple[float, float], side: float) -> list[Face]:
        """Faces in a square of a picture."""
        scale = side / DETECTOR_SIZE
        to_picture = np.array([[scale, 0, corner[0]], [0, scale, corner[1]]])
        image = self._cut(picture, to_picture, DETECTOR_SIZE, self.cv2.BORDER_CONSTANT)
        boxes, logits = self.detector.run(None, {"image": image[None] / np.float32(127.5) - 1})
        scores = 1 / (1 + np.exp(-np.clip(logits[0, :, 0].astype(np.float64), -50, 50)))
        faces = []
        for number in np.flatnonzero(scores >= SCORE):
            values = boxes[0, number].astype(np.float64).reshape(-1, 2) / DETECTOR_SIZE
            values[[0, 2, 3]] += self.anchors[number]
            centre, size, *eyes = values[:4]
            corners = np.stack([centre - size / 2, centre + size / 2, *eyes]) * side + corner
            faces.append(Face(corners[:2].flatten(), corners[2:], float(scores[number])))
        return faces


def chosen(faces: Sequence[Face], face: str) -> Face | None:
    """The largest face, or the one of a number from the left; None if there is none."""
    if not face.isdecimal():
        return max(faces, key=lambda candidate: candidate.size, default=None)
    ordered = sorted(faces, key=lambda candidate: candidate.box[0])
    return ordered[int(face) - 1] if len(ordered) >= int(face) else None


def steps(length: float, side: float) -> list[float]:
    """Where overlapping squares of a side begin, so that they cover a length; in its middle if it is shorter."""
    if side >= length:
        return [(length - side) / 2]
    count = int(np.ceil((length - side) / (side / 2))) + 1
    return np.linspace(0, length - side, count).tolist()
