"""The file of the face model: it is read, or refused with its address and hash."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from facediff.data.track.model import DETECTOR, GEOMETRY, LANDMARKER, SHA256, SHAPES, URL, read_face_model
from facediff.errors import FaceDiffError
from tests.data.track.test_tflite import write_model


def network(shape: tuple[int, ...]) -> bytes:
    """One operation."""
    return write_model([(shape, None), (shape, None)], [("RELU", [0], 1, {})])


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (None, "no face model"),
        (b"a page of a server", "not a zip"),
        ({LANDMARKER: b""}, DETECTOR),
        ({DETECTOR: network((1, 64, 64, 3))}, rf"{DETECTOR}: image and outputs of \[\(1, 64, 64, 3\), "),
    ],
)
def test_other_files_are_refused(content: bytes | dict[str, bytes] | None, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "face.task"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in content.items():
                archive.writestr(name, data)
    with pytest.raises(FaceDiffError, match=problem) as error:
        read_face_model(path)
    assert URL in str(error.value)
    assert SHA256 in str(error.value)


def test_networks_of_the_sizes_and_a_face_are_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shape = (1, 4, 4, 3)
    for name in SHAPES:
        monkeypatch.setitem(SHAPES, name, [shape, shape])
    face = np.arange(468 * 5, dtype="<f4").tobytes()
    mesh = b"\x1a" + varint(len(face)) + face + b"".join(b"\x20" + bytes([corner]) for corner in (0, 1, 2))
    weight = b"\x08\x21\x15" + np.float32(0.5).tobytes()
    with zipfile.ZipFile(tmp_path / "face.task", "w") as archive:
        for name in (DETECTOR, LANDMARKER):
            archive.writestr(name, network(shape))
        archive.writestr(GEOMETRY, b"\x0a" + varint(len(mesh)) + mesh + b"\x12" + bytes([len(weight)]) + weight)
    model = read_face_model(tmp_path / "face.task")
    assert model.canonical[1].tolist() == [5, 6, 7]
    assert model.triangles.tolist() == [[0, 1, 2]]
    assert {point: model.weights[point] for point in np.flatnonzero(model.weights)} == {33: 0.5}
    assert len(model.digest) == 64


def varint(value: int) -> bytes:
    """A whole number of a protocol buffer."""
    return bytes([value & 127 | 128]) + varint(value >> 7) if value > 127 else bytes([value])
