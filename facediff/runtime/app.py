"""``facediff-run``: animate with an exported model, without PyTorch."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from facediff.errors import FaceDiffError
from facediff.runtime.gated import gated_stream
from facediff.runtime.model import RuntimeModel, real_time_factor
from facediff.speech.pcm import pcm
from facediff.speech.voice_activity import QUICK_GATE, USUAL_GATE, read_gate
from facediff.utils import SAMPLE_RATE
from facediff.version import __version__

if TYPE_CHECKING:
    from facediff.animation.options import ExportOptions
    from facediff.speech.stream import AnimationStream


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    made = argparse.ArgumentParser(
        prog="facediff-run",
        description="Animate a face with speech by a model that `facediff export-model` wrote; needs no PyTorch.",
        epilog="for example: facediff-run puppet-onnx speech.wav -o speech.glb",
    )
    made.add_argument("model", type=Path, metavar="FOLDER", help="folder of facediff export-model")
    made.add_argument(
        "speech",
        metavar="SPEECH",
        help="wav, flac, ogg or mp3; - for 16-bit samples at 16 kHz, mono, on standard input",
    )
    made.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="OUT",
        help="animation; its suffix names the format: .npz, .glb, .html …; of a stream - for float32 vertices",
    )
    made.add_argument("--identity", metavar="NAME", help="whose face; the first one trained on by default")
    made.add_argument("--condition", metavar="NAME", help="training identity that the model is conditioned on")
    made.add_argument(
        "--style",
        metavar="STYLE",
        help="name of a style in the folder, a motion (.npz, .npy), or a mixture (F1:0.3,a.npz:0.7); that of the face "
        "by default",
    )
    made.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the noise (default: 0)")
    made.add_argument(
        "--expressivity", type=float, default=1.0, metavar="X", help="from the mean (0) to a sample (1) and beyond (2)"
    )
    made.add_argument("--shapes", type=Path, metavar="SHAPES", help="blendshapes of .csv, and of .glb if given")
    made.add_argument("--window", type=float, metavar="S", help="seconds of a window of long speech")
    made.add_argument("--overlap", type=float, metavar="S", help="seconds that windows share")
    made.add_argument("--low-latency", action="store_true", help="windows of one frame, 0.2 s behind the speech")
    made.add_argument("--no-voice-gate", action="store_true", help="do not bring the mouth to rest in pauses")
    made.add_argument("--threads", type=int, default=0, metavar="N", help="of the processor (default: its cores)")
    made.add_argument("--version", action="version", version=f"facediff-run {__version__}")
    return made


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors are one line, and status 2."""
    options = parser().parse_args(words)
    try:
        run(options)
    except FaceDiffError as error:
        print(f"facediff-run: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def run(options: argparse.Namespace) -> None:
    """Animate a file or a stream.

    Raises:
        FaceDiffError: naming the file or option.
    """
    import time

    if not 0 <= options.threads <= 1024:
        raise FaceDiffError(f"--threads {options.threads}: out of range; expected 0 to 1024")
    streamed = options.speech == "-"
    if streamed != (options.output == "-"):
        raise FaceDiffError("-: a stream goes from standard input to standard output; give - for both, or for none")
    output = Path(options.output)
    shapes = export_options(options)
    if not streamed:
        from facediff.export.writing import check_export

        check_export(output, shapes)
    model = RuntimeModel.open(options.model, threads=options.threads)
    if options.window is not None or options.overlap is not None:
        model.windows = model.windows.chosen(options.window, options.overlap)
        model.windows.in_frames(model.frame_rate)
        if options.low_latency:
            raise FaceDiffError("--low-latency: chooses the windows; omit --window and --overlap")
    if options.low_latency:
        model.choose_low_latency()
    gate = None if options.no_voice_gate else read_gate(QUICK_GATE if options.low_latency else USUAL_GATE)
    choices = {name: getattr(options, name) for name in ("identity", "condition", "style", "seed", "expressivity")}
    if streamed:
        stream = gated_stream(model.stream(**choices, gate=gate))
        for frames in animated(stream, sys.stdin.buffer):
            sys.stdout.buffer.write(np.ascontiguousarray(frames, "<f4").tobytes())
            sys.stdout.buffer.flush()
        return
    from facediff.export.writing import write_animations
    from facediff.speech.audio import read_speech

    speech = read_speech(Path(options.speech))
    before = time.perf_counter()
    animation = model.animate(speech, **choices, gate=gate, name=Path(options.speech).stem)
    seconds = time.perf_counter() - before
    written = write_animations(output, [animation], shapes)
    print(f"wrote {', '.join(map(str, written))}: {real_time_factor(seconds, speech):.2f} s a second of speech")


def export_options(options: argparse.Namespace) -> ExportOptions:
    """What the writer of the format takes."""
    from facediff.animation.options import ExportOptions

    return ExportOptions(shapes=options.shapes)


def animated(stream: AnimationStream, source: IO[bytes]) -> Iterator[np.ndarray]:
    """Vertices (frames, V, 3) of samples that arrive, as soon as they are certain."""
    heard = False
    for samples in pcm(source, SAMPLE_RATE):
        heard = True
        frames = stream.feed(samples)
        if len(frames):
            yield frames
    if heard:
        yield stream.finish()


if __name__ == "__main__":
    sys.exit(main())
