"""Times and orientation of a video's pictures."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data.track.video import read_pictures
from facediff.errors import FaceDiffError, Note
from facediff.speech.audio import read_speech
from tests.fakes.people import write_coded_video

QUARTER = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
UPRIGHT = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)


def shaded(width: int = 64, height: int = 32) -> np.ndarray:
    """A picture that is bright in its upper left corner."""
    picture = np.full((height, width, 3), 40, np.uint8)
    picture[: height // 2, : width // 2] = 200
    return picture


def test_pictures_come_at_their_own_times(tmp_path: Path) -> None:
    times = [0.0, 0.033, 0.1, 0.133, 0.2]
    path = write_coded_video(tmp_path / "a.mp4", [shaded()] * 5, times=times)
    assert [time for time, _ in read_pictures(path)] == pytest.approx(times, abs=1e-3)


def test_fast_videos_are_thinned_out(tmp_path: Path) -> None:
    path = write_coded_video(tmp_path / "a.mp4", [shaded()] * 100, times=np.arange(100) / 250)
    times = np.array([time for time, _ in read_pictures(path)])
    assert np.diff(times).min() > 1 / 126


def test_a_phone_that_was_held_upright(tmp_path: Path) -> None:
    path = write_coded_video(tmp_path / "a.mp4", [shaded()] * 3)
    content = path.read_bytes()
    track = content.index(b"tkhd")
    at = content.index(UPRIGHT, track)
    path.write_bytes(content[:at] + QUARTER + content[at + len(QUARTER) :])
    _, picture = next(read_pictures(path))
    assert picture.shape == (64, 32, 3)
    corners = [
        picture[rows, columns].mean() for rows in (slice(32), slice(32, 64)) for columns in (slice(16), slice(16, 32))
    ]
    assert int(np.argmax(corners)) == 1  # a quarter turn to the right


def test_a_hole_in_the_sound_is_silence(tmp_path: Path) -> None:
    times = np.arange(32_000) / 16_000
    sound = np.where((times > 0.5) & (times < 1.0), 0, np.sin(2 * np.pi * 300 * times)).astype(np.float32)
    path = write_coded_video(tmp_path / "a.mp4", [shaded()] * 50, sound=sound, hole=(0.6, 0.9))
    with pytest.warns(Note, match="0.32 s of its sound are missing"):
        speech = read_speech(path)
    assert abs(len(speech) - 32_000) < 2_500
    level = np.array(
        [np.abs(speech[round(t * 16_000) : round((t + 0.05) * 16_000)]).max() for t in (0.3, 0.7, 1.2, 1.7)]
    )
    assert (level > 0.3).tolist() == [True, False, True, True]


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", np.zeros(16_000), 16_000)
    with pytest.raises(FaceDiffError, match="has no pictures"):
        list(read_pictures(tmp_path / "a.wav"))


def test_half_a_file_is_no_video(tmp_path: Path) -> None:
    path = write_coded_video(tmp_path / "a.mp4", [shaded()] * 3)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FaceDiffError, match="is not a video that can be read"):
        list(read_pictures(path))
