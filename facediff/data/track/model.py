"""Google's face landmarker: the file that users download, its networks in ONNX Runtime, and its canonical face."""

from __future__ import annotations

import hashlib
import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.track.options import VARIABLE
from facediff.data.track.tflite import Converter
from facediff.errors import FaceDiffError
from facediff.utils.protobuf import parts, whole_number

Array = npt.NDArray[np.float64]

URL = "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/float16/1/face_landmarker.task"
SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
LICENCE = "Apache-2.0"
POINTS = 468
"""Vertices of the canonical face; five points of each iris follow them in the landmarks."""
OBTAIN = (
    f"download {URL} (3.8 MB, Apache-2.0, SHA-256 {SHA256}) and give it as --model, or in the environment variable "
    f"{VARIABLE}"
)
DETECTOR, LANDMARKER = "face_detector.tflite", "face_landmarks_detector.tflite"
GEOMETRY = "geometry_pipeline_metadata_landmarks.binarypb"
SHAPES: dict[str, list[tuple[int, ...]]] = {
    DETECTOR: [(1, 128, 128, 3), (1, 896, 16), (1, 896, 1)],
    LANDMARKER: [(1, 256, 256, 3), (1, 1, 1, 1434), (1, 1, 1, 1), (1, 1)],
}
"""Of the image and the outputs of the networks."""


@dataclass(frozen=True)
class FaceModel:
    """The content of the file."""

    # graph of the face detector: image (1, 128, 128, 3) in −1 … 1; boxes (1, 896, 16), logits (1, 896, 1)
    detector: bytes
    landmarker: bytes  # graph of the landmarks: image (1, 256, 256, 3) in 0 … 1; 478 points, logit of a face's presence
    canonical: Array  # (468, 3) canonical face in cm, y up, z to the viewer
    triangles: npt.NDArray[np.int64]  # (898, 3) of the canonical face
    weights: Array  # (468,) weights of the points by which a head's pose is found; most are 0
    digest: str  # SHA-256 of the file


def read_face_model(path: Path | None) -> FaceModel:
    """Read ``face_landmarker.task``."""
    if path is None or not path.is_file():
        raise FaceDiffError(f"{path or '--model'}: no face model; {OBTAIN}")
    try:
        with zipfile.ZipFile(path) as archive:
            detector, landmarker = (network(archive, name) for name in SHAPES)
            canonical, triangles, weights = read_geometry(archive.read(GEOMETRY))
    except (zipfile.BadZipFile, LookupError, ValueError, StopIteration, struct.error) as error:
        raise FaceDiffError(f"{path}: is not the face landmarker that was expected ({error}); {OBTAIN}") from error
    return FaceModel(detector, landmarker, canonical, triangles, weights, hashlib.sha256(path.read_bytes()).hexdigest())


def network(archive: zipfile.ZipFile, name: str) -> bytes:
    """The graph of a network of the file."""
    converter = Converter(archive.read(name))
    if converter.shapes_of_ends != SHAPES[name]:
        raise ValueError(f"{name}: image and outputs of {converter.shapes_of_ends}")
    return converter.convert()


def session(graph: bytes) -> Any:  # noqa: ANN401 - ONNX Runtime has no types
    """A graph in ONNX Runtime, on one thread: videos are tracked side by side."""
    import onnxruntime  # type: ignore[import-untyped]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])


def read_geometry(data: bytes) -> tuple[Array, npt.NDArray[np.int64], Array]:
    """Canonical face, triangles and weights of the pose, from MediaPipe's ``GeometryPipelineMetadata``."""
    geometry = list(parts(data))
    mesh = list(parts(next(content for number, content in geometry if number == 1)))
    corners = b"".join(content for number, content in mesh if number == 3)  # x, y, z and two texture coordinates each
    indices = np.array([whole_number(content) for number, content in mesh if number == 4])
    weights = np.zeros(POINTS)
    for point in (dict(parts(content)) for number, content in geometry if number == 2):
        weights[whole_number(point[1])] = struct.unpack("<f", point[2])[0]
    canonical = np.frombuffer(corners, "<f4").reshape(POINTS, 5)[:, :3].astype(np.float64)
    return canonical, indices.reshape(-1, 3), weights
