"""Arrays kept on disk, and speech that is decoded once."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.errors import FaceDiffError
from facediff.speech import audio
from facediff.speech.audio import read_speech, read_stretch
from facediff.utils.arrays import ArrayStore


@pytest.fixture
def store(tmp_path: Path) -> ArrayStore:
    return ArrayStore(tmp_path / "cache")


def test_what_is_put_in_comes_out(store: ArrayStore) -> None:
    key = store.key("weights", 2, "speech")
    assert store.get(key) is None
    store.put(key, np.arange(6.0).reshape(2, 3))
    found = store.get(key)
    assert isinstance(found, np.memmap)
    assert np.array_equal(found, np.arange(6.0).reshape(2, 3))


def test_keys_tell_their_parts_apart(store: ArrayStore) -> None:
    parts = [("a", "b"), ("ab",), ("a", "b", ""), ("b", "a"), ("a", "c")]
    assert len({store.key(*p) for p in parts}) == len(parts)
    assert store.key("a", 1) == ArrayStore(Path("elsewhere")).key("a", 1)


@pytest.mark.parametrize("keep", [0, 60, 200])
def test_a_half_written_file_is_reported_and_made_again(store: ArrayStore, keep: int) -> None:
    store.put("abc", np.zeros(100))
    path = store.path("abc")
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.warns(UserWarning, match=r"abc\.npy: a damaged or half-written cache file"):
        assert store.get("abc") is None
    store.put("abc", np.ones(100))
    assert np.array_equal(store.get("abc"), np.ones(100))


def test_a_place_that_cannot_be_written_is_reported_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    store = ArrayStore(tmp_path / "file" / "cache")
    with pytest.warns(UserWarning, match="going on without the cache"):
        assert np.array_equal(store.put("abc", np.ones(3)), np.ones(3))
    store.put("abd", np.ones(3))
    assert store.get("abc") is None


def test_of_a_16_khz_file_only_the_stretch_is_read(
    tmp_path: Path, store: ArrayStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    soundfile.write(tmp_path / "a.wav", np.random.default_rng(0).uniform(-0.9, 0.9, 16000), 16000)
    samples, _ = soundfile.read(tmp_path / "a.wav", dtype="float32")
    monkeypatch.setattr(audio, "read_speech", lambda path: pytest.fail("read as a whole"))
    for first, length in ((0, 16000), (500, 1000), (15900, 300), (20000, 10)):
        expected = np.zeros(length, "f4")
        cut = samples[first : first + length]
        expected[: len(cut)] = cut
        assert np.array_equal(read_stretch(tmp_path / "a.wav", first, length, store), expected)
    assert not store.folder.exists()


@pytest.mark.parametrize(("rate", "channels"), [(22000, 1), (44100, 2), (16000, 2)])
def test_any_other_file_is_decoded_once(
    tmp_path: Path, store: ArrayStore, monkeypatch: pytest.MonkeyPatch, rate: int, channels: int
) -> None:
    path = tmp_path / "a.wav"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.5, 0.5, (rate, channels)), rate)
    whole = read_speech(path)
    count = 0

    def counting(path: Path) -> np.ndarray:
        nonlocal count
        count += 1
        return read_speech(path)

    monkeypatch.setattr(audio, "read_speech", counting)
    for first in (0, 3000, 15000):
        found = read_stretch(path, first, 800, store)
        assert np.array_equal(found, np.pad(whole[first : first + 800], (0, 800 - len(whole[first : first + 800]))))
    assert count == 1
    # Another recording under the same name is not taken for the old one.
    soundfile.write(path, np.zeros((rate, channels)), rate)
    os.utime(path, ns=(1, 1))
    assert not read_stretch(path, 0, 800, store).any()


def write_video(path: Path, samples: np.ndarray, rate: int, codec: str) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, layout="mono")
        resampler = av.AudioResampler(format=stream.format, layout="mono", rate=rate, frame_size=1024)
        frame = av.AudioFrame.from_ndarray(samples[None].astype("f4"), format="fltp", layout="mono")
        frame.sample_rate = rate
        for part in [*resampler.resample(frame), *resampler.resample(None)]:
            container.mux(stream.encode(part))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("suffix", [".flv", ".m4a", ".mp4", ".mkv"])
def test_sound_is_taken_out_of_videos(tmp_path: Path, suffix: str) -> None:
    time = np.arange(44100) / 44100
    write_video(tmp_path / f"v{suffix}", 0.5 * np.sin(2 * np.pi * 440 * time), 44100, "aac")
    speech = read_speech(tmp_path / f"v{suffix}")
    # AAC pads to whole frames of 1 024 samples and may prepend one or two.
    assert 16000 <= len(speech) <= 16000 + 3 * 1024
    spectrum = np.abs(np.fft.rfft(speech[2000:14000] * np.hanning(12000)))
    assert abs(spectrum.argmax() * 16000 / 12000 - 440) < 2
    assert 0.4 < np.abs(speech[2000:14000]).max() < 0.6


@pytest.mark.filterwarnings("ignore:.* of its sound are missing by its times:facediff.errors.Note")
@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize(("sound", "picture"), [(0.4, 0.0), (0.0, 0.4)])
def test_sound_keeps_its_time_beside_the_picture(tmp_path: Path, suffix: str, sound: float, picture: float) -> None:
    import av

    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(16_000) / 16_000).astype("f4")
    tone[:8000] = 0  # heard from 0.5 s of the sound on
    with av.open(str(tmp_path / f"v{suffix}"), "w") as container:
        video, voice = container.add_stream("libx264", rate=25), container.add_stream("aac", rate=16_000, layout="mono")
        video.width = video.height = 32
        video.codec_context.max_b_frames = 0
        for i in range(25):
            still = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
            still.pts, still.time_base = i + round(25 * picture), Fraction(1, 25)
            container.mux(video.encode(still))
        for i in range(0, len(tone), 1000):
            part = av.AudioFrame.from_ndarray(tone[None, i : i + 1000], format="fltp", layout="mono")
            part.pts, part.time_base, part.sample_rate = i + round(16_000 * sound), Fraction(1, 16_000), 16_000
            container.mux(voice.encode(part))
        for stream in (video, voice):
            container.mux(stream.encode(None))
    heard = np.flatnonzero(np.abs(read_speech(tmp_path / f"v{suffix}")) > 0.1)[0] / 16_000
    assert heard == pytest.approx(0.5 + sound - picture, abs=0.07)  # AAC spreads an onset over its frame of 0.064 s


def test_a_video_without_sound(tmp_path: Path) -> None:
    import av

    with av.open(str(tmp_path / "v.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width = stream.height = 32
        frame = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(FaceDiffError, match="no sound track"):
        read_speech(tmp_path / "v.mp4")
