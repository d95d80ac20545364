"""The files of facediff of which a function runs, between a command and its end or within one training step.

Run as ``python tools/files_run.py animate speech.wav --checkpoint demo/puppet.ckpt -o motion.npy`` or, for one step of
a training, ``python tools/files_run.py --step 53 fit --config configs/experiment/puppet.yaml --data.drawn_speakers=0``.
What runs while a module is imported does not count. A step of the first epoch also reads motion that later ones keep.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType

import facediff

PACKAGE = Path(facediff.__file__).parent


class Trace:
    """Notes the functions that are called, by their files in the order of the first call."""

    def __init__(self) -> None:
        self.functions: dict[str, set[str]] = {}

    def start(self) -> None:
        """Note calls from now on, in new threads too."""
        threading.setprofile(self._note)
        sys.setprofile(self._note)

    def stop(self) -> None:
        """Note no more calls."""
        sys.setprofile(None)
        threading.setprofile(None)

    def lines(self) -> list[str]:
        """The files with their functions."""
        count = sum(map(len, self.functions.values()))
        files = [f"{file}: {', '.join(sorted(names))}" for file, names in self.functions.items()]
        return [f"{len(files)} files, {count} functions", *files]

    def _note(self, frame: FrameType, event: str, _: object) -> None:
        file = Path(frame.f_code.co_filename)
        if event == "call" and file.is_relative_to(PACKAGE) and not _is_importing(frame):
            self.functions.setdefault(str(file.relative_to(PACKAGE)), set()).add(frame.f_code.co_qualname)


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a call belongs to the import of a module."""
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or (
            code.co_name == "<module>" and code.co_filename.startswith(str(PACKAGE))
        ):
            return True
        frame = frame.f_back
    return False


def trace_step(trace: Trace, step: int) -> None:
    """Let a trace note the given step of a training alone, and end the process after it."""
    from lightning.pytorch.loops.training_epoch_loop import _TrainingEpochLoop

    advance, steps = _TrainingEpochLoop.advance, iter(range(1, step + 1))

    def traced(loop: _TrainingEpochLoop, *arguments: object) -> None:
        if next(steps) < step:
            advance(loop, *arguments)  # type: ignore[arg-type]
            return
        trace.start()
        advance(loop, *arguments)  # type: ignore[arg-type]
        trace.stop()
        print(*trace.lines(), sep="\n", flush=True)
        os._exit(0)

    _TrainingEpochLoop.advance = traced  # type: ignore[method-assign]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command of facediff and print what ran."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--step", type=int, help="of a training, this step alone, counted from 1")
    parser.add_argument("command", nargs=argparse.REMAINDER, help="a command of facediff with its options")
    options = parser.parse_args(arguments)
    from facediff.cli.app import main as run

    trace = Trace()
    sys.argv = ["facediff", *options.command]
    if options.step:
        trace_step(trace, options.step)
        run()
        return
    trace.start()
    with suppress(SystemExit):
        run()
    trace.stop()
    print(*trace.lines(), sep="\n")


if __name__ == "__main__":
    main()
