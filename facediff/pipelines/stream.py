"""Speech that arrives in pieces, such as samples from standard input, to frames of animation once these are certain."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.animation.options import AnimationOptions, ExportOptions
from facediff.errors import FaceDiffError, OptionError
from facediff.pipelines.animate import AnimationPipeline, check_options, direction_for
from facediff.speech.pcm import pcm
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import atomic, check_writable

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor


def animate_stream(options: AnimationOptions, output: Path, export: ExportOptions, *, rate: int = 16_000) -> None:
    """Animate samples of standard input as they come, until they end or Ctrl-C ends them.

    Args:
        options: of inference; what needs the whole animation is refused.
        output: a .npy file, or ``-`` for raw float32 vertices to standard output.
        export: what the whole animation needs of it is refused as well.
        rate: sample rate of the 16-bit mono samples.

    Raises:
        FaceDiffError: if an option is impossible, or the speech ends before a frame.
    """
    check_stream(options, output, export)

    pipeline = AnimationPipeline(options)
    model = pipeline.model
    plan = model.windows
    template = model.assets.template(pipeline.identity)
    busy, heard = 0.0, 0
    with sink(output, tuple(template.shape)) as write, ended_by_interrupt() as read:
        live = LiveAnimation(pipeline, rate=rate)
        report(
            f"ready; look-ahead {pipeline.look_ahead:.2f} s and the time that a window takes; "
            f"{plan.in_frames(model.frame_rate).hop} frames at a time, {model.frame_rate:g} a second, "
            f"{len(template)} vertices; reading {rate} Hz, 16 bit"
        )
        for samples in pcm(sys.stdin.buffer, rate, read):
            started = time.perf_counter()
            part = live.feed(samples)
            busy += time.perf_counter() - started
            heard += len(samples)
            write(part)
        if not heard:
            raise FaceDiffError("standard input: ended before any sample came; send 16-bit mono PCM to it")
        started = time.perf_counter()
        part = live.finish()
        busy += time.perf_counter() - started
        write(part)
    report(f"{heard / rate:.2f} s of speech; real-time factor {busy / max(heard / rate, 1e-9):.2f}")


class LiveAnimation:
    """Animates speech of any length and any sample rate while it arrives; memory does not grow with its length.

    The frames are those of the recording as a whole, however the speech is cut into pieces.

    Args:
        pipeline: the model with its options, of which this keeps what is chosen now.
        rate: sample rate of the speech.

    Raises:
        FaceDiffError: if the style or the windows do not fit the model.
    """

    def __init__(self, pipeline: AnimationPipeline, *, rate: int = SAMPLE_RATE) -> None:
        import numpy as np

        from facediff.speech.audio import resampler

        self._pipeline, model, self._seed = pipeline, pipeline.model, pipeline.options.seed or 0
        self._chosen = model.choices()
        self._template = model.assets.template(pipeline.identity)
        self._convert = None if rate == SAMPLE_RATE else resampler(rate)
        with pipeline.precision():  # the style is encoded within it as well, as it is for a file
            self._stream = pipeline.stream([self._seed])

        self._rest = pipeline.rest
        self._openness = None if self._rest is None else self._rest.openness()
        self._face = pipeline.face
        if self._face is not None:
            self._face.refuse_whole_animation()
        self._performer = pipeline.performer(self._seed)
        # Frames of the model, how far their mouths may be open, and how they are acted, whichever is certain first.
        self._held = np.zeros((0, *self._template.shape), np.float32)
        self._opened = np.zeros(0, np.float32)
        self._acted = np.zeros((0, 5))
        self._given = 0

    @property
    def made(self) -> int:
        """Frames that the model has generated so far; some of them may wait for the gate or for acting."""
        return self._stream.frames

    def feed(self, samples: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Hear samples (n,), and give the frames (m, V, 3) that are certain now; m may be 0."""
        speech = samples if self._convert is None else self._convert(samples, False)
        return self._hear(speech)

    def _hear(self, speech: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The frames that are certain after more speech (n,) at 16 kHz."""
        import numpy as np

        with self._pipeline.model.choosing(self._chosen), self._pipeline.precision():
            made = self._first(self._stream.feed(speech))
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.feed(speech)])
        if self._performer is not None:
            self._acted = np.concatenate([self._acted, self._performer.feed(speech)])
        return self._finished(made)

    def _finished(self, made: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """With more frames of the model, those of which all is known, with the mouth at rest in pauses, and acted."""
        import numpy as np

        if self._openness is None and self._performer is None and self._face is None:
            return made
        held = np.concatenate([self._held, made]) if len(self._held) else made
        count = len(held)
        if self._openness is not None:
            count = min(count, len(self._opened))
        if self._performer is not None:
            count = min(count, len(self._acted))
        part, opened, moves = held[:count], self._opened[:count], self._acted[:count]
        self._held, self._opened, self._acted = held[count:], self._opened[count:], self._acted[count:]
        if self._openness is not None:
            part = self._pipeline.at_rest(part, opened)
        if self._face is not None and count:
            animation = self._pipeline.animation_of(part)
            acted = None if self._performer is None else moves
            part = self._face.apply(animation, seed=self._seed, start=self._given, acted=acted).vertices
        self._given += count
        return part

    def finish(self) -> npt.NDArray[np.float32]:
        """The frames (m, V, 3) that are left.

        Raises:
            FaceDiffError: if the speech was shorter than a frame.
        """
        import numpy as np

        with self._pipeline.model.choosing(self._chosen), self._pipeline.precision():
            last = []
            if self._convert is not None:
                rest = self._convert(np.zeros(0, np.float32), True)
                last.append(self._hear(rest))
            made = self._first(self._stream.finish())
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.finish(self._stream.frames)])
        if self._performer is not None:
            self._acted = np.concatenate([self._acted, self._performer.finish(self._stream.frames)])
        return np.concatenate([*last, self._finished(made)])

    def _first(self, motion: Tensor) -> npt.NDArray[np.float32]:
        """Vertices of the first sample."""
        vertices: npt.NDArray[np.float32] = motion[0].numpy()
        return vertices


WHOLE = (
    "expressiveness",
    "blinks",
    "gaze",
    "sway",
    "target_mesh",
    "output_unit",
    "up",
    "samples",
    "denoise",
    "alignment",
    "transcript",
)
"""Options that need the whole animation."""


def check_stream(options: AnimationOptions, output: Path, export: ExportOptions) -> None:
    """Refuse what streaming cannot do."""
    if options.direction is not None:
        options = replace(options, direction=direction_for(options.direction, Path("-"), streamed=True))
    check_options(options)
    if str(output) != "-" and output.suffix != ".npy":
        raise OptionError(
            "output",
            "a stream is written as .npy, or as raw float32 to standard output with -o -; `facediff export` turns the "
            ".npy into other formats",
            output,
        )
    given = {**options.changed(), **export.changed()}
    for name in WHOLE:
        if name in given:
            raise OptionError(name, "needs the whole animation; stream to .npy, then use `facediff export`")
    if sys.stdin is None:
        raise FaceDiffError("--stream: standard input is closed; send samples to it")
    if str(output) != "-":
        check_writable(output)


def report(sentence: str) -> None:
    """Print to standard error, since standard output may be the stream."""
    print(f"facediff animate: {sentence}", file=sys.stderr, flush=True)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while the command waits for samples."""


@contextmanager
def ended_by_interrupt() -> Iterator[Callable[[int, int], bytes]]:
    """An ``os.read`` that returns nothing more after Ctrl-C, by which most recordings end; a second Ctrl-C stops.

    A handler of Ctrl-C that somebody else has installed stays in place.
    """
    stopped = reading = False

    def hear(*_: object) -> None:
        nonlocal stopped
        if stopped:
            raise KeyboardInterrupt
        stopped = True
        if reading:
            raise Interrupted

    def read(descriptor: int, size: int) -> bytes:
        nonlocal reading
        try:
            reading = True
            return b"" if stopped else os.read(descriptor, size)
        except Interrupted:
            return b""
        finally:
            reading = False

    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield os.read
        return
    signal.signal(signal.SIGINT, hear)
    try:
        yield read
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def sink(output: Path, frame: tuple[int, ...]) -> Iterator[Callable[[npt.NDArray[np.float32]], None]]:
    """Where frames (n, V, 3) go: a .npy file that appears when it is complete, or standard output."""
    from facediff.animation.files import MotionWriter

    if str(output) == "-":

        def write(vertices: npt.NDArray[np.float32]) -> None:
            sys.stdout.buffer.write(vertices.astype("<f4").tobytes())
            sys.stdout.buffer.flush()

        yield write
        return
    with atomic(output) as temporary:
        writer = MotionWriter(temporary, frame)
        try:
            yield writer.write
        finally:
            writer.close()
    report(f"{output}: {writer.frames} frames")
