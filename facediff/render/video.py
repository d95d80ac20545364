"""Frames and sound to a video file, encoded in this process by PyAV: H.264 and AAC in .mp4, VP9 and Opus in .webm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import needs_extra
from facediff.utils.files import atomic

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

Frame = npt.NDArray[np.uint8]

AAC_RATES = (96000, 88200, 64000, 48000, 44100, 32000, 24000, 22050, 16000, 12000, 11025, 8000)
"""Rates (Hz) that AAC supports; sound of any other rate is resampled to 48 kHz."""

X264_OPTIONS = {"crf": "15", "preset": "veryfast", "threads": "1"}
"""As close to the pictures as "medium" at 18, in half its time and with files a fifth larger.

One thread, since x264's output depends on the number of threads, which would otherwise follow the machine.
"""

VP9_OPTIONS = {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "0", "threads": "1"}
"""Constant quality, which needs a bit rate of 0, on one thread like x264."""

OPUS_RATES = (48000, 24000, 16000, 12000, 8000)
"""Rates (Hz) that Opus supports."""


class Codecs(NamedTuple):
    """A container: the names and options of its encoders, and the rates that its sound may have."""

    video: str
    options: Mapping[str, str]
    audio: str
    rates: tuple[int, ...]
    container: Mapping[str, str]


CONTAINERS = {
    ".mp4": Codecs("libx264", X264_OPTIONS, "aac", AAC_RATES, {"movflags": "+faststart"}),
    ".webm": Codecs("libvpx-vp9", VP9_OPTIONS, "libopus", OPUS_RATES, {}),
}

CHUNK = 1024


def write_video(
    path: str | Path,
    frames: Iterable[Frame],
    frame_rate: float | Fraction,
    audio: npt.NDArray[np.float32] | None = None,
    sample_rate: int | None = None,
) -> int:
    """Write a video with sound that starts with its first frame.

    The file appears under its name only when it is complete: until then it is a hidden sibling, which is removed if
    anything fails (so is every folder that had to be made). The same input gives the same pictures bit by bit; the
    sound may differ inaudibly, since FFmpeg's AAC encoder now and then chooses other bits for the same samples.

    Args:
        path: ends in ".mp4" (H.264 and AAC, which every player shows) or ".webm" (VP9 and Opus, for browsers without
            H.264); missing folders are made.
        frames: pictures (height, width, 3), sRGB, all of one size; read one by one. An odd size is made even, as
            H.264 requires, by repeating the last row or column.
        frame_rate: frames per second.
        audio: mono sound (samples,) with full scale 1, or None for a silent video. All of it is written, even where it
            is longer than the picture.
        sample_rate: of the sound in Hz.

    Returns:
        The number of frames written.

    Example:
        >>> frames = (renderer.render(vertices) for vertices in motion)  # doctest: +SKIP
        >>> write_video("hello.mp4", frames, 25, speech, 16_000)  # doctest: +SKIP
        127
    """
    with needs_extra("av", "render", "writing videos"):
        import av
    codecs = CONTAINERS[Path(path).suffix.lower()]
    rate = Fraction(frame_rate).limit_denominator(1001)
    sound = None if audio is None else np.asarray(audio, np.float32)
    pictures = iter(frames)
    first = next(pictures)  # sets the size
    # Opening creates the file; bitexact keeps version strings and dates out of it.
    options = {**codecs.container, "fflags": "+bitexact"}
    with atomic(Path(path)) as partial, av.open(str(partial), "w", options=options) as container:
        encoder = _Encoder(container, rate, (first.shape[0], first.shape[1]), sound, sample_rate or 0, codecs)
        return encoder.run(chain([first], pictures))


class _Encoder:
    """The two streams of one file, filled in turn so that neither waits in memory for the other."""

    def __init__(
        self,
        container: OutputContainer,
        rate: Fraction,
        size: tuple[int, int],
        sound: npt.NDArray[np.float32] | None,
        hertz: int,
        codecs: Codecs,
    ) -> None:
        import av
        from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

        self.container, self.rate, self.size, self.sound, self.hertz = container, rate, size, sound, hertz
        self.pictures = self.encoded_samples = 0
        stream = container.add_stream(codecs.video, rate=rate, options=dict(codecs.options))
        self.video = cast("VideoStream", stream)
        self.video.height, self.video.width = (side + side % 2 for side in size)
        self.video.pix_fmt = "yuv420p"
        context = self.video.codec_context
        context.time_base = 1 / rate
        context.gop_size = max(round(2 * rate), 1)  # a key frame every two seconds, so that players can seek
        # Without these tags players guess, and colours differ from one to the next.
        context.colorspace, context.color_range = Colorspace.ITU709, ColorRange.MPEG
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
        self.audio: Any = None
        if sound is not None:
            out_rate = hertz if hertz in codecs.rates else 48000
            # AAC allows 6 bits per sample and channel.
            bit_rate = min(128_000, 6 * out_rate)
            self.audio = container.add_stream(codecs.audio, rate=out_rate, layout="mono", bit_rate=bit_rate)
            # Sound of the same rate passes unchanged.
            self.resampler = av.AudioResampler(format="fltp", layout="mono", rate=out_rate)

    def run(self, frames: Iterable[Frame]) -> int:
        """Encode all frames and all of the sound; returns the number of frames."""
        for frame in frames:
            self.add_frame(frame)
            if self.pictures > 1:
                self.add_sound(int(self.pictures / self.rate * self.hertz))
        self.container.mux(self.video.encode(None))
        if self.sound is not None:
            self.add_sound(len(self.sound))
            for part in self.resampler.resample(None):
                self.container.mux(self.audio.encode(part))
            self.container.mux(self.audio.encode(None))
        return self.pictures

    def add_frame(self, frame: Frame) -> None:
        """Encode one picture."""
        import av
        from av.video.reformatter import ColorRange, Colorspace

        height, width = self.size
        frame = frame.reshape(height, width, 3)  # FFmpeg would stretch a picture of another size
        if height % 2 or width % 2:
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        picture = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
        picture.pts, picture.time_base = self.pictures, 1 / self.rate
        self.pictures += 1
        self.container.mux(self.video.encode(picture))

    def add_sound(self, until: int) -> None:
        """Encode the sound up to a sample, or a little less (whole chunks) unless that is its end."""
        import av

        if self.sound is None:
            return
        until = min(until, len(self.sound))
        while self.encoded_samples < until:
            chunk = self.sound[self.encoded_samples : self.encoded_samples + CHUNK]
            if self.encoded_samples + len(chunk) > until:
                break
            frame = av.AudioFrame.from_ndarray(np.clip(chunk[None], -1, 1), format="fltp", layout="mono")
            frame.sample_rate, frame.pts = self.hertz, self.encoded_samples
            frame.time_base = Fraction(1, self.hertz)
            self.encoded_samples += len(chunk)
            for part in self.resampler.resample(frame):
                self.container.mux(self.audio.encode(part))
