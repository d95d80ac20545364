"""The cache of decoded chunks keeps to its bound, and keeps what is used again."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.data.packed.decoded import VARIABLE, DecodedChunks
from tests.fakes.tiny import Tiny

CHUNK = np.arange(1000, dtype=np.uint8)


def read(cache: DecodedChunks, number: int) -> bool:
    """Whether a chunk was there; what a reader does where it is not."""
    if cache.get(("motion", number)) is not None:
        return True
    if cache.stores(("motion", number), CHUNK.nbytes):
        cache.put(("motion", number), CHUNK)
    return False


def test_what_is_read_again_is_kept_within_the_bound() -> None:
    cache = DecodedChunks(10_000)
    read(cache, 0)
    assert cache.bytes == 0  # nothing was read twice
    assert [read(cache, 0) for _ in range(2)] == [False, True]
    for number in [*range(50), *range(50)] * 2:  # more than fits: no chunk is read again soon enough
        read(cache, number)
    assert cache.bytes == 1000
    for number in range(100, 130):
        read(cache, number)
        read(cache, number)
        assert cache.bytes <= 10_000
    assert [read(cache, number) for number in range(121, 130)] == [True] * 9
    assert cache.get(("motion", 0)) is None  # used longest ago
    assert copy.deepcopy(cache).bytes == 0  # as a loader process gets it


def test_processes_share_the_bound_and_nothing_is_kept_without_one() -> None:
    cache, none = DecodedChunks(10_000), DecodedChunks(0)
    for number in range(20):
        for _ in range(2):
            if cache.stores(("motion", number), 1000, 5):
                cache.put(("motion", number), CHUNK, 5)
            read(none, number)
    assert cache.bytes == 2000
    assert none.bytes == 0


@pytest.mark.parametrize("exact", [False, True])
def test_windows_are_equal_with_and_without_the_cache(
    packed: Path, corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exact: bool
) -> None:
    from facediff.data.packed.packing import pack

    root = packed
    if exact:
        root = tmp_path / "exact.zarr"
        pack(corpus, root, corpus="tests.fakes.tiny.Tiny", lossless=True, workers=1)
    cached = Tiny(root=str(root))
    assert cached.packed is not None
    monkeypatch.setenv(VARIABLE, "0")
    plain = Tiny(root=str(root))
    for start in (3, 0, 8, 3, 0, 21):
        clip = plain.corpus.clips["A_e01"]
        one, other = (data.corpus.read_motion(clip, start, start + 30) for data in (cached, plain))
        assert torch.equal(one, other)
    assert cached.packed._decoded_chunks.bytes > 0
