"""Sound is read by its content and its times: any container under any name, holes, channels and tracks with a voice."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import soundfile

from facediff.errors import FaceDiffError, Note
from facediff.speech.audio import read_recording, read_speech, read_stretch, speech_of, stream_piece
from facediff.speech.pcm import pcm

RATE = 16_000
SAMPLES = npt.NDArray[np.floating]
TIMES = np.arange(2 * RATE) / RATE
# Syllables and pauses, as speech has them.
VOICE = (0.3 * np.sin(2 * np.pi * 220 * TIMES) * (np.sin(2 * np.pi * 2 * TIMES) > 0)).astype(np.float32)
HUM = (0.3 * np.sin(2 * np.pi * 50 * TIMES)).astype(np.float32)


def container(
    form: str,
    tracks: Sequence[SAMPLES],
    codec: str = "",
    *,
    pictures: int = 0,
    jumps: Sequence[tuple[float, float]] = (),
) -> bytes:
    """A file of sound tracks (S,); packets from each time on are shifted by seconds, or lost (infinity)."""
    av = pytest.importorskip("av")
    file = io.BytesIO()
    with av.open(file, "w", format=form) as out:
        muxed: list[Any] = []
        if pictures:
            video: Any = out.add_stream("flv1" if form == "flv" else "mpeg4", rate=25)
            video.width = video.height = 32
            frames = [av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8)) for _ in range(pictures)]
            muxed += [packet for frame in [*frames, None] for packet in video.encode(frame)]
        for samples in tracks:
            rate = 48_000 if codec in ("libopus", "ac3") else RATE
            stream: Any = out.add_stream(codec or "pcm_s16le", rate=rate, layout="mono")
            sound = av.AudioFrame.from_ndarray((samples * 32767).astype(np.int16)[None], format="s16", layout="mono")
            sound.sample_rate, sound.pts, sound.time_base = RATE, 0, Fraction(1, RATE)
            context = stream.codec_context
            context.format = stream.codec_context.codec.audio_formats[0] if codec == "ac3" else context.format
            parts = av.AudioResampler(context.format, "mono", rate, context.frame_size or 800)
            packets = [p for s in (sound, None) for part in parts.resample(s) for p in stream.encode(part)]
            for packet in [*packets, *stream.encode(None)]:
                passed = [by for at, by in jumps if float(packet.pts * packet.time_base) >= at - 1e-6]
                shift = 0.0 if passed[-1:] == [-np.inf] else sum(passed)
                if np.isfinite(shift):
                    packet.pts = packet.dts = packet.pts + round(shift / float(packet.time_base))
                    muxed.append(packet)
        out.mux(muxed)
    return file.getvalue()


def test_a_second_track_of_pictures_cuts_no_sound(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mkv"), "w") as out:
        sound: Any = out.add_stream("pcm_s16le", rate=RATE, layout="mono")
        films: list[Any] = [out.add_stream("mpeg4", rate=25) for _ in range(2)]
        packets = []
        for late, film in zip((0, 25), films, strict=True):
            film.width = film.height = 32
            for number in range(late, 50):
                frame = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8))
                frame.pts, frame.time_base = number, Fraction(1, 25)
                packets += film.encode(frame)
            packets += film.encode(None)
        piece = av.AudioFrame.from_ndarray((VOICE * 32767).astype(np.int16)[None], format="s16", layout="mono")
        piece.sample_rate = RATE
        out.mux([*packets, *sound.encode(piece), *sound.encode(None)])
    assert like(read_speech(tmp_path / "a.mkv"), VOICE) > 0.999


def shifted(flv: bytes, at: float, by: float) -> bytes:
    """The same .flv with its packets of sound from a time on shifted by seconds, also backwards."""
    content, place = bytearray(flv), 13
    while place < len(content):
        size, time = (int.from_bytes(content[place + k : place + k + 3], "big") for k in (1, 4))
        if content[place] == 8 and time >= 1000 * at and size > 4:
            content[place + 4 : place + 7] = (time + round(1000 * by)).to_bytes(3, "big")
        place += 15 + size
    return bytes(content)


def wav(samples: SAMPLES, subtype: str = "PCM_16", form: str = "WAV") -> bytes:
    file = io.BytesIO()
    soundfile.write(file, samples, RATE, format=form, subtype=subtype)
    return file.getvalue()


def like(found: SAMPLES, expected: SAMPLES) -> float:
    """The correlation of two recordings of about the same length."""
    assert abs(len(found) - len(expected)) < 0.2 * RATE
    length = min(len(found), len(expected))
    return float(np.corrcoef(found[:length], expected[:length])[0, 1])


FORMS = (
    "webm-libopus ipod-aac mp4-aac matroska- avi- flv-aac mpegts-mp2 adts-aac "
    "wav-adpcm_ms wav-libmp3lame caf- ogg-libopus asf-libmp3lame ac3-ac3"
)


@pytest.mark.parametrize(("form", "codec"), [form.split("-") for form in FORMS.split()])
@pytest.mark.parametrize("name", ["a.wav", "a.mp3", "a", "a.txt", "a.mp4"])
def test_any_container_is_read_under_any_name(form: str, codec: str, name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(container(form, [VOICE], codec))
    found = read_speech(path)
    assert abs(len(found) - len(VOICE)) < 0.15 * RATE
    assert max(like(found[delay:][: len(VOICE)], VOICE) for delay in range(0, 2400, 8)) > 0.9  # encoders have delays
    with path.open("rb") as file:
        np.testing.assert_array_equal(speech_of(file).speech, found)
    np.testing.assert_array_equal(speech_of(io.BytesIO(path.read_bytes())).speech, found)
    np.testing.assert_array_equal(read_stretch(path, 800, 1600, None), found[800:2400])


@pytest.mark.parametrize("sidecar", ["._a.mp3", "._a.wav", ".a.mp3"])
def test_files_beside_a_recording_do_not_count(sidecar: str, tmp_path: Path) -> None:
    path = tmp_path / sidecar.lstrip("._")
    path.write_bytes(wav(VOICE, "MPEG_LAYER_III", "MP3"))
    expected = read_speech(path)
    (tmp_path / sidecar).write_bytes(b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X" + bytes(4096))
    np.testing.assert_array_equal(read_speech(path), expected)


@pytest.mark.parametrize("riff", [0, 8, 36, 36 + 2 * len(VOICE)])
def test_a_wav_that_was_never_closed_is_read(riff: int, tmp_path: Path) -> None:
    content = bytearray(wav(VOICE))
    content[4:8], content[40:44] = struct.pack("<I", riff), bytes(4)
    (tmp_path / "a.wav").write_bytes(content)
    pytest.importorskip("av")
    assert like(read_speech(tmp_path / "a.wav"), VOICE) > 0.999


def test_a_recording_in_memory_that_is_cut_short_is_refused() -> None:
    with pytest.raises(FaceDiffError, match="cut short"):
        speech_of(io.BytesIO(wav(VOICE)[:-999]))


@pytest.mark.parametrize("form", ["mp4", "matroska", "flv"])
@pytest.mark.parametrize("pictures", [0, 50])
def test_sound_stays_where_its_times_have_it(form: str, pictures: int, tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"

    def read(*jumps: tuple[float, float]) -> SAMPLES:
        path.write_bytes(container(form, [VOICE], "" if form == "matroska" else "aac", pictures=pictures, jumps=jumps))
        return read_speech(path)

    whole = read()
    with pytest.warns(Note, match="missing by its times"):
        hole = read((0.75, 0.5))
    expected = np.concatenate([whole[: round(0.75 * RATE)], np.zeros(RATE // 2), whole[round(0.75 * RATE) :]])
    assert like(hole, expected) > 0.9
    if pictures or form in ("mp4", "matroska"):  # where a file without pictures has its own zero
        with pytest.warns(Note, match="missing by its times"):
            late = read((-1.0, 0.4))
        assert like(late, np.concatenate([np.zeros(round(0.4 * RATE)), whole])) > 0.9
    with pytest.raises(FaceDiffError, match="goes on 7200 s later"):
        read((1.0, 7200.0))


def test_a_hole_in_an_ogg_is_silence(tmp_path: Path) -> None:
    path = tmp_path / "a.ogg"
    path.write_bytes(container("ogg", [VOICE], "libopus"))
    whole = read_speech(path)
    path.write_bytes(container("ogg", [VOICE], "libopus", jumps=[(1.0, np.inf), (1.5, -np.inf)]))
    with pytest.warns(Note, match="missing by its times"):
        hole = read_speech(path)
    expected = whole.copy()
    expected[RATE : round(1.5 * RATE)] = 0
    assert like(hole, expected) > 0.9


def without_page(ogg: bytes, number: int) -> bytes:
    """An Ogg file without one of its pages."""
    starts = [match.start() for match in re.finditer(b"OggS\0", ogg)]
    return ogg[: starts[number]] + ogg[starts[number + 1] :]


def ogg_like(found: SAMPLES, expected: SAMPLES) -> float:
    """The same as :func:`like` for an Ogg file: libsndfile's Opus is 6.5 ms late where it begins late."""
    return max(like(found[delay:], expected[: len(expected) - delay]) for delay in range(0, 120, 8))


@pytest.mark.parametrize("subtype", ["VORBIS", "OPUS"])
def test_an_ogg_begins_where_its_pages_have_it(subtype: str, tmp_path: Path) -> None:
    path, voice = tmp_path / "a.ogg", np.concatenate([VOICE] * 4)
    path.write_bytes(wav(voice, subtype, "OGG"))
    whole = read_speech(path)  # without a note
    path.write_bytes(without_page(path.read_bytes(), 2))  # after two of headers
    with pytest.warns(Note, match="missing by its times"):
        found = read_speech(path)
    assert len(found) == len(whole)
    begin = int(np.flatnonzero(found)[0])
    assert begin > RATE / 2
    assert ogg_like(found[begin:], whole[begin:]) > 0.9
    with pytest.warns(Note, match="missing by its times"):
        np.testing.assert_array_equal(read_stretch(path, begin - 9, 99, None), found[begin - 9 : begin + 90])
    with pytest.raises(FaceDiffError, match="max_seconds"):
        read_speech(path, max_seconds=7.9)


@pytest.mark.parametrize("lost", [(0.1, 0.4), (0.3, 0.5), (0.6, 1.3)])
def test_sound_after_a_hole_in_the_first_page_of_an_ogg_is_in_time(lost: tuple[float, float], tmp_path: Path) -> None:
    path = tmp_path / "a.ogg"
    path.write_bytes(container("ogg", [VOICE], "libopus"))
    whole = read_speech(path)
    path.write_bytes(container("ogg", [VOICE], "libopus", jumps=[(lost[0], np.inf), (lost[1], -np.inf)]))
    with pytest.warns(Note, match="missing by its times"):
        found = read_speech(path)
    assert ogg_like(found[round(1.35 * RATE) :], whole[round(1.35 * RATE) :]) > 0.9


def test_times_that_go_back(tmp_path: Path) -> None:
    path = tmp_path / "a.flv"
    flv = container("flv", [VOICE], "aac")
    path.write_bytes(flv)
    whole = read_speech(path)
    path.write_bytes(shifted(flv, 1.024, -0.3))
    with pytest.warns(Note, match=r"0\.\d+ s of its sound have the times of sound before them"):
        overlap = read_speech(path)
    assert like(overlap, np.concatenate([whole[:RATE], whole[round(1.3 * RATE) :]])) > 0.9
    path.write_bytes(shifted(flv, 1.5, -1.5))  # a recorder that was started anew
    with pytest.warns(Note, match=r"begin anew at 1\.5\d s"):
        assert like(read_speech(path), whole) > 0.999


@pytest.mark.parametrize("other", [-1.0, -0.8, -0.5, -0.3])
@pytest.mark.parametrize("subtype", ["PCM_16", "FLOAT", "MPEG_LAYER_III", "aac"])
def test_channels_that_cancel_are_not_averaged(other: float, subtype: str, tmp_path: Path) -> None:
    path, stereo = tmp_path / "a.wav", np.stack([other * VOICE, VOICE], axis=1)
    if subtype == "aac":
        av = pytest.importorskip("av")
        with av.open(str(path), "w", format="ipod") as out:
            stream: Any = out.add_stream("aac", rate=RATE, layout="stereo")
            frame = av.AudioFrame.from_ndarray(np.ascontiguousarray(stereo.T), format="fltp", layout="stereo")
            frame.sample_rate = RATE
            parts = av.AudioResampler("fltp", "stereo", RATE, 1024)
            out.mux([p for s in (frame, None) for part in parts.resample(s) for p in stream.encode(part)])
            out.mux(stream.encode(None))
    else:
        path.write_bytes(wav(stereo, subtype, "MP3" if "MPEG" in subtype else "WAV"))
    with pytest.warns(Note, match="alone is taken"):
        found = read_speech(path)
    level = np.sqrt(np.mean(found**2) / np.mean(VOICE**2))
    assert 0.9 < level < 1.1
    with pytest.warns(Note, match="channel 1 alone is taken"):
        np.testing.assert_allclose(speech_of(stereo.T[::-1], RATE).speech, VOICE, atol=1e-6)


def test_channels_that_cancel_for_a_while_are_not_averaged() -> None:
    turned = np.where(np.arange(len(VOICE)) < RATE, VOICE, -VOICE)
    with pytest.warns(Note, match="cancel"):
        np.testing.assert_allclose(speech_of(np.stack([VOICE, turned], 1), RATE).speech, VOICE, atol=1e-6)


@pytest.mark.parametrize("channels", [2, 6, 8])
def test_channels_without_sound_do_not_soften_the_others(channels: int, tmp_path: Path) -> None:
    samples = np.zeros((len(VOICE), channels), np.float32)
    samples[:, 1] = VOICE
    (tmp_path / "a.wav").write_bytes(wav(samples))
    np.testing.assert_allclose(read_speech(tmp_path / "a.wav"), VOICE, atol=1e-4)
    samples[:, 0] = np.roll(VOICE, RATE // 4)  # another speaker, in turn
    np.testing.assert_allclose(speech_of(samples, RATE).speech, samples[:, :2].mean(axis=1), atol=1e-6)


@pytest.mark.parametrize("first", [0 * VOICE, HUM, 1e-5 * VOICE])
def test_the_track_with_the_voice_is_taken(first: SAMPLES, tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    path.write_bytes(container("matroska", [first, VOICE]))
    with pytest.warns(Note, match="sound track 2 of 2"):
        assert like(read_speech(path), VOICE) > 0.999
    path.write_bytes(container("matroska", [VOICE, first]))
    assert like(read_speech(path), VOICE) > 0.999
    path.write_bytes(container("matroska", [VOICE, np.roll(VOICE, RATE)]))  # a dubbed film
    assert like(read_speech(path), VOICE) > 0.999


@pytest.mark.parametrize("dtype", [np.int16, np.int32])
@pytest.mark.parametrize("floating", [np.float16, np.float32, np.float64])
def test_whole_numbers_in_floating_point_are_scaled(dtype: Any, floating: Any, tmp_path: Path) -> None:  # noqa: ANN401
    whole = (VOICE * np.iinfo(dtype).max).astype(dtype)
    if floating is np.float16 and dtype is np.int32:
        return
    expected = speech_of(whole, RATE).speech
    with pytest.warns(Note, match="they are divided by"):
        np.testing.assert_allclose(speech_of(whole.astype(floating), RATE).speech, expected, atol=1e-3)
    soundfile.write(tmp_path / "a.wav", whole.astype(np.float32), RATE, subtype="FLOAT")
    with pytest.warns(Note, match="they are divided by"):
        found = read_recording(tmp_path / "a.wav")
    np.testing.assert_allclose(found.speech, expected, atol=1e-6)
    assert np.abs(found.sound).max() <= 1
    with pytest.warns(Note, match="they are divided by"):
        np.testing.assert_allclose(read_stretch(tmp_path / "a.wav", 9, 99, None), expected[9:108], atol=1e-6)
    with pytest.raises(FaceDiffError, match="full scale of 1"):
        stream_piece(whole.astype(np.float32))


def test_samples_of_8_bits_are_as_loud_as_those_of_16() -> None:
    expected = speech_of(np.round(VOICE * 32768).astype(np.int16), RATE).speech
    found = speech_of(np.round(VOICE * 128 + 128).astype(np.uint8), RATE).speech
    np.testing.assert_allclose(found, expected, atol=0.5 / 128 + 1e-6)
    assert np.std(found) == pytest.approx(np.std(expected), rel=2e-3)


def test_sound_that_is_a_little_too_loud_is_divided_by_its_peak() -> None:
    with pytest.warns(Note, match="reach 1.8"):
        found = speech_of(VOICE * 6, RATE)
    np.testing.assert_allclose(found.sound, VOICE / 0.3, atol=1e-5)


@pytest.mark.parametrize("form", ["webm", "mp4", "flv", "ogg", "wav", "caf", "aiff", "rf64"])
def test_a_file_in_place_of_samples_is_named(form: str) -> None:
    if form == "rf64":
        content = wav(VOICE, form="RF64")
    else:
        codec = {"webm": "libopus", "ogg": "libopus", "mp4": "aac", "flv": "aac", "aiff": "pcm_s16be"}.get(form, "")
        content = container(form, [VOICE], codec)
    source = io.BytesIO(content)
    source.fileno = lambda: 0  # type: ignore[method-assign]
    with pytest.raises(FaceDiffError, match="holds a sound file"):
        list(pcm(source, RATE, lambda _, size: source.read(size)))
