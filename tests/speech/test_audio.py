"""Recordings that are cut short, absurd or hostile are refused in one sentence before they are decoded."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from facediff.errors import FaceDiffError
from facediff.speech.audio import cut_short, read_speech, read_stretch
from facediff.utils.arrays import ArrayStore

RATE = 16_000
SECONDS = 3
TONE = 0.1 * np.sin(np.arange(SECONDS * RATE) * 0.2) + 0.02 * np.random.default_rng(0).standard_normal(SECONDS * RATE)

SOUNDFILES: dict[str, tuple[str, str]] = {
    "plain.wav": ("WAV", "PCM_16"),
    "float.wav": ("WAV", "FLOAT"),
    "extensible.wav": ("WAVEX", "PCM_24"),
    "large.wav": ("RF64", "PCM_16"),
    "blocks.wav": ("WAV", "IMA_ADPCM"),
    "a.aiff": ("AIFF", "PCM_16"),
    "a.aifc": ("AIFF", "ULAW"),
    "a.flac": ("FLAC", "PCM_16"),
    "vorbis.ogg": ("OGG", "VORBIS"),
    "a.opus": ("OGG", "OPUS"),
    "a.mp3": ("MP3", "MPEG_LAYER_III"),
}
VIDEOS: dict[str, tuple[str, str | None, dict[str, str]]] = {
    "a.m4a": ("aac", "mp4", {}),
    "fast.mp4": ("aac", "mp4", {"movflags": "+faststart"}),
    "pieces.mp4": ("aac", "mp4", {"movflags": "+frag_keyframe+empty_moov"}),
    "a.mov": ("pcm_s16le", None, {}),
    "a.mkv": ("aac", None, {}),
    "a.flv": ("aac", None, {}),
    "a.avi": ("libmp3lame", None, {}),
    "a.aac": ("aac", "adts", {}),
    "unmarked.mp3": ("libmp3lame", None, {"write_xing": "0"}),
    "id3.mp3": ("libmp3lame", None, {"id3v2_version": "4"}),
}


def recording(folder: Path, name: str) -> Path:
    path = folder / name
    if name in SOUNDFILES:
        form, subtype = SOUNDFILES[name]
        soundfile.write(path, TONE, RATE, format=form, subtype=subtype)
        return path
    av = pytest.importorskip("av")
    codec, form_name, options = VIDEOS[name]
    rate = 44_100 if name == "a.flv" else RATE
    with av.open(str(path), "w", format=form_name, options=options) as container:
        stream: Any = container.add_stream(codec, rate=rate, layout="mono")
        whole = av.AudioFrame.from_ndarray((TONE * 32767).astype(np.int16)[None], format="s16", layout="mono")
        whole.sample_rate = RATE
        made = av.AudioResampler(stream.codec_context.format, "mono", rate, stream.codec_context.frame_size or 1024)
        packets = [packet for frame in (whole, None) for part in made.resample(frame) for packet in stream.encode(part)]
        container.mux([*packets, *stream.encode(None)])
    return path


# Of other containers, what was cut off is not noticed.
@pytest.mark.parametrize(
    "name", [name for name in (*SOUNDFILES, *VIDEOS) if not name.endswith((".mp3", ".aac", ".mkv", ".flv", ".avi"))]
)
def test_recording_that_is_cut_short_is_refused(name: str, tmp_path: Path) -> None:
    path = recording(tmp_path, name)
    assert cut_short(path) is None
    assert abs(len(read_speech(path)) / RATE - SECONDS) < 0.1
    data = path.read_bytes()
    for share in (0.97, 0.5, 0.11):
        path.write_bytes(data[: int(len(data) * share)])
        with pytest.raises(FaceDiffError, match=name) as refused:
            read_speech(path)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["plain.wav", "a.flac", "vorbis.ogg", "a.m4a"])
def test_tags_and_other_things_after_the_samples_do_not_make_a_recording_cut_short(name: str, tmp_path: Path) -> None:
    path = recording(tmp_path, name)
    expected = len(read_speech(path))
    after = {"plain.wav": b"LIST\x04\x00\x00\x00INFO", "a.m4a": b"\x00\x00\x00\x10free" + bytes(8)}
    path.write_bytes(path.read_bytes() + after.get(name, b"TAG" + bytes(125)))
    assert cut_short(path) is None
    assert len(read_speech(path)) == expected


def wave(
    *, rate: int = RATE, channels: int = 1, bits: int = 16, form: int = 1, size: int | None = None, body: bytes = b""
) -> bytes:
    """A wav file with any header."""
    block = channels * bits // 8
    facts = struct.pack("<HHIIHH", form, channels, rate, (rate * block) % 2**32, block % 2**16, bits)
    head = b"RIFF" + struct.pack("<I", 36 + len(body)) + b"WAVEfmt " + struct.pack("<I", len(facts)) + facts
    return head + b"data" + struct.pack("<I", len(body) if size is None else size) + body


PCM = (TONE * 32767).astype("<i2").tobytes()


@pytest.mark.parametrize("size", [0xFFFFFFFF, 0xFFFFFFFF - 44, 0x7FFFF000, 0x80000000])
def test_wav_from_a_pipe_whose_header_tells_no_length_is_read(size: int, tmp_path: Path) -> None:
    (tmp_path / "a.wav").write_bytes(wave(size=size, body=PCM))
    assert len(read_speech(tmp_path / "a.wav")) == len(TONE)


def flac(*, rate: int = RATE, channels: int = 1, samples: int = 2**36 - 1) -> bytes:
    """The first block of a flac file, which declares everything, and nothing else."""
    packed = rate << 44 | (channels - 1) << 41 | 15 << 36 | samples
    info = struct.pack(">HH", 4096, 4096) + bytes(6) + packed.to_bytes(8, "big") + bytes(16)
    return b"fLaC\x80\x00\x00\x22" + info


def not_finite(value: float) -> bytes:
    samples = TONE.astype("<f4")
    samples[99] = value
    return wave(form=3, bits=32, body=samples.tobytes())


HOSTILE: dict[str, bytes] = {
    "no rate.wav": wave(rate=0, body=PCM),
    "no channel.wav": wave(channels=0, body=PCM),
    "no samples.wav": wave(body=b""),
    "NaN.wav": not_finite(np.nan),
    "infinite.wav": not_finite(-np.inf),
    "absurd.wav": not_finite(1e35),
    "declares terabytes.flac": flac(),
    "text.mp3": b"no sound at all\n" * 99,
    "playlist.mp4": b"#EXTM3U\n#EXTINF:6,\nsecret.aac\n#EXT-X-ENDLIST\n",
    "list.mkv": b"ffconcat version 1.0\nfile secret.wav\n",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_recording_is_refused_by_name(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(HOSTILE[name])
    (tmp_path / "secret.wav").write_bytes(wave(body=PCM))
    with pytest.raises(FaceDiffError, match=name.replace(".", r"\.")) as refused:
        read_speech(path)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400 + len(str(tmp_path))


def test_limit_is_checked_before_samples_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recording(tmp_path, "plain.wav")
    assert len(read_speech(path, max_seconds=SECONDS)) == len(TONE)
    monkeypatch.setattr(soundfile.SoundFile, "read", lambda *_, **__: pytest.fail("decoded"))
    with pytest.raises(FaceDiffError, match="max_seconds 2.5"):
        read_speech(path, max_seconds=2.5)


def test_stretch_of_a_recording_that_is_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.wav"
    for content in (wave(body=PCM)[:-1000], b"", b"RIFF"):
        path.write_bytes(content)
        for store in (None, ArrayStore(tmp_path / "cache")):
            with pytest.raises(FaceDiffError, match=r"a\.wav"):
                read_stretch(path, 0, 100, store)


def test_name_that_is_not_utf8_is_read(tmp_path: Path) -> None:
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe.wav"))
    path.write_bytes(wave(body=PCM))
    assert len(read_speech(path)) == len(TONE)
    path.write_bytes(b"no sound")
    with pytest.raises(FaceDiffError):
        read_speech(path)
