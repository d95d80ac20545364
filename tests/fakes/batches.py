"""A batch whose workers import nothing heavy: it is about processes and files, not about models."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.pipelines.folder import run_folder, seed_of_recording
from facediff.utils.files import atomic


def worker(command: list[str]) -> Callable[[Path, Path], list[Path]]:
    """Writes which process animated, the how many-th recording of that process it is, and the seed.

    With ``--pause`` each takes so many seconds; with ``--hold FILE`` all but the first of a process wait for that file.
    """
    done: list[Path] = []
    if "no-model" in command:
        raise FaceDiffError("C.ckpt: no such checkpoint")
    hold = Path(command[command.index("--hold") + 1]) if "--hold" in command else None
    pause = float(command[command.index("--pause") + 1]) if "--pause" in command else 0.0

    def animate(speech: Path, output: Path) -> list[Path]:
        words = speech.read_text()
        if words == "deadly":
            os._exit(9)
        if words == "bad":
            raise FaceDiffError(f"{speech}: holds only silence")
        if words == "bug":
            raise ValueError("no such thing")
        done.append(speech)
        with atomic(output) as temporary:
            temporary.write_text("half")
            time.sleep(pause)
            while hold is not None and len(done) > 1 and not hold.exists():
                time.sleep(0.02)
            seed = seed_of_recording(speech, 3)
            temporary.write_text(json.dumps({"pid": os.getpid(), "nth": len(done), "said": words, "seed": seed}))
        if words != "with sound":
            return [output]
        output.with_suffix(".sound").write_text("sound")
        return [output, output.with_suffix(".sound")]

    return animate


def run(folder: Path, *command: str, workers: int = 1, retry_failed: bool = False) -> int:
    checkpoint = folder.parent / "C.ckpt"
    speeches, out = sorted(folder.glob("*.wav")), folder.parent / "out"
    return run_folder(
        speeches,
        out,
        ".npy",
        command,
        make_worker=worker,
        files=[checkpoint],
        workers=workers,
        retry_failed=retry_failed,
    )
