"""What is measured before training: each clip is opened once, results are kept, and one process measures for all."""

from __future__ import annotations

import os
import pickle
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from facediff.data import storage
from facediff.data.corpus import Corpus, read_templates
from facediff.errors import FaceDiffError
from facediff.utils.plain_files import write_json
from tests.fakes.tiny import Tiny


@pytest.fixture
def root(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return Path(shutil.copytree(tiny_root, tmp_path / "corpus"))


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often the motion of each clip was opened."""
    counts: Counter[str] = Counter()
    original = storage.open_vertices

    def counting(path: Path, *arguments: Any) -> Any:  # noqa: ANN401
        counts[path.stem] += 1
        return original(path, *arguments)

    monkeypatch.setattr(storage, "open_vertices", counting)
    return counts


def frames_of(data: Tiny, *, phased: bool = False) -> np.ndarray:
    """At most 16 evenly spread frames of every training clip, read with NumPy alone; ``phased`` as for components."""
    rows = []
    for number, clip in enumerate(data.clips("train"), start=1):
        stored = np.load(data.root / "vertices_npy" / f"{clip.name}.npy").reshape(-1, 24, 3)
        count, phase = min(16, len(stored)), number * (5**0.5 - 1) / 2 % 1
        places = (np.arange(count) + phase) * len(stored) / count if phased else np.linspace(0, len(stored) - 1, count)
        picks = places.astype(int)
        rows.append(stored[picks] - data.corpus.template(clip).numpy())
    return np.concatenate(rows).astype(np.float64)


def test_scale_and_components_are_those_of_the_frames(root: Path) -> None:
    data = Tiny(root=str(root))
    frames = frames_of(data)
    assert data.motion_scale() == pytest.approx(float(np.mean(frames**2) ** -0.5), rel=1e-6)
    frames = frames_of(data, phased=True)
    flat = frames.reshape(len(frames), -1)
    mean, shapes = data.principal_motion(3)
    np.testing.assert_allclose(mean.numpy(), flat.mean(0), atol=1e-7)
    _, values, rows = np.linalg.svd((flat - flat.mean(0)) / len(flat) ** 0.5, full_matrices=False)
    for found, value, row in zip(shapes.double().numpy(), values, rows, strict=False):
        assert np.linalg.norm(found) == pytest.approx(value, rel=1e-4)
        assert abs(found @ row) == pytest.approx(value, rel=1e-4)


def test_each_clip_is_opened_once_for_the_scale_and_once_for_the_components(root: Path, opened: Counter[str]) -> None:
    data = Tiny(root=str(root))
    data.motion_scale()
    data.principal_motion(4)
    assert set(opened) == {clip.name for clip in data.clips("train")}
    assert set(opened.values()) == {2}
    data.dataset("train").frames()  # known by then
    assert set(opened.values()) == {2}


def test_what_was_measured_is_kept_over_starts(root: Path, opened: Counter[str]) -> None:
    first = Tiny(root=str(root))
    scale, (mean, shapes) = first.motion_scale(), first.principal_motion(4, torch.full((72,), 2.0))
    opened.clear()
    second = Tiny(root=str(root))
    assert second.motion_scale() == scale
    again = second.principal_motion(4, torch.full((72,), 2.0))
    assert torch.equal(again[0], mean)
    assert torch.equal(again[1], shapes)
    assert not opened


def touch_motion(root: Path) -> None:
    path = root / "vertices_npy" / "A_e01.npy"
    np.save(path, np.load(path) * 1.5)


def touch_time(root: Path) -> None:
    path = root / "vertices_npy" / "A_e01.npy"
    os.utime(path, ns=(1, 1))


def touch_manifest(root: Path) -> None:
    write_json(root / "manifest.json", {"format": 1, "frame_rate": 25})


def touch_templates(root: Path) -> None:
    path = root / "templates.pkl"
    path.write_bytes(pickle.dumps({name: face.numpy() + 0.01 for name, face in read_templates(path).items()}))


@pytest.mark.parametrize("change", [touch_motion, touch_time, touch_manifest, touch_templates])
def test_a_changed_corpus_is_measured_again(root: Path, opened: Counter[str], change: Callable[[Path], None]) -> None:
    Tiny(root=str(root)).motion_scale()
    change(root)
    opened.clear()
    changed = Tiny(root=str(root))
    assert changed.motion_scale() == pytest.approx(float(np.mean(frames_of(changed) ** 2) ** -0.5), rel=1e-6)
    assert opened


def test_other_weights_and_other_training_speakers_are_measured_for_themselves(root: Path) -> None:
    plain, weighted = (Tiny(root=str(root)).principal_motion(2, w) for w in (None, torch.linspace(1, 2, 72)))
    assert not torch.allclose(plain[1], weighted[1])
    assert Tiny(root=str(root), train_identities=["A"]).motion_scale() != Tiny(root=str(root)).motion_scale()


@pytest.mark.parametrize("frames", [20, 25, 140, 400])
def test_windows_are_read_from_the_middle_of_long_clips(
    root: Path, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    width, data = 25, Tiny(root=str(root))
    motion = np.random.default_rng(0).normal(size=(frames, 24, 3)).cumsum(0)
    clip = data.clips("train")[0]
    rest = data.corpus.template(clip).numpy()
    np.save(root / "vertices_npy" / f"{clip.name}.npy", (motion + rest).reshape(frames, -1).astype(np.float32))
    monkeypatch.setattr(data, "clips", lambda split: [clip])

    def project(given: torch.Tensor) -> torch.Tensor:
        return given.flatten(2)[..., :2]

    if frames < width:
        with pytest.raises(FaceDiffError, match="lasts 25 frames"):
            data.covariance_over_time(project, width)
        return
    first = max(0, (frames - 100) // 2)
    part = motion.reshape(frames, -1)[first : first + 100, :2]
    windows = np.stack([part[place : place + width] for place in range(len(part) - width + 1)])
    wanted = np.einsum("nik,njk->kij", windows, windows) / len(windows)
    np.testing.assert_allclose(data.covariance_over_time(project, width).numpy(), wanted, rtol=1e-4)


def of_rank(data: Tiny, rank: int, sent: list[Any]) -> Tiny:
    """A data module of one of two processes; the first one's broadcast is put into ``sent``."""

    def broadcast(value: Any, src: int) -> Any:  # noqa: ANN401
        assert src == 0
        if rank == 0:
            sent.append(value)
        return sent[-1]

    data.trainer = SimpleNamespace(world_size=2, global_rank=rank, strategy=SimpleNamespace(broadcast=broadcast))
    return data


def test_one_process_measures_and_the_others_receive(
    root: Path, opened: Counter[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sent: list[Any] = []
    scale = of_rank(Tiny(root=str(root)), 0, sent).motion_scale()
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache of another machine"))
    opened.clear()
    assert of_rank(Tiny(root=str(root)), 1, sent).motion_scale() == scale
    assert not opened


def test_what_goes_wrong_in_one_process_ends_all(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[Any] = []
    monkeypatch.setattr(Corpus, "read_spread", lambda *_: 1 / 0)  # a fault, and no error of facediff's own
    with pytest.raises(ZeroDivisionError):
        of_rank(Tiny(root=str(root)), 0, sent).motion_scale()
    with pytest.raises(FaceDiffError, match="first process failed: ZeroDivisionError"):
        of_rank(Tiny(root=str(root)), 1, sent).motion_scale()
