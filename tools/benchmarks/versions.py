"""How long the same work takes two versions of facediff, in turns.

Run ``python tools/benchmarks/versions.py OLD NEW`` with two source trees (``git worktree add OLD ed62be8d``): both
start each command in turn, with the libraries of this environment, and the quickest of the rounds counts.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import soundfile
from live import speech
from machine import machine

from facediff.reporting.documents import markdown_table
from facediff.utils import SAMPLE_RATE

FACEDIFF = ["-m", "facediff"]
FIT = [*FACEDIFF, "fit", "--config", "configs/experiment/puppet.yaml", "--trainer.max_steps=100"]
SAMPLING = [str(Path(__file__).with_name("sampling.py")), "--repeats", "3"]
FULL = r"folded, in full: ([\d.]+) s"
WORK: list[tuple[list[str], dict[str, str]]] = [
    (["-c", "import facediff"], {"import facediff": ""}),
    ([*FACEDIFF, "--help"], {"facediff --help": ""}),
    ([*FACEDIFF, "animate", "speech.wav", "-o", "motion.npz"], {"animate, 6 s of speech": ""}),
    ([*FACEDIFF, "animate", "speech.wav", "-o", "motion.mp4"], {"animate to a video": ""}),
    ([*FIT, "--trainer.limit_val_batches=0"], {"fit, 100 steps and its start": ""}),
    (SAMPLING, {"10 s at BIWI's size": FULL, "the same, student": r"steps, in full: ([\d.]+) s, real"}),
    ([*SAMPLING, "--precision", "bf16"], {"10 s at BIWI's size, bf16": FULL}),
]
"""What is started, and what of it is measured: all of it, or the seconds that it prints after a pattern."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("trees", type=Path, nargs=2, metavar="TREE", help="source trees: the old version, the new one")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each command (default: 3)")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        soundfile.write(Path(folder) / "speech.wav", speech(6.0), SAMPLE_RATE)
        for command, measures in WORK:
            seconds: dict[str, list[float]] = {name: [] for name in measures}
            for turn in range(2 * options.rounds):
                environment = os.environ | {"PYTHONPATH": str(options.trees[turn % 2].resolve())}
                started = time.perf_counter()
                said = subprocess.check_output([sys.executable, *command], cwd=folder, env=environment, text=True)
                taken = time.perf_counter() - started
                for name, pattern in measures.items():
                    seconds[name].append(float(re.findall(pattern, said)[0]) if pattern else taken)
            for name, times in seconds.items():
                old, new = min(times[::2]), min(times[1::2])
                rows.append([name, f"{old:.2f} s", f"{new:.2f} s", f"{new / old:.2f}"])
    print(machine(), "", markdown_table(["", *(tree.name for tree in options.trees), "ratio"], rows), sep="\n")


if __name__ == "__main__":
    main()
