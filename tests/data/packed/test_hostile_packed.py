"""Packed corpora from elsewhere: damage is named, sizes are bounded, and nothing is run that a file asks for."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
from numcodecs import blosc

from facediff.data.check import check
from facediff.data.packed.packing import pack
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.unpacking import unpack
from facediff.errors import FaceDiffError
from tests.fakes.tiny import Tiny, write_tiny

TINY = "tests.fakes.tiny.Tiny"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("packed")
    pack(write_tiny(folder / "corpus", sentences=2), folder / "corpus.zarr", corpus=TINY, workers=1)
    return folder / "corpus.zarr"


@pytest.fixture
def packed(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(sound, tmp_path / "corpus.zarr"))


def read_all(source: Path) -> None:
    """All that training and unpacking read."""
    data = Tiny(root=str(source))
    corpus = data.corpus
    for clip in corpus.clips.values():
        corpus.read_motion(clip)
        corpus.read_audio(clip, 0, corpus.frames(clip))
    data.packed.templates() if data.packed else None


def change(source: Path, key: str, value: Callable[[dict[str, Any]], object], file: str = "zarr.json") -> None:
    """Change a metadata file as its function says; ``key`` is where in it."""
    content = json.loads((source / file).read_text())
    place = content
    for part in key.split(".") if key else []:
        place = place[int(part) if part.isdecimal() else part]
    value(place)
    (source / file).write_text(json.dumps(content))


RECORD = "attributes.facediff"


@pytest.mark.parametrize(
    ("key", "field", "value"),
    [
        (RECORD, "format", "facediff packed corpus 2"),
        (RECORD, "format", "something else"),
        (RECORD, "n_vertices", 0),
        (RECORD, "n_vertices", 25),
        (RECORD, "step", "0.1"),
        (RECORD, "step", float("nan")),
        (RECORD, "clips", {}),
        (RECORD, "arrays", []),
        (RECORD, "identities", [3]),
        (f"{RECORD}.clips.0", "first", 1),
        (f"{RECORD}.clips.0", "first", 10**9),
        (f"{RECORD}.clips.0", "frames", 10**5),
        (f"{RECORD}.clips.0", "frames", -1),
        (f"{RECORD}.clips.0", "coding", "object"),
        (f"{RECORD}.clips.0", "name", "../../evil"),
        (f"{RECORD}.clips.0", "name", "a\nb"),
        (f"{RECORD}.clips.0", "sound", None),
        (f"{RECORD}.clips.0.sound", "pieces", [10**12]),
        (f"{RECORD}.clips.0.sound", "samples", 10**15),
        (f"{RECORD}.clips.0.sound", "form", "/../../x"),
        (f"{RECORD}.clips.0.sound", "bits", 3),
        (f"{RECORD}.files.0", "path", "../evil"),
        (f"{RECORD}.files.0", "path", "/etc/evil"),
        (f"{RECORD}.files.0", "path", ".ssh/evil"),
        (f"{RECORD}.files.0", "path", "a/../../evil"),
        (f"{RECORD}.files.0", "path", "c:\\evil"),
        (f"{RECORD}.files.0", "bytes", 10**12),
        (f"{RECORD}.files.0", "sha256", "0" * 64),
        (f"{RECORD}.arrays.motion_int16", "rows", 10**14),
        (f"{RECORD}.arrays.motion_int16", "chunk", 10**9),
        (f"{RECORD}.arrays.motion_int16", "chunk", 0),
        (f"{RECORD}.arrays.motion_int16", "chunks", 10**9),
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


SHARD = "motion_int16/c/0/0"


def rewritten(shard: Path, chunk: bytes) -> None:
    """Put a chunk in the place of the first one, with a right checksum and a right index."""
    content = shard.read_bytes()
    root = shard.parents[3]
    facts = json.loads((root / "zarr.json").read_text())["attributes"]["facediff"]["arrays"]["motion_int16"]
    count = facts["chunks"]
    index = np.frombuffer(content[-16 * count - 4 : -4], "<u8").reshape(-1, 2).copy()
    body = content[: -16 * count - 4]
    chunk += struct.pack("<I", google_crc32c.value(chunk))
    index[0] = len(body), len(chunk)
    table = index.tobytes()
    shard.write_bytes(body + chunk + table + struct.pack("<I", google_crc32c.value(table)))
    change(root, f"{RECORD}.arrays.motion_int16", lambda place: place.__setitem__("shards", [shard.stat().st_size]))


def test_a_chunk_that_expands_beyond_its_size_is_refused_unread(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bomb = blosc.compress(np.zeros(100 << 20, np.uint8), b"zstd", 9)
    assert len(bomb) < 1 << 20
    rewritten(packed / SHARD, bomb)
    corpus = Tiny(root=str(packed)).corpus
    face = corpus.template(corpus.clips["A_e01"])  # its file is read
    assert face.shape == (24, 3)
    monkeypatch.setattr(blosc, "decompress", lambda *words: pytest.fail("was decoded"))
    with pytest.raises(FaceDiffError, match=r"clip A_e01.*c/0/0: chunk 0 expands to 104857600 bytes"):
        corpus.read_motion(corpus.clips["A_e01"])


def test_rubbish_with_a_right_checksum_is_refused(packed: Path) -> None:
    raw = bytearray(blosc.compress(np.zeros(12 * 72, np.int16), b"zstd", 1))
    raw[20:] = os.urandom(len(raw) - 20)
    rewritten(packed / SHARD, bytes(raw))
    with pytest.raises(FaceDiffError, match=r"clip A_e01.*chunk 0"):
        read_all(packed)


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 16
    path.write_bytes(bytes(content))


@pytest.mark.parametrize(("place", "what"), [(30, "chunk 0"), (-2, "index"), (-30, "index")])
def test_a_flipped_bit_names_the_clip_and_the_chunk(packed: Path, place: int, what: str) -> None:
    flip(packed / SHARD, place)
    with pytest.raises(FaceDiffError, match=rf"clip A_e01: .*{SHARD}.*{what}"):
        read_all(packed)
    report = check(packed, TINY)
    damaged = {finding.where for finding in report.findings if finding.kind == "motion_unreadable"}
    assert "vertices_npy/A_e01.npy" in damaged
    assert what == "index" or len(damaged) == 1
    with pytest.raises(FaceDiffError, match="A_e01"):
        unpack(packed, packed.parent / "back", workers=1)
    assert not (packed.parent / "back").exists()


@pytest.mark.parametrize("place", ["motion_int16", "speech", "files", "templates"])
def test_a_shard_that_is_missing_or_cut_short_is_named(packed: Path, place: str) -> None:
    shard = next(path for path in sorted((packed / place / "c").rglob("*")) if path.is_file())
    shard.write_bytes(shard.read_bytes()[:-9])
    for _ in range(2):
        with pytest.raises(FaceDiffError, match=rf"{place}/c/0"):
            read_all(packed)
        shard.unlink(missing_ok=True)


def test_speech_that_is_not_what_the_record_says(packed: Path) -> None:
    change(packed, f"{RECORD}.clips.0.sound", lambda place: place.__setitem__("samples", place["samples"] - 1))
    with pytest.raises(FaceDiffError, match=r"speech of clip A_e01"):
        read_all(packed)
    assert "sound_unreadable" in {finding.kind for finding in check(packed, TINY).findings}


def test_a_folder_of_anything_else_is_no_packed_corpus(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match="no packed corpus"):
        PackedCorpus(tmp_path)
