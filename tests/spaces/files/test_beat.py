"""BEAT's json and LAM's like it: read, written and read again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from facediff.spaces import layout
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters

WEIGHTS = np.random.default_rng(0).random((6, 51)).astype(np.float32)


def beat(**changes: object) -> dict[str, Any]:
    frames = [
        {"weights": [float(w) for w in row], "time": (k + 1) / 60, "rotation": []} for k, row in enumerate(WEIGHTS)
    ]
    return {"names": list(layout("arkit_51").channels), "frames": frames, **changes}


def written(path: Path, content: dict[str, Any]) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_read_beat_has_its_rate_order_and_start(tmp_path: Path) -> None:
    clip = read_parameters(written(tmp_path / "1_a_0_1_1.json", beat()))
    assert (clip.frame_rate, clip.layout, clip.dropped) == (60.0, "arkit_51", 0)
    assert abs(clip.start - 1 / 60) < 1e-12
    assert clip.space.absent == ("tongueOut",)
    assert np.array_equal(clip.values, WEIGHTS)


def test_beat_written_and_read_again_is_the_same(tmp_path: Path) -> None:
    clip = read_parameters(written(tmp_path / "a.json", beat()))
    write_parameters(tmp_path / "b.json", clip)
    again = read_parameters(tmp_path / "b.json")
    assert np.array_equal(again.values, clip.values)
    assert (again.space, again.start, again.frame_rate) == (clip.space, clip.start, clip.frame_rate)
    # A take's start is a time of day.
    write_parameters(tmp_path / "b.json", replace(clip, layout="live_link", start=36_000.0))
    assert read_parameters(tmp_path / "b.json").start == 0


def test_absent_weights_are_not_written_as_zero(tmp_path: Path) -> None:
    space = replace(layout("arkit"), absent=("tongueOut",))
    write_parameters(tmp_path / "a.json", ParameterClip("a", np.ones((3, 52), np.float32), space, 30.0))
    again = read_parameters(tmp_path / "a.json")
    assert "tongueOut" not in again.space.channels
    assert again.space.absent == ("tongueOut",)


def test_read_beat_of_lam_takes_the_rate_of_its_metadata(tmp_path: Path) -> None:
    frames = [{"weights": [0.5] * 52, "time": k / 30, "rotation": []} for k in range(4)]
    for one in (frames, [{"weights": [0.5] * 52} for _ in frames]):
        content = {"names": list(layout("arkit").channels), "metadata": {"fps": 30, "frame_count": 4}, "frames": one}
        clip = read_parameters(written(tmp_path / "lam.json", content))
        assert (clip.frame_rate, clip.layout) == (30.0, "arkit")


def test_one_frame_is_written_with_its_rate(tmp_path: Path) -> None:
    clip = ParameterClip("a", np.full((1, 52), 0.5, np.float32), layout("arkit"), 25.0)
    write_parameters(tmp_path / "a.json", clip)
    again = read_parameters(tmp_path / "a.json")
    assert again.frame_rate == 25.0
    np.testing.assert_array_equal(again.values, clip.values)
