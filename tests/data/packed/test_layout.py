"""Packed corpora from elsewhere: damage is named, sizes are bounded, and nothing is run that a file asks for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from facediff.data.check import check
from facediff.data.packed.packing import pack
from facediff.data.packed.unpacking import unpack
from facediff.errors import FaceDiffError
from tests.data.packed.damage import RECORD, TINY, change, read_all
from tests.fakes.tiny import write_tiny


@pytest.fixture
def packed(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(sound, tmp_path / "corpus.zarr"))


@pytest.mark.parametrize(
    ("key", "field", "value"),
    [
        (RECORD, "format", "facediff packed corpus 2"),
        (RECORD, "n_vertices", 25),
        (RECORD, "step", "0.1"),
        (RECORD, "step", 0),
        (RECORD, "tolerance", 0),
        (RECORD, "tolerance", 0.02),
        (RECORD, "unit", "cm"),
        (RECORD, "frame_rate", 60),
        (RECORD, "identities", ["A", "B"]),
        (RECORD, "identities", ["A", "B", "D"]),
        (RECORD, "identities", ["../../evil", "A", "B"]),
        (f"{RECORD}.clips.0", "first", 1),
        (f"{RECORD}.clips.0", "frames", 10**5),
        (f"{RECORD}.clips.0", "coding", "object"),
        (f"{RECORD}.clips.0", "name", "../../evil"),
        (f"{RECORD}.clips.0", "identity", "D"),
        (f"{RECORD}.clips.0.sound", "pieces", [10**12]),
        (f"{RECORD}.clips.0.sound", "form", "/../../x"),
        (f"{RECORD}.clips.0.sound", "bits", 3),
        (f"{RECORD}.files.0", "path", "../evil"),
        (f"{RECORD}.files.0", "path", "/etc/evil"),
        (f"{RECORD}.files.0", "bytes", 10**12),
        (f"{RECORD}.files.0", "sha256", "0" * 64),
        (f"{RECORD}.arrays.motion_int16", "rows", 10**14),
        (f"{RECORD}.arrays.motion_int16", "chunk", 0),
        (f"{RECORD}.arrays.motion_int16", "shards", [2]),
        (f"{RECORD}.arrays.motion_int16", "dtype", "object"),
        (f"{RECORD}.arrays.motion_int16", "width", 10**9),
    ],
)
def test_a_record_is_not_believed(packed: Path, tmp_path: Path, key: str, field: str, value: object) -> None:
    change(packed, key, lambda place: place.__setitem__(field, value))
    with pytest.raises(FaceDiffError, match=r"corpus\.zarr") as caught:
        read_all(packed)
    assert str(caught.value).count(". ") <= 1
    assert not list(tmp_path.rglob("*evil*"))
    with pytest.raises(FaceDiffError):
        unpack(packed, tmp_path / "back", workers=1)
    assert not (tmp_path / "back").exists()


def test_lossless_motion_is_of_the_type_that_it_is_coded_as(tmp_path: Path) -> None:
    root = write_tiny(tmp_path / "corpus", sentences=1)
    pack(root, tmp_path / "corpus.zarr", corpus=TINY, lossless=True, workers=1)
    read_all(tmp_path / "corpus.zarr")
    change(tmp_path / "corpus.zarr", f"{RECORD}.clips.0", lambda place: place.__setitem__("dtype", "float64"))
    with pytest.raises(FaceDiffError, match="float64"):
        read_all(tmp_path / "corpus.zarr")


@pytest.mark.parametrize("text", [b"", b"[]", b"{", b'{"attributes": 3}', b"\xff", b"[" * 10**5])
def test_metadata_of_anything_else(packed: Path, text: bytes) -> None:
    (packed / "zarr.json").write_bytes(text)
    with pytest.raises(FaceDiffError, match=r"zarr\.json"):
        read_all(packed)


CODECS = "codecs.0.configuration.codecs"


@pytest.mark.parametrize("codec", ["numcodecs.pickle", "gzip", "numcodecs.json2"])
def test_only_our_own_codecs_are_run(packed: Path, codec: str) -> None:
    place = "motion_int16/zarr.json"
    change(packed, CODECS, lambda codecs: codecs.__setitem__(1, {"name": codec, "configuration": {}}), place)
    with pytest.raises(FaceDiffError, match=r"motion_int16/zarr\.json: codecs"):
        read_all(packed)


def test_speech_that_is_not_what_the_record_says(packed: Path) -> None:
    change(packed, f"{RECORD}.clips.0.sound", lambda place: place.__setitem__("samples", place["samples"] - 1))
    with pytest.raises(FaceDiffError, match=r"speech of clip A_e01"):
        read_all(packed)
    assert "sound_unreadable" in {finding.kind for finding in check(packed, TINY).findings}
