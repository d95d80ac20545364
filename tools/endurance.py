"""Whether what runs for hours stays what it was: memory, open files, threads, and lag, minute by minute.

    python tools/endurance.py live --hours 4 -o endurance
    python tools/endurance.py serve --hours 1 --visitors 50 -o endurance
    python tools/endurance.py fit --hours 4 -o endurance

``live`` performs a recording of the repository over and over with the bundled model, in real time, to four receivers
of this machine. ``serve`` has visitors who load the page and the model again and again. ``fit`` trains on the built-in
corpus until the time is over, and is then asked to stop, as a cluster does. Each row of NAME.csv is a minute of the
whole tree of processes. The table compares the second tenth of the time with the last one; the start is in the
first. A leak of a few bytes in every frame shows.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil

from facediff.reporting.documents import markdown_table
from facediff.speech.audio import read_speech
from facediff.utils import SAMPLE_RATE

ROOT = Path(__file__).resolve().parents[1]
RECORDING = ROOT / "docs/examples/speech.wav"
PIECE = SAMPLE_RATE // 50
Running = Iterator[tuple[subprocess.Popen[str], Callable[[], list[str]]]]
"""A process, and what to print of it at the end."""

COLUMNS = ("minute", "memory_mb", "files", "threads", "processor_s")


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listener() -> int:
    """A UDP port whose packets are read and thrown away."""
    socket_ = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    socket_.bind(("127.0.0.1", 0))

    def read() -> None:
        while True:
            socket_.recv(65535)

    threading.Thread(target=read, daemon=True).start()
    return int(socket_.getsockname()[1])


def measure(process: psutil.Process) -> tuple[float, int, int, float]:
    """Memory in MB, open files, threads and processor seconds of a process and its children."""
    memory, files, threads, processor = 0.0, 0, 0, 0.0
    for part in [process, *process.children(recursive=True)]:
        with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            memory += part.memory_full_info().uss / 2**20  # what is its own, not shared with its parent
            files += part.num_fds()
            threads += part.num_threads()
            times = part.cpu_times()
            processor += times.user + times.system
    return memory, files, threads, processor


def speak(process: subprocess.Popen[str], until: float) -> None:
    """Write the recording to standard input over and over, each sample at its time."""
    samples = (read_speech(RECORDING) * 32767).astype("<i2")
    start, position = time.monotonic(), 0
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin.buffer as pipe:  # type: ignore[attr-defined]
        while time.time() < until:
            piece = samples[position % samples.size :][:PIECE]
            pipe.write(piece.tobytes())
            pipe.flush()
            position += piece.size
            time.sleep(max(0.0, start + position / SAMPLE_RATE - time.monotonic()))


def fetch(address: str) -> bytes:
    """What this machine's server answers."""
    with urllib.request.urlopen(address, timeout=120) as answer:  # noqa: S310 (the address is our own)
        return bytes(answer.read())


def wait_for(address: str, process: subprocess.Popen[str]) -> None:
    """Wait until a server answers, unless its process has ended."""
    while process.poll() is None:
        with contextlib.suppress(OSError):
            fetch(address)
            return
        time.sleep(0.1)


def visit(address: str, until: float, failures: list[str]) -> None:
    """Load the page and what it names, again and again, as a visitor does who leaves and returns."""
    while time.time() < until:
        try:
            page = fetch(address).decode()
            for name in re.findall(r'(?:src|href)="([^":]+)"', page)[:8]:
                fetch(address + name.lstrip("./"))
        except OSError as error:
            failures.append(str(error))
        time.sleep(2)


@contextlib.contextmanager
def performing(args: argparse.Namespace, until: float) -> Running:
    """``facediff live`` with the recording on standard input."""
    receivers = [f"{scheme}://127.0.0.1:{listener()}" for scheme in ("livelink", "vmc", "osc")]
    receivers.append("jsonl:frames.jsonl")
    command = ["live", "-", "--shapes", "puppet", *(word for address in receivers for word in ("--to", address))]
    with open(args.output / "live.log", "w") as log:
        process = start([*command], args, stdin=subprocess.PIPE, stdout=log, stderr=log)
        # A minute longer than is measured: where speech ends, live ends by itself, before it is asked to.
        threading.Thread(target=speak, args=(process, until + 60), daemon=True).start()
        yield process, lambda: (args.output / "live.log").read_text().splitlines()[-12:]


@contextlib.contextmanager
def serving(args: argparse.Namespace, until: float) -> Running:
    """``facediff serve`` with visitors."""
    port, failures = free_port(), list[str]()
    address = f"http://127.0.0.1:{port}/"
    with open(args.output / "serve.log", "w") as log:
        process = start(["serve", "--port", str(port)], args, stdout=log, stderr=log)
        wait_for(address, process)
        for _ in range(args.visitors):
            threading.Thread(target=visit, args=(address, until, failures), daemon=True).start()
        yield process, lambda: [f"{args.visitors} visitors, {len(failures)} requests failed", *failures[:3]]


@contextlib.contextmanager
def fitting(args: argparse.Namespace, until: float) -> Running:
    """``facediff fit`` on the built-in corpus, for more epochs than there is time for."""
    config = str(ROOT / "configs/experiment/puppet.yaml")
    with open(args.output / "fit.log", "w") as log:
        process = start(["fit", "--config", config, "--trainer.max_epochs=100000"], args, stdout=log, stderr=log)
        yield process, lambda: (args.output / "fit.log").read_text().splitlines()[-3:]


def start(command: list[str], args: argparse.Namespace, **streams: object) -> subprocess.Popen[str]:
    """A command of facediff in the output folder."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    words = [sys.executable, "-m", "facediff", *command]
    return subprocess.Popen(words, cwd=args.output, env=environment, text=True, **streams)  # type: ignore[call-overload, no-any-return]


KINDS = {"live": performing, "serve": serving, "fit": fitting}


def main() -> int:
    """Run one kind for so long, and print what changed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--hours", type=float, default=4.0)
    parser.add_argument("--visitors", type=int, default=50, help="of serve (default: 50)")
    parser.add_argument("-o", "--output", type=Path, default=Path("endurance"), help="folder of the table and the logs")
    args = parser.parse_args()
    args.output = args.output.resolve()
    args.output.mkdir(parents=True, exist_ok=True)
    # A shell that starts this in the background has it, and all that it starts, ignore Ctrl-C, by which they are ended.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    begun = time.time()
    rows: list[tuple[float, ...]] = []
    with KINDS[args.kind](args, begun + 3600 * args.hours) as (process, report):
        watched = psutil.Process(process.pid)
        while time.time() < begun + 3600 * args.hours and process.poll() is None:
            time.sleep(min(60.0, 60 * args.hours))
            if process.poll() is None:
                rows.append(((time.time() - begun) / 60, *measure(watched)))
        early = process.poll() is not None
        with open(args.output / f"{args.kind}.csv", "w", newline="") as table:
            csv.writer(table).writerows([COLUMNS, *([f"{value:.1f}" for value in row] for row in rows)])
        if not early:
            process.send_signal(signal.SIGINT)
        status = process.wait(timeout=600)
        lines = report()
    if not rows:
        sys.exit("\n".join([f"{args.kind}: ended with status {status} before the first figures", *lines]))
    tenth = max(1, len(rows) // 10)
    parts = {"second tenth": rows[tenth : 2 * tenth], "last tenth": rows[-tenth:]}
    medians = {name: [statistics.median(values) for values in zip(*part, strict=True)] for name, part in parts.items()}
    print(f"{args.kind}: {rows[-1][0] / 60:.1f} hours, status {status}{', ended by itself' if early else ''}\n")
    cells = [[name, *(f"{value:.0f}" for value in row[1:4])] for name, row in medians.items()]
    print(markdown_table(["", *COLUMNS[1:4]], cells))
    print(*lines, sep="\n")
    return 1 if early else 0


if __name__ == "__main__":
    sys.exit(main())
