"""Damaged chunks and shards are named, and memory is bounded."""

from __future__ import annotations

import json
import os
import shutil
import struct
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
from numcodecs import blosc

from facediff.data.check import check
from facediff.data.packed.unpacking import unpack
from facediff.errors import FaceDiffError
from tests.data.packed.damage import RECORD, TINY, change, read_all
from tests.fakes.tiny import Tiny


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 16
    path.write_bytes(bytes(content))


@pytest.fixture
def packed(sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(sound, tmp_path / "corpus.zarr"))


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
