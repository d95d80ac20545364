"""Unpacking gives the folder back: bit for bit, or within the tolerance."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.data.check import check
from facediff.data.packed import packing
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.unpacking import unpack
from facediff.utils.checksums import describe_files
from tests.data.packed.damage import TINY
from tests.fakes.tiny import Tiny

MM = 0.001


pack = partial(packing.pack, exact="none")


def same_content(one: Path, other: Path) -> bool:
    return describe_files(one) == describe_files(other)


def test_what_is_unpacked_is_within_the_tolerance_and_all_else_is_the_same(
    corpus: Path, packed: Path, tmp_path: Path
) -> None:
    assert unpack(packed, tmp_path / "back", workers=1) == 21
    worst = 0.0
    for path in sorted((corpus / "vertices_npy").glob("*.npy")):
        was, now = np.load(path), np.load(tmp_path / "back" / "vertices_npy" / path.name)
        assert now.dtype == was.dtype
        worst = max(worst, float(np.abs(now.astype(np.float64) - was).max()))
        heard, again = (soundfile.read(root / "wav" / f"{path.stem}.wav") for root in (corpus, tmp_path / "back"))
        assert heard[1] == again[1]
        assert np.array_equal(heard[0], again[0])
    assert 0.005 * MM < worst <= 0.01 * MM
    assert {path.name for path in tmp_path.joinpath("back").iterdir()} == {path.name for path in corpus.iterdir()}
    for place in ("clips.csv", "templates.pkl", "tiny.ply", "regions/lve.txt", "phonemes/A_e01.csv"):
        assert (tmp_path / "back" / place).read_bytes() == (corpus / place).read_bytes()
    assert check(tmp_path / "back", TINY).sound  # the checksums are those of what was written
    assert json.loads((tmp_path / "back" / "manifest.json").read_text())["packed"]["tolerance_mm"] == 0.01


@pytest.mark.parametrize("tolerance", [1.0, 0.001])
def test_every_tolerance_is_kept(corpus: Path, tmp_path: Path, tolerance: float) -> None:
    pack(corpus, tmp_path / "out.zarr", corpus=TINY, tolerance=tolerance, workers=1)
    record = PackedCorpus(tmp_path / "out.zarr").record
    assert {clip.coding for clip in record.clips.values()} == {"int16" if tolerance == 1 else "int32"}
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    for path in sorted((corpus / "vertices_npy").glob("*.npy"))[:4]:
        now = np.load(tmp_path / "back" / "vertices_npy" / path.name).astype(np.float64)
        assert np.abs(now - np.load(path)).max() <= tolerance * MM


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_lossless_packing_gives_every_bit_back(corpus: Path, tmp_path: Path, dtype: str) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    (source / "manifest.json").unlink()
    path = source / "vertices_npy" / "B_e02.npy"
    np.save(path, np.load(path).astype(dtype))
    pack(source, tmp_path / "out.zarr", corpus=TINY, lossless=True, workers=1)
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    assert same_content(tmp_path / "back" / "vertices_npy", source / "vertices_npy")
    plain, exact = (Tiny(root=str(place)).corpus for place in (source, tmp_path / "out.zarr"))
    assert torch.equal(plain.read_motion(plain.clips["B_e02"]), exact.read_motion(exact.clips["B_e02"]))
