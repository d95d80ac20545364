"""Speech that arrives in pieces, such as samples from standard input, to frames of animation once these are certain."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.animation.options import AnimationOptions, ExportOptions, RecordingOptions
from facediff.errors import FaceDiffError, OptionError, refuse_idle
from facediff.pipelines.animate import check_options
from facediff.pipelines.trained import open_pipeline
from facediff.speech.pcm import pcm
from facediff.utils.files import atomic, check_writable

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def animate_stream(options: AnimationOptions, output: Path, export: ExportOptions, *, rate: int = 16_000) -> None:
    """Animate samples of standard input as they come, until they end or Ctrl-C ends them."""
    check_stream(options, output, export)

    pipeline = open_pipeline(options)
    template = pipeline.facts["template"]
    compute_seconds, received = 0.0, 0
    with sink(output, tuple(template.shape)) as write, ended_by_interrupt() as read:
        stream = pipeline.stream(rate)
        report(
            f"ready; look-ahead {pipeline.look_ahead:.2f} s and the time that a window takes; "
            f"{round(pipeline.stream_timing[1] * pipeline.frame_rate)} frames at a time, {pipeline.frame_rate:g} a "
            f"second, {len(template)} vertices; reading {rate} Hz, 16 bit"
        )
        for samples in pcm(sys.stdin.buffer, rate, read):
            started = time.perf_counter()
            part = stream.feed(samples)
            compute_seconds += time.perf_counter() - started
            received += len(samples)
            write(part)
        if not received:
            raise FaceDiffError("standard input: ended before any sample came; send 16-bit mono PCM to it")
        started = time.perf_counter()
        part = stream.finish()
        compute_seconds += time.perf_counter() - started
        write(part)
    report(f"{received / rate:.2f} s of speech; real-time factor {compute_seconds / max(received / rate, 1e-9):.2f}")


WHOLE = (
    *("blinks", "gaze", "sway", "target_mesh", "output_unit", "up"),
    *RecordingOptions.defaults(),
)
"""Options that need the whole animation."""


def check_stream(options: AnimationOptions, output: Path, export: ExportOptions) -> None:
    """Refuse options that need the whole animation."""
    check_options(options)
    if str(output) != "-" and output.suffix != ".npy":
        raise OptionError(
            "output",
            "a stream is written as .npy, or as raw float32 to standard output with -o -; `facediff export` turns the "
            ".npy into other formats",
            output,
        )
    options_changed = {**options.changed(), **export.changed()}
    needs_animation = "needs the whole animation, as `facediff export` takes it from a streamed .npy"
    refuse_idle(needs_animation, **{name: name in options_changed for name in WHOLE})
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

    A handler of Ctrl-C that another program has installed stays in place.
    """
    stopped = reading = False

    def interrupt(*_: object) -> None:
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
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield read
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def sink(output: Path, frame: tuple[int, ...]) -> Iterator[Callable[[npt.NDArray[np.float32]], None]]:
    """Where frames (n, V, 3) go: a .npy file that appears when it is complete, or standard output."""
    from facediff.utils.arrays import ArrayWriter

    if str(output) == "-":

        def write(vertices: npt.NDArray[np.float32]) -> None:
            sys.stdout.buffer.write(vertices.astype("<f4").tobytes())
            sys.stdout.buffer.flush()

        yield write
        return
    with atomic(output) as temporary, ArrayWriter(temporary, frame) as writer:
        yield writer.write
    report(f"{output}: {writer.rows} frames")
