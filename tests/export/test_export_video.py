"""Videos read back by PyAV: what is seen and heard, of one animation and of several."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image, ImageSequence

from facediff.animation import Animation
from facediff.export import ExportOptions, video, write_animations
from facediff.export.video import Interpolated, drawn_frames

SMALL = ExportOptions(size=64)


def pictures(path: Path) -> npt.NDArray[np.uint8]:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_one_frame_for_every_frame_with_the_speech(animation: Animation, tmp_path: Path) -> None:
    assert write_animations(tmp_path / "a.mp4", [animation], SMALL) == [tmp_path / "a.mp4"]
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 30
        sound = container.streams.audio[0]
        assert float(sound.duration * sound.time_base) == pytest.approx(40 / 30, abs=0.07)
    seen = pictures(tmp_path / "a.mp4")
    assert len(seen) == 40
    assert seen.shape[2] == 64
    face = seen[0, -64:].astype(int)
    assert np.abs(face - face[0, 0]).max() > 40, "there is something on the background"


def test_a_video_for_web_pages_has_speech_and_a_moving_picture_has_none(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.webm", [animation], SMALL)
    with av.open(str(tmp_path / "a.webm")) as container:
        assert [stream.codec_context.name for stream in container.streams] == ["vp9", "opus"]
        assert sum(1 for _ in container.decode(video=0)) == 40
    assert write_animations(tmp_path / "a.gif", [animation], replace(SMALL, size=192)) == [tmp_path / "a.gif"]
    with Image.open(tmp_path / "a.gif") as picture:
        lengths = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
        assert picture.width == 64
    assert sum(lengths) == pytest.approx(1000 * 40 / 30, abs=5)
    # Browsers play frames of 10 ms in 100.
    write_animations(tmp_path / "b.gif", [replace(animation, frame_rate=60.0)], replace(SMALL, size=192))
    with Image.open(tmp_path / "b.gif") as picture:
        lengths = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert min(lengths) >= 20
    assert sum(lengths) == pytest.approx(1000 * 40 / 60, abs=25)


def test_a_video_may_have_more_pictures_than_frames(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.mp4", [animation], replace(SMALL, video_rate=60.0))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == 60
    assert len(pictures(tmp_path / "a.mp4")) == 79
    motion = animation.vertices
    between = Interpolated(motion, 30.0, 60.0)
    assert len(between) == 79
    assert np.array_equal(between[78], motion[39])
    assert between[7] == pytest.approx((motion[3] + motion[4]) / 2, abs=1e-7)


def test_no_speech_is_a_silent_video(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.mp4", [animation], ExportOptions(size=64, no_speech=True, footer="synthetic corpus"))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert not container.streams.audio


def test_several_animations_are_shown_side_by_side_and_wait_for_the_longest(
    make_animation: Callable[..., Animation], tmp_path: Path
) -> None:
    long, short = make_animation(), make_animation(vertices=make_animation().vertices[:5], name="short")
    assert write_animations(tmp_path / "a.mp4", [short, long], SMALL) == [tmp_path / "a.mp4"]
    seen = pictures(tmp_path / "a.mp4").astype(int)
    assert len(seen) == 40
    assert seen.shape[2] == 128
    left, right = seen[:, -64:, :64], seen[:, -64:, 64:]
    assert np.abs(left[20:] - left[6]).mean() < 1, "the short animation stays on its last frame"
    assert np.abs(right[20:] - right[6]).mean() > np.abs(left[20:] - left[6]).mean()


def test_faces_of_one_unit_compare_in_size(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    big = make_animation(colours=None)
    small = make_animation(colours=None, vertices=big.vertices / 2, template=big.template / 2)
    write_animations(tmp_path / "a.mp4", [big, small], SMALL)
    picture = pictures(tmp_path / "a.mp4")[0, -64:].astype(int)
    covered = (np.abs(picture - picture[:1, :1]).sum(-1) > 60).reshape(64, 2, 64).sum((0, 2))
    assert covered[1] < 0.5 * covered[0]


def test_procedural_motion_is_named_below_the_video(animation: Animation) -> None:
    found = {
        "corpus": "puppet (synthetic)",
        "procedural": "blinks (17 a minute, seed 0); head sway (2 degrees, seed 0)",
    }
    assert video.procedural([replace(animation, metadata=found), animation]) == "procedural: blinks, head sway"
    assert video.procedural([animation]) == ""
    plain = next(drawn_frames([replace(animation, metadata={"corpus": "puppet (synthetic)"})], ExportOptions(size=128)))
    marked = next(drawn_frames([replace(animation, metadata=found)], ExportOptions(size=128)))
    assert not np.array_equal(plain, marked)
