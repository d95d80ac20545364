"""Whether a recording is whole: what its container declares, compared with the bytes that there are.

Decoders return the samples that they find, and only some of them say that there should be more. A recording that was
cut short by a full disk or a broken download would be animated as far as it goes. Programs that write to a pipe do not
know the length; what they put in its place is recognised, and such recordings are whole.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from facediff.errors import FaceDiffError

Bytes = mmap.mmap

OPEN_ENDS = (range(0x7FFF_F000, 0x8000_0001), range(0xFFFF_0000, 0x1_0000_0000))
"""Sizes that programs put into a header of 32 bits when they write to a pipe (SoX and ALSA; FFmpeg)."""

CUT = "is cut short"


def refuse_cut_short(path: Path) -> None:
    """Refuse a recording that ends before its container says."""
    missing = cut_short(path)
    if missing is not None:
        raise FaceDiffError(
            f"{path}: {CUT}: {missing}; copy it again, or convert what there is with ffmpeg if that is all you want"
        )


def cut_short(path: Path) -> str | None:
    """What a recording lacks at its end; None if it is whole, or of a format whose decoder reports it.

    Wav, AIFF, MP4, Ogg and mp3 are checked, by their headers only; others, such as flac, are left to the decoder.

    Args:
        path: the file, which must not be empty.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        head = data[:12]
        if head[:4] in (b"RIFF", b"RF64", b"BW64") and head[8:] == b"WAVE":
            return _chunks(data, "<4sI", b"data")
        if head[:4] in (b"RIFX", b"FORM"):
            return _chunks(data, ">4sI", b"data" if head[:4] == b"RIFX" else b"SSND")
        if head[:4] == b"OggS":
            return _ogg(data)
        if head[4:8] in (b"ftyp", b"wide", b"mdat", b"moov"):
            return _boxes(data)
        return None if head[:4] == b"fLaC" else _mpeg(data)


def _bytes(count: int) -> str | None:
    return f"{count} bytes are missing at its end" if count > 0 else None


def _chunks(data: Bytes, form: str, samples: bytes) -> str | None:
    """Wav and AIFF: chunks with a name of 4 bytes and a size each, one of which holds the samples."""
    at, large = 12, None
    while at + 8 <= len(data):
        name, size = struct.unpack_from(form, data, at)
        at += 8
        if name == b"ds64" and at + 16 <= len(data):  # the size of the samples in 64 bits, for files above 4 GiB
            large = struct.unpack_from("<Q", data, at + 8)[0]
        if name == samples:
            size = large if large is not None and size == 0xFFFF_FFFF else size
            is_open = any(size in sizes for sizes in OPEN_ENDS)
            return None if is_open else _bytes(at + size - len(data))
        at += size + size % 2
    return None


def _ogg(data: Bytes) -> str | None:
    """Ogg: pages, of which the last one is marked."""
    at, last = 0, False
    while at + 27 <= len(data):
        if data[at : at + 4] != b"OggS":
            at = data.find(b"OggS", at)
            if at < 0:  # other things follow the last page
                break
            continue
        segments = data[at + 27 : at + 27 + data[at + 26]]
        end = at + 27 + data[at + 26] + sum(segments)
        if len(segments) < data[at + 26] or end > len(data):
            return "its last page is incomplete"
        last, at = bool(data[at + 5] & 4), end
    return None if last else "its last page is missing"


def _boxes(data: Bytes) -> str | None:
    """MP4 and QuickTime: boxes with a size and a name each; one of size 0 reaches to the end."""
    at = 0
    while at + 8 <= len(data):
        size = struct.unpack_from(">I", data, at)[0]
        if size == 1 and at + 16 <= len(data):
            size = struct.unpack_from(">Q", data, at + 8)[0]
        if size < 8:
            return None
        at += size
    return _bytes(at - len(data))


# MPEG audio (mp3): frames without a container. Only a first frame that encoders add says how many there are.

BITRATES = {  # kbit/s by layer and whether the sample rate is one of MPEG 1, by index from 1 on
    (1, True): (32, 64, 96, 128, 160, 192, 224, 256, 288, 320, 352, 384, 416, 448),
    (2, True): (32, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320, 384),
    (3, True): (32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320),
    (1, False): (32, 48, 56, 64, 80, 96, 112, 128, 144, 160, 176, 192, 224, 256),
    (2, False): (8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
    (3, False): (8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160),
}
RATES = {3: (44_100, 48_000, 32_000), 2: (22_050, 24_000, 16_000), 0: (11_025, 12_000, 8_000)}
GARBAGE = 100_000
"""Places without a frame after which the search for the next one is given up; no recording has so many."""
TAGS = (b"TAG", b"APETAGEX", b"LYRICSBEGIN", b"ID3", b"3DI")
"""How the tags begin that may follow the last frame."""


def _frame_bytes(header: bytes) -> int | None:
    """Bytes of the frame of MPEG audio that begins with these 4; None if none does."""
    if len(header) < 4 or header[0] != 0xFF or header[1] & 0xE0 != 0xE0:
        return None
    version, layer = header[1] >> 3 & 3, 4 - (header[1] >> 1 & 3)
    index, rate_index, padding = header[2] >> 4, header[2] >> 2 & 3, header[2] >> 1 & 1
    if version == 1 or layer == 4 or rate_index == 3 or index in (0, 15):
        return None
    bitrate, rate = BITRATES[layer, version == 3][index - 1] * 1000, RATES[version][rate_index]
    if layer == 1:
        return (12 * bitrate // rate + padding) * 4
    return (72 if layer == 3 and version != 3 else 144) * bitrate // rate + padding


def _mpeg(data: Bytes) -> str | None:
    at = 0
    while data[at : at + 3] == b"ID3" and at + 10 <= len(data):
        sevens = data[at + 6 : at + 10]
        at += 10 + (sevens[0] << 21 | sevens[1] << 14 | sevens[2] << 7 | sevens[3])
    first = _frame_bytes(data[at : at + 4])
    if first is None or (at + first < len(data) and _frame_bytes(data[at + first : at + first + 4]) is None):
        return None
    declared = _declared_frames(data[at : at + first])
    walked, skipped = 0, 0
    while at < len(data) and skipped < GARBAGE:
        size = _frame_bytes(data[at : at + 4])
        if size is not None and at + size <= len(data):
            at, walked = at + size, walked + 1
        elif size is not None:
            return "its last frame is incomplete"
        elif data[at : at + 16].startswith(TAGS) or len(data) - at < 4:
            break
        else:  # garbage or padding: go on with the next frame
            at, skipped = data.find(b"\xff", at + 1), skipped + 1
            if at < 0:
                break
    # The frame that declares does not count itself; some encoders count it nevertheless.
    if declared is not None and skipped < GARBAGE and walked - 1 < declared - 1:
        return f"{walked - 1} of {declared} frames are there"
    return None


def _declared_frames(frame: bytes) -> int | None:
    """Frames of the file, as its first frame may declare them."""
    for mark, flags, count in ((b"Xing", 4, 8), (b"Info", 4, 8), (b"VBRI", None, 14)):
        at = frame.find(mark, 4, 80)
        if at >= 0 and at + count + 4 <= len(frame):
            if flags is not None and not frame[at + flags + 3] & 1:
                return None
            return int.from_bytes(frame[at + count : at + count + 4], "big") or None
    return None
