"""Reading of safetensors: as the library reads, and never beyond what a file holds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import safetensors.torch
import torch

from facediff.errors import FaceDiffError
from facediff.utils.safetensors import read_safetensors, write_safetensors

TENSORS = {
    "weights": torch.randn(3, 5),
    "half": torch.randn(7).half(),
    "brain": torch.randn(2, 2).bfloat16(),
    "double": torch.randn(3).double(),
    "counts": torch.arange(4),
    "bytes": torch.arange(5, dtype=torch.uint8),
    "flags": torch.tensor([True, False, True]),
    "scalar": torch.tensor(2.5),
    "empty": torch.zeros(0, 4),
}


def file_of(path: Path, header: object, data: bytes = b"", *, length: int | None = None) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes((len(text) if length is None else length).to_bytes(8, "little") + text + data)
    return path


def test_tensors_are_those_that_the_library_reads(tmp_path: Path) -> None:
    write_safetensors(tmp_path / "own", TENSORS)
    safetensors.torch.save_file(TENSORS, tmp_path / "theirs")
    for name in ("own", "theirs"):
        ours, theirs = read_safetensors(tmp_path / name), safetensors.torch.load_file(tmp_path / name)
        assert ours.keys() == theirs.keys() == TENSORS.keys()
        for key, value in theirs.items():
            assert ours[key].dtype == value.dtype
            assert torch.equal(ours[key], value)


def test_numbers_at_odd_places_are_read(tmp_path: Path) -> None:
    header = {
        "a": {"dtype": "U8", "shape": [1], "data_offsets": [0, 1]},
        "b": {"dtype": "F32", "shape": [2], "data_offsets": [1, 9]},
    }
    path = file_of(tmp_path / "odd", header, b"\x07" + torch.tensor([1.5, -2.0]).numpy().tobytes())
    assert read_safetensors(path)["b"].tolist() == [1.5, -2.0]


def entry(**changes: object) -> dict[str, object]:
    return {"x": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8], **changes}}


@pytest.mark.parametrize(
    ("header", "length"),
    [
        (b"", None),
        (b"{}", 1 << 62),
        (b"{}", 3),
        (b"[1]", None),
        (b"{not json", None),
        (b'{"x": 1, "x": 2}', None),
        (b"[" * 5000, None),
        (entry(dtype="F128"), None),
        (entry(dtype="C64"), None),
        (entry(dtype=["F32"]), None),
        (entry(shape=[1 << 62]), None),
        (entry(shape=[-2]), None),
        (entry(shape="2"), None),
        (entry(shape=[2.0]), None),
        (entry(shape=[1] * 1000 + [2]), None),
        (entry(data_offsets=[0, 1 << 50]), None),
        (entry(data_offsets=[8, 0]), None),
        (entry(data_offsets=[0]), None),
        (entry(data_offsets=[4, 12]), None),
        (entry(shape=[3], data_offsets=[0, 12]), None),
        (entry(shape=[1], data_offsets=[0, 4]), None),
        ({**entry(), "y": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}}, None),
        ({"x": None}, None),
        ({"x": {}}, None),
    ],
)
def test_a_header_that_does_not_fit_its_file_is_refused(tmp_path: Path, header: object, length: int | None) -> None:
    path = file_of(tmp_path / "bad", header, b"\0" * 8, length=length)
    with pytest.raises(FaceDiffError, match="bad"):
        read_safetensors(path)


@pytest.mark.parametrize("kept", [0, 5, 8, 40, -1])
def test_a_file_that_is_cut_short_is_refused(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "short"
    write_safetensors(path, TENSORS)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(FaceDiffError, match="short"):
        read_safetensors(path)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match="nothing"):
        read_safetensors(tmp_path / "nothing")


def test_no_more_is_allocated_than_the_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from facediff.utils import safetensors as reader
    from facediff.utils.limits import Limits

    path = tmp_path / "large"
    write_safetensors(path, {"x": torch.zeros(1000)})
    monkeypatch.setattr(reader, "LIMITS", Limits(bytes=1000))
    with pytest.raises(FaceDiffError, match="FACEDIFF_MAX_BYTES"):
        read_safetensors(path)
