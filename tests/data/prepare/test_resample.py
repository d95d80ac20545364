"""Resampling motion to another frame rate without aliasing."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from facediff.data.reconstructions import resample_frames, resampled_length

RATES = [(60, 30), (30, 25), (25, 30), (29.97, 25), (23.976, 30), (30, 60), (100, 25)]


@pytest.mark.parametrize(("rate_in", "rate_out"), RATES)
def test_a_slow_sinusoid_comes_back_and_frame_k_is_at_its_time(rate_in: float, rate_out: float) -> None:
    time = np.arange(round(10 * rate_in)) / rate_in
    frequencies = np.array([0.7, 3.0, 0.35 * min(rate_in, rate_out)])
    made = resample_frames(np.sin(2 * np.pi * frequencies * time[:, None] + 0.4), rate_in, rate_out)
    assert len(made) == round(len(time) * rate_out / rate_in) == resampled_length(len(time), rate_in, rate_out)
    later = np.arange(len(made)) / rate_out
    true = np.sin(2 * np.pi * frequencies * later[:, None] + 0.4)
    inner = (later > 1.2) & (later < later[-1] - 1.2)
    np.testing.assert_allclose(made[inner], true[inner], atol=1e-3)
    np.testing.assert_allclose(made[: len(inner) - 2, 0], true[: len(inner) - 2, 0], atol=5e-3)  # the ends as well


@pytest.mark.parametrize(("rate_in", "rate_out"), RATES)
@pytest.mark.parametrize("frames", [4, 7, 200])
def test_constants_and_straight_lines_are_kept(rate_in: float, rate_out: float, frames: int) -> None:
    made = resample_frames(np.full((frames, 3), 7.25), rate_in, rate_out)
    np.testing.assert_allclose(made, 7.25, atol=1e-12)
    if frames == 200:
        line = np.arange(frames)[:, None] / rate_in
        made = resample_frames(line, rate_in, rate_out)
        np.testing.assert_allclose(made[:, 0], np.arange(len(made)) / rate_out, atol=1e-3)


def test_frequencies_above_the_new_nyquist_frequency_are_removed() -> None:
    """A 20 Hz tremble at 60 frames a second would look like 10 Hz if every second frame were taken."""
    time = np.arange(600) / 60
    tremble = np.sin(2 * np.pi * 20 * time)[:, None]
    assert np.abs(tremble[::2]).max() > 0.8
    assert np.abs(resample_frames(tremble, 60, 30)[30:-30]).max() < 1e-3


def test_resampling_from_disk_to_disk_needs_little_memory(tmp_path: Path) -> None:
    motion = np.random.default_rng(0).normal(size=(6000, 300)).astype(np.float32)
    np.save(tmp_path / "in.npy", motion)
    source = np.load(tmp_path / "in.npy", mmap_mode="r")
    out = np.lib.format.open_memmap(tmp_path / "out.npy", mode="w+", dtype=np.float32, shape=(5000, 300))
    tracemalloc.start()
    resample_frames(source, 30, 25, out=out)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(out, resample_frames(motion, 30, 25))
    assert peak < motion.nbytes / 2
