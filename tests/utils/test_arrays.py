"""Arrays on disk: plain ones come back, damaged files and objects are refused by name, and nothing of a file runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.arrays import open_array, read_arrays
from tests.fakes.hostile import Harm


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype="f4").reshape(2, 3)),
        np.arange(6, dtype=">f8").reshape(2, 3),
        np.array(3.5, np.float16),
        np.zeros((0, 3), np.float32),
        np.array("text ü"),
        np.array([1 + 2j]),
        np.array([True]),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}",
)
def test_plain_arrays_come_back(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", array=array)
    np.savez_compressed(tmp_path / "b.npz", array=array)
    for found in (open_array(tmp_path / "a.npy"), *(read_arrays(tmp_path / f"{n}.npz")["array"] for n in "ab")):
        assert (found.dtype, found.shape) == (array.dtype, array.shape)
        assert np.array_equal(found, array)


def test_damaged_files_and_objects_are_refused_by_name_and_nothing_runs(tmp_path: Path) -> None:
    harm = Harm(tmp_path / "harm")
    np.save(tmp_path / "objects.npy", np.array([harm], dtype=object))
    np.savez(tmp_path / "objects.npz", array=np.array([harm], dtype=object))
    np.save(tmp_path / "a.npy", np.arange(100.0))
    np.savez_compressed(tmp_path / "a.npz", array=np.arange(100.0))
    for path in (tmp_path / "a.npy", tmp_path / "a.npz"):
        content = path.read_bytes()
        path.with_stem("cut").write_bytes(content[: len(content) * 2 // 3])
    flipped = bytearray((tmp_path / "a.npz").read_bytes())
    flipped[len(flipped) // 2] ^= 1
    (tmp_path / "flipped.npz").write_bytes(flipped)
    (tmp_path / "empty.npy").write_bytes(b"")
    for path in [tmp_path / "missing.npz", *tmp_path.glob("[!a]*.np?")]:
        read = open_array if path.suffix == ".npy" else read_arrays
        with pytest.raises(FaceDiffError, match=path.name) as refused:
            read(path)
        assert "\n" not in str(refused.value)
    assert not harm.path.exists()


def test_only_the_arrays_that_are_asked_for_are_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", vertices=np.zeros(3), other=np.array([None]))
    assert list(read_arrays(tmp_path / "a.npz", {"vertices"})) == ["vertices"]
