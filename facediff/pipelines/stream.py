"""``facediff animate --stream``: PCM from standard input, frames as soon as they are certain."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING

from facediff.errors import FaceDiffError
from facediff.pipelines.animate import check_seed
from facediff.utils.files import atomic, check_writable

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


CHUNK = 0.02
"""Seconds of speech that are read at a time, at most."""


def check_stream(args: argparse.Namespace) -> None:
    """Refuse what streaming cannot do.

    Raises:
        FaceDiffError: naming the option.
    """
    if [str(path) for path in args.speech] != ["-"]:
        raise FaceDiffError(
            f"--stream: reads standard input; give - in place of {args.speech[0]} (a file needs no --stream)"
        )
    if str(args.output) != "-" and args.output.suffix != ".npy":
        raise FaceDiffError(
            f"--output {args.output}: a stream is written as .npy, or as raw float32 to standard output with -o -; "
            f"`facediff export` turns the .npy into other formats"
        )
    whole = ("expressiveness", "blinks", "gaze", "sway", "target_mesh", "output_unit", "up")
    given = next((name for name in whole if getattr(args, name) is not None), None)
    if given is not None or args.takes != 1:
        raise FaceDiffError(
            f"--{'takes' if given is None else given.replace('_', '-')}: needs the whole performance; stream to .npy, "
            f"then use `facediff export`"
        )
    check_seed(args.seed)
    if sys.stdin is None:
        raise FaceDiffError("--stream: standard input is closed; send samples to it")
    if not 1000 <= args.rate <= 384_000:
        raise FaceDiffError(f"--rate {args.rate}: expected samples a second, such as 16000 or 48000")
    if str(args.output) != "-":
        check_writable(args.output)


def run_stream(args: argparse.Namespace) -> int:
    """Animate speech as it comes, until it ends or Ctrl-C ends it.

    Raises:
        FaceDiffError: if an option is no good, or the speech ends before a frame.
    """
    check_stream(args)

    import torch

    from facediff.pipelines.animate import AnimationPipeline

    pipeline = AnimationPipeline(args)
    model = pipeline.model
    plan = model.windows
    template = model.assets.template(pipeline.identity)
    tell(
        f"look-ahead {plan.look_ahead:.2f} s and the time that a window takes; {plan.in_frames(model.frame_rate).hop} "
        f"frames at a time, {model.frame_rate:g} a second, {len(template)} vertices; reading {args.rate} Hz, 16 bit"
    )
    busy, heard = 0.0, 0
    with sink(args.output, tuple(template.shape)) as write, pipeline.precision(), ended_by_interrupt() as read:
        # In the precision asked for from the style on, as a file is animated.
        stream = model.stream(identity=pipeline.identity, style=pipeline.style, seeds=[args.seed])
        for samples in pcm(sys.stdin.buffer, args.rate, read):
            started = time.perf_counter()
            part = stream.feed(torch.from_numpy(samples))
            busy += time.perf_counter() - started
            heard += len(samples)
            write((part[0].cpu() + template).numpy())
        if not heard:
            raise FaceDiffError("standard input: ended before any sample came; send 16-bit mono PCM to it")
        started = time.perf_counter()
        part = stream.finish()
        busy += time.perf_counter() - started
        write((part[0].cpu() + template).numpy())
    tell(f"{heard / 16_000:.2f} s of speech; real-time factor {busy / max(heard / 16_000, 1e-9):.2f}")
    return 0


def tell(sentence: str) -> None:
    """To standard error, since standard output may be the stream."""
    print(f"facediff animate: {sentence}", file=sys.stderr, flush=True)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while the command waits for samples."""


@contextmanager
def ended_by_interrupt() -> Iterator[Callable[[int, int], bytes]]:
    """An ``os.read`` that is at its end after Ctrl-C, which ends most microphones; a second Ctrl-C stops at once.

    Where Ctrl-C is ignored or somebody else's, it stays so.
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


def pcm(source: IO[bytes], rate: int, read: Callable[[int, int], bytes] = os.read) -> Iterator[npt.NDArray[np.float32]]:
    """Pieces (n,) of speech at 16 kHz as they come.

    Args:
        source: 16-bit mono samples, little endian; half a sample at the end is left away.
        rate: their sample rate.
        read: as ``os.read``.

    Raises:
        FaceDiffError: if the input looks like a file and not like samples.
        MissingExtraError: if another rate needs soxr and it is not installed.
    """
    import numpy as np

    from facediff.data.audio import SAMPLE_RATE, resampler

    convert = resampler(rate) if rate != SAMPLE_RATE else None
    rest, first = b"", True
    # A read of a pipe gives what is there, at least one byte, and nothing at its end.
    while data := read(source.fileno(), max(2, round(CHUNK * rate) * 2)):
        if first and data[:4] in (b"RIFF", b"fLaC", b"OggS"):
            raise FaceDiffError(
                "standard input holds a sound file, not samples; give the file by name without --stream, or only its "
                "samples (ffmpeg -i FILE -f s16le -ac 1 -ar 16000 -)"
            )
        data, first = rest + data, False
        whole = len(data) // 2 * 2
        rest = data[whole:]
        samples = (np.frombuffer(data[:whole], "<i2") / 32768).astype(np.float32)
        yield samples if convert is None else convert(samples, False)
    if convert is not None:
        yield convert(np.zeros(0, np.float32), True)


@contextmanager
def sink(output: Path, frame: tuple[int, ...]) -> Iterator[Callable[[npt.NDArray[np.float32]], None]]:
    """Where frames (n, V, 3) go: a .npy file that appears when it is whole, or standard output at once.

    Raises:
        FaceDiffError: if the file cannot be written.
    """
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
    tell(f"{output}: {writer.frames} frames")
