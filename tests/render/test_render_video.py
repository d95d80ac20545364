"""What is in the video files, read back by readers that are not the writer."""

import struct
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt
import pytest

from facediff.render import Renderer, write_video

Frame = npt.NDArray[np.uint8]
SAMPLE_RATE = 16000


def _frames(count: int, size: tuple[int, int] = (48, 64)) -> Iterator[Frame]:
    for index in range(count):
        yield np.full((*size, 3), 40 + index % 100, np.uint8)


def _read_sound(path: Path) -> tuple[npt.NDArray[np.float32], int, float]:
    """Samples, rate, and time of the first sample as a player hears it."""
    with av.open(str(path)) as container:
        frames = list(container.decode(audio=0))
        start = float(frames[0].time or 0.0)
        samples = np.concatenate([frame.to_ndarray()[0] for frame in frames])
        return samples.astype(np.float32), frames[0].sample_rate, start


@pytest.mark.parametrize("rate", [25, 30, 60, 29.97])
@pytest.mark.parametrize("count", [1, 2, 37])
def test_video_frame_count_and_rate_are_exact(tmp_path: Path, rate: float, count: int) -> None:
    path = tmp_path / "a.mp4"
    assert write_video(path, _frames(count, (47, 63)), rate, np.zeros(8000, np.float32), SAMPLE_RATE) == count
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert sum(1 for _ in container.decode(video=0)) == count
        if count > 1:
            assert stream.average_rate == Fraction(rate).limit_denominator(1001)
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.height, stream.width) == (48, 64)  # as H.264 requires
        assert container.streams.audio[0].codec_context.name == "aac"
    capture = cv2.VideoCapture(str(path))
    seen = 0
    while capture.read()[0]:
        seen += 1
    assert seen == count
    if count > 1:
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(rate, abs=1e-3)
    capture.release()
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def test_video_pictures_come_back_in_order_and_in_colour(tmp_path: Path) -> None:
    colours = np.array([[200, 60, 40], [50, 180, 70], [40, 80, 210], [128, 128, 128]], np.uint8)
    write_video(tmp_path / "a.mp4", (np.full((32, 32, 3), colour, np.uint8) for colour in colours), 25)
    capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    for index, colour in enumerate(colours):
        assert capture.get(cv2.CAP_PROP_POS_MSEC) == pytest.approx(max(index - 1, 0) * 40, abs=1)
        picture = capture.read()[1][..., ::-1].reshape(-1, 3)
        np.testing.assert_allclose(np.median(picture, axis=0), colour, atol=6)
    capture.release()


@pytest.mark.parametrize("rate", [16000, 44100, 48000, 11999])
def test_video_sound_keeps_its_length(tmp_path: Path, rate: int) -> None:
    seconds = 1.3
    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(round(seconds * rate)) / rate)
    write_video(tmp_path / "a.mp4", _frames(33), 25, tone.astype(np.float32), rate)
    sound, out_rate, start = _read_sound(tmp_path / "a.mp4")
    assert start == pytest.approx(0, abs=1e-3)
    assert len(sound) / out_rate == pytest.approx(seconds, abs=2 * 1024 / out_rate)  # whole packets
    middle = sound[out_rate // 4 : out_rate]
    assert np.abs(middle).max() == pytest.approx(0.5, abs=0.05)


def _boxes(data: bytes, *path: bytes) -> Iterator[bytes]:
    """Contents of the boxes at a path of an mp4 file (ISO 14496-12), without any library."""
    place = 0
    while path and place < len(data):
        size, name = struct.unpack_from(">I4s", data, place)
        content = data[place + 8 : place + size]
        if name == path[0]:
            yield from _boxes(content, *path[1:]) if len(path) > 1 else (content,)
        place += size


def test_video_mouth_opens_with_its_clicks(tmp_path: Path) -> None:
    """A drawn mesh whose hole opens for one frame at every click: what is seen, what is heard, the file's edits."""
    frame_rate, count, opened = 25, 75, [7, 31, 32, 60]
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), -1).reshape(-1, 2)
    still = np.column_stack([grid, np.zeros(81)])
    corner = np.array([row * 9 + column for row in range(8) for column in range(8) if (row, column) != (4, 4)])
    faces = np.concatenate([np.stack([corner, corner + 1, corner + 9], 1), corner[:, None] + [1, 10, 9]])
    motion = np.tile(still, (count, 1, 1))
    lips = [40, 41], [49, 50]  # below and above the hole
    motion[:, lips[0], 1] += 0.125
    motion[:, lips[1], 1] -= 0.12
    motion[np.ix_(opened, lips[0], [1])] -= 0.4
    motion[np.ix_(opened, lips[1], [1])] += 0.4
    clicks = np.zeros(count * SAMPLE_RATE // frame_rate, np.float32)
    clicks[[frame * SAMPLE_RATE // frame_rate for frame in opened]] = 1
    path = tmp_path / "a.mp4"
    renderer = Renderer(faces, template=still, size=96)
    write_video(path, (renderer.render(frame) for frame in motion), frame_rate, clicks, SAMPLE_RATE)

    capture = cv2.VideoCapture(str(path))
    pictures = [capture.read()[1].astype(float) for _ in range(count)]
    seen = [i / capture.get(cv2.CAP_PROP_FPS) for i in range(count) if np.abs(pictures[i] - pictures[0]).max() > 60]
    capture.release()
    np.testing.assert_allclose(seen, np.array(opened) / frame_rate)

    sound, rate, start = _read_sound(path)
    loud = start + np.flatnonzero(np.abs(sound) > 0.3 * np.abs(sound).max()) / rate
    heard = [loud[np.abs(loud - moment).argmin()] for moment in seen]
    np.testing.assert_allclose(heard, seen, atol=0.5 / frame_rate)
    assert all(np.abs(np.array(seen) - moment).min() < 0.5 / frame_rate for moment in loud)  # and nothing else is

    # Players follow the edit lists: the picture from its first sample on, the sound without the encoder's delay.
    edits = [struct.unpack_from(">IIIi", box) for box in _boxes(path.read_bytes(), b"moov", b"trak", b"edts", b"elst")]
    kinds = [box[8:12] for box in _boxes(path.read_bytes(), b"moov", b"trak", b"mdia", b"hdlr")]
    assert kinds == [b"vide", b"soun"]
    assert [edit[1] for edit in edits] == [1, 1]  # one edit each, from the start of the film
    (offsets,) = _boxes(path.read_bytes(), b"moov", b"trak", b"mdia", b"minf", b"stbl", b"ctts")
    assert edits[0][3] == struct.unpack_from(">I", offsets, 12)[0]  # the first picture's delay by re-ordering
    assert edits[1][3] == 1024  # AAC's priming, in samples


def test_video_is_equal_when_written_twice(tmp_path: Path) -> None:
    """Silent ones byte by byte, and all pictures; sound but for what the AAC encoder chooses now and then."""
    sound = np.random.default_rng(0).normal(0, 0.1, SAMPLE_RATE).astype(np.float32)
    noise = np.random.default_rng(1).integers(0, 256, (25, 40, 56, 3)).astype(np.uint8)
    packets = []
    for name in ("a", "b"):
        write_video(tmp_path / f"{name}_silent.mp4", iter(noise), 25)
        write_video(tmp_path / f"{name}.mp4", iter(noise), 25, sound, SAMPLE_RATE)
        with av.open(str(tmp_path / f"{name}.mp4")) as container:
            packets.append([bytes(packet) for packet in container.demux(video=0)])
    assert (tmp_path / "a_silent.mp4").read_bytes() == (tmp_path / "b_silent.mp4").read_bytes()
    assert packets[0] == packets[1]
    (one, rate, start), (two, *others) = (_read_sound(tmp_path / f"{name}.mp4") for name in ("a", "b"))
    assert [rate, start] == others
    assert len(one) == len(two)
    assert float(np.abs(one - two).mean()) < 0.1 * float(np.abs(one).mean())


@pytest.mark.parametrize("error", [RuntimeError("half-way"), KeyboardInterrupt()])
def test_video_of_a_failing_generator_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    def failing() -> Iterator[Frame]:
        yield from _frames(30)
        raise error

    with pytest.raises(type(error)) as caught:
        write_video(tmp_path / "new" / "folder" / "a.mp4", failing(), 25, np.zeros(100000, np.float32), SAMPLE_RATE)
    assert caught.value is error
    assert list(tmp_path.iterdir()) == []
