"""A video becomes a moving picture of the same length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from facediff.render import write_video
from tests.fakes.processes import run

ROOT = Path(__file__).parents[2]


def test_the_picture_has_the_frames_and_the_pace_of_the_video(tmp_path: Path) -> None:
    frames = [np.full((64, 96, 3), shade, np.uint8) for shade in range(0, 250, 20)]
    write_video(tmp_path / "a.mp4", frames, 30, np.zeros(16_000, np.float32), 16_000)
    words = [str(tmp_path / "a.mp4"), str(tmp_path / "a.webp"), "--width", "48"]
    assert run(ROOT / "tools" / "moving_picture.py", *words).returncode == 0
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.size == (48, 32)
        assert picture.n_frames == len(frames)
        seconds = 0.0
        for index in range(picture.n_frames):
            picture.seek(index)
            picture.load()
            seconds += picture.info["duration"] / 1000
    assert abs(seconds - len(frames) / 30) < 0.005
