"""Data modules read a packed corpus as they read the folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from facediff.data.packed import packing
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.unpacking import unpack
from tests.data.packed.damage import TINY
from tests.fakes.tiny import VERTICES, Tiny

MM = 0.001


pack = partial(packing.pack, exact="none")


@pytest.mark.parametrize("chunk", [0.04, 0.5, 60.0])
def test_windows_are_those_of_the_folder(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: float
) -> None:
    monkeypatch.setattr(packing, "CHUNK_SECONDS", chunk)
    pack(corpus, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = Tiny(root=str(corpus)).corpus, Tiny(root=str(tmp_path / "out.zarr")).corpus
    assert list(plain.clips) == list(other.clips)
    rng = np.random.default_rng(1)
    for name in ("A_e01", "B_e03", "C_e07"):
        clip, twin = plain.clips[name], other.clips[name]
        assert twin.attributes == clip.attributes
        frames = plain.frames(clip)
        assert other.frames(twin) == frames
        for start, stop in [(0, frames), (frames - 1, frames + 9), *np.sort(rng.integers(0, frames, (6, 2)))]:
            moved, again = plain.read_motion(clip, start, stop), other.read_motion(twin, int(start), int(stop))
            assert moved.shape == again.shape
            assert not len(moved) or float((moved - again).abs().max()) <= 0.0101 * MM
            assert torch.equal(plain.read_audio(clip, start, stop), other.read_audio(twin, start, stop))
        spread = [corpus.read_spread(c, 5) for corpus, c in ((plain, clip), (other, twin))]
        assert float((spread[0] - spread[1]).abs().max()) <= 0.0101 * MM
        whole, parts = plain.read_motion(clip), min(frames, 3)
        places = [int((part + 0.7) / parts * frames) for part in range(parts)]
        assert torch.equal(plain.read_spread(clip, 3, 0.7), whole[places])


def test_only_the_chunks_of_a_window_are_read(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = PackedCorpus(packed)
    fetched: list[int] = []
    motion = opened.open("A_e01")
    original = motion.array.decode
    monkeypatch.setattr(motion.array, "decode", lambda number, raw: (fetched.append(number), original(number, raw))[1])
    motion.offsets(range(100, 120), np.zeros((VERTICES, 3), np.float32))
    assert len(fetched) == len({t // 12 for t in range(100, 120)})


def test_every_second_frame_of_a_faster_corpus(corpus: Path, tmp_path: Path) -> None:
    class Fast(Tiny):
        frame_rate = 12.5

    pack(corpus, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = Fast(root=str(corpus)).corpus, Fast(root=str(tmp_path / "out.zarr")).corpus
    clip = plain.clips["A_e01"]
    assert other.frames(other.clips["A_e01"]) == plain.frames(clip) == 295
    moved, again = (c.read_motion(c.clips["A_e01"], 30, 61) for c in (plain, other))
    assert float((moved - again).abs().max()) <= 0.0101 * MM


@pytest.mark.parametrize(
    ("rate", "channels", "subtype"),
    [(16000, 1, "PCM_24"), (22050, 2, "PCM_16"), (48000, 1, "FLOAT"), (8000, 1, "PCM_U8")],
)
def test_speech_of_any_form_is_what_the_folder_gives(
    corpus: Path, tmp_path: Path, rate: int, channels: int, subtype: str
) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    (source / "manifest.json").unlink()
    tone = np.random.default_rng(0).uniform(-0.5, 0.5, (15 * rate, channels))
    soundfile.write(source / "wav" / "A_e01.wav", tone, rate, subtype=subtype)
    pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = Tiny(root=str(source)).corpus, Tiny(root=str(tmp_path / "out.zarr")).corpus
    for start, stop in ((0, 590), (240, 260)):
        heard = [c.read_audio(c.clips["A_e01"], start, stop) for c in (plain, other)]
        assert torch.equal(heard[0], heard[1])
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    was, now = (soundfile.read(root / "wav" / "A_e01.wav")[0] for root in (source, tmp_path / "back"))
    assert np.array_equal(was, now)


def test_batches_of_packed_and_plain_agree_in_loader_processes(corpus: Path, packed: Path) -> None:
    options = {"batch_size": 2, "window": 9}
    loaders = [
        Tiny(root=str(root), num_workers=workers, **options).train_dataloader()
        for root, workers in ((corpus, 0), (packed, 2))
    ]
    for one, other in zip(*loaders, strict=True):
        assert one.names == other.names
        assert torch.equal(one.audio, other.audio)
        assert float((one.motion - other.motion).abs().max()) <= 0.0101 * MM
    plain, twin = (Tiny(root=str(root)) for root in (corpus, packed))
    assert twin.assets().regions.keys() == plain.assets().regions.keys()
    assert torch.equal(twin.assets().templates["A"], plain.assets().templates["A"])
    assert twin.motion_scale() == pytest.approx(plain.motion_scale(), rel=1e-4)
    assert (twin.root / "phonemes" / "A_e01.csv").is_file()


def test_packed_scores_are_those_of_the_folder(
    corpus: Path, packed: Path, make_model: Callable[..., Any], make_trainer: Callable[..., Any]
) -> None:
    plain, other = (
        make_trainer().test(make_model(motion_scale="none"), datamodule=Tiny(root=str(root)), verbose=False)
        for root in (corpus, packed)
    )
    for one, two in zip(plain, other, strict=True):
        for name in ("test_a/mve", "test_a/lve", "test_b/lve"):
            if name in one:
                assert two[name] == pytest.approx(one[name], rel=1e-4)
    assert any("lve" in name for scores in plain for name in scores)
