"""``facediff-live``: a live performance with an exported model, without PyTorch."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.live.command import LiveOptions, exported_model, perform, reporter
from facediff.version import __version__

PROGRAM = "facediff-live"


def parser() -> argparse.ArgumentParser:
    """The command's options: those of ``facediff live`` that need no PyTorch."""
    made = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Animate a face while somebody speaks, and send it to other programs; needs no PyTorch.",
        epilog="for example: facediff-live puppet-onnx --microphone --to browser",
    )
    made.add_argument("model", type=Path, metavar="FOLDER", help="folder of facediff export-model")
    made.add_argument(
        "speech",
        nargs="?",
        metavar="SPEECH",
        help="recording, played in real time; - for 16-bit samples, mono, on standard input",
    )
    made.add_argument(
        "--microphone", nargs="?", const="default", metavar="DEVICE", help="number or name of a sound device"
    )
    made.add_argument("--rate", type=int, default=16_000, metavar="HZ", help="of samples on standard input")
    made.add_argument("--to", action="append", default=[], metavar="ADDRESS", help="receiver; may be repeated")
    made.add_argument("--identity", metavar="NAME", help="whose face; the first one trained on by default")
    made.add_argument("--condition", metavar="NAME", help="training identity that the model is conditioned on")
    made.add_argument("--style", metavar="NAME", help="name of a style in the folder; that of the face by default")
    made.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the noise (default: 0)")
    made.add_argument("--expressivity", metavar="X", help="from the mean (0) to a sample (1, usual) and beyond (2)")
    made.add_argument("--voice-gate", default="energy", metavar="GATE", help="what finds the pauses; off for none")
    made.add_argument("--window", type=float, metavar="S", help="seconds of a window (default: frame by frame)")
    made.add_argument("--overlap", type=float, metavar="S", help="seconds that windows share")
    made.add_argument("--shapes", type=Path, metavar="SHAPES", help="blendshapes whose weights are sent")
    made.add_argument("--sound", metavar="WHERE", help="where the speech is played: off, out, out:DEVICE or receivers")
    made.add_argument("--seconds", type=float, metavar="S", help="end after so much speech")
    made.add_argument("--threads", type=int, default=0, metavar="N", help="of the processor (default: its cores)")
    made.add_argument("--quiet", action="store_true", help="report at the end only")
    made.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    return made


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors are one line, and status 2."""
    options = parser().parse_args(words)
    report = reporter(PROGRAM)
    try:
        perform(LiveOptions(**vars(options)), exported_model, report)
    except FaceDiffError as error:
        report(f"error: {error}")
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
