"""The lag of live performances, from sample in to packet out, and whether it stays: by receiver, over minutes.

    python tools/benchmarks/live.py puppet-onnx --shapes puppet --minutes 10

An exported model hears speech of the built-in corpus on standard input: the lag is from the moment that the last sample
of a frame is written until the frame's packet arrives. Packets arrive at sockets of this program: Live Link Face by
UDP, the page's frames by WebSocket.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from machine import machine

from facediff.data.puppet import Puppet
from facediff.reporting.documents import markdown_table
from facediff.speech.audio import read_speech
from facediff.utils import SAMPLE_RATE

RATE = 30.0
PIECE = SAMPLE_RATE // 100


class Arrivals:
    """What arrived at a socket: numbers of frames, and when."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.rows: list[tuple[int, float]] = []

    def add(self, index: int) -> None:
        """Note a frame that arrives now."""
        self.rows.append((index, time.monotonic()))

    def table(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """The numbers and the times."""
        index, when = zip(*self.rows, strict=True)
        return np.array(index), np.array(when)


def listen_live_link(sock: socket.socket, arrivals: Arrivals) -> None:
    """Packets by their description: version, two texts, number of the frame, and more."""
    first = None
    while data := sock.recv(4096):
        place = 1
        for _ in range(2):
            place += 4 + struct.unpack_from(">i", data, place)[0]
        (number,) = struct.unpack_from(">i", data, place)
        first = number if first is None else first
        arrivals.add(number - first)


def listen_page(port: int, arrivals: Arrivals) -> None:
    """What the page in the browser is sent."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    with connected(lambda: connect(f"ws://127.0.0.1:{port}/live")) as connection:
        try:
            while True:
                data = connection.recv()
                if isinstance(data, bytes) and data[0] == 1:
                    index = struct.unpack_from("<I", data, 4)[0]
                    arrivals.add(index)
                    connection.send(str(index))
        except ConnectionClosed:
            pass


def connected(connect: Callable[[], Any]) -> Any:  # noqa: ANN401
    """A connection to a server that is about to listen."""
    patience = time.monotonic() + 300
    while True:
        try:
            return connect()
        except OSError:
            if time.monotonic() > patience:
                raise
            time.sleep(0.05)


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """A port that nobody uses."""
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


class Listeners:
    """A listener for each protocol, in threads of their own."""

    def __init__(self) -> None:
        self.arrivals = [Arrivals(name) for name in ("Live Link Face", "page")]
        datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        datagrams.bind(("127.0.0.1", 0))
        page = free_port()
        work = (listen_live_link, datagrams), (listen_page, page)
        for (target, source), arrivals in zip(work, self.arrivals, strict=True):
            threading.Thread(target=target, args=(source, arrivals), daemon=True).start()
        link = datagrams.getsockname()[1]
        self.addresses = [f"livelink://127.0.0.1:{link}", f"browser:{page}"]


def write_in_real_time(samples: npt.NDArray[np.int16], descriptor: int, times: list[float]) -> None:
    """Write samples as a microphone gives them, 10 ms at a time; ``times`` gets when each piece was written."""
    start = time.monotonic()
    for first in range(0, len(samples), PIECE):
        time.sleep(max(0.0, start + (first + PIECE) / SAMPLE_RATE - time.monotonic()))
        os.write(descriptor, samples[first : first + PIECE].tobytes())
        times.append(time.monotonic())
    os.close(descriptor)


def shown(lags: npt.NDArray[np.float64]) -> list[str]:
    """Median, 95 % and worst in milliseconds."""
    return [f"{1000 * value:.0f} ms" for value in (np.median(lags), np.quantile(lags, 0.95), lags.max())]


def speech(seconds: float) -> npt.NDArray[np.int16]:
    """Recordings of the built-in corpus one after the other."""
    parts, length = [], 0
    files = sorted((Path(Puppet().root) / "wav").glob("*.wav"))
    while length < seconds * SAMPLE_RATE:
        for file in files:
            parts.append(read_speech(file))
            length += len(parts[-1])
    joined = np.concatenate(parts)[: round(seconds * SAMPLE_RATE)]
    return np.asarray(np.clip(joined * 32_768, -32_768, 32_767), np.int16)


def resident(process: int) -> float:
    """Megabytes that a process holds."""
    found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    return int(found.group(1)) / 1000 if found else float("nan")


def model(options: argparse.Namespace) -> Iterator[str]:
    """The tables of an exported model, line by line."""
    description = json.loads((options.model / "model.json").read_text())
    rate, seconds = float(description["frame_rate"]), 60 * options.minutes
    samples, written, sizes = speech(seconds), list[float](), list[tuple[float, float]]()
    listeners = Listeners()
    words = [sys.executable, "-m", "facediff", "live", str(options.model), "-", "--shapes", str(options.shapes)]
    words += ["--window", str(options.window)] if options.window else []
    words += ["--threads", str(options.threads)] if options.threads else []
    words += [word for address in listeners.addresses for word in ("--to", address)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        printed: list[str] = []
        for line in process.stderr:
            printed.append(line)
            if "ready" in line:
                break
        reading = threading.Thread(target=lambda: printed.extend(process.stderr or ()))
        reading.start()
        time.sleep(1.0)  # until all are connected
        writing = threading.Thread(target=write_in_real_time, args=(samples, os.dup(process.stdin.fileno()), written))
        process.stdin.close()
        writing.start()
        began = time.monotonic()
        while process.poll() is None:
            sizes.append((time.monotonic() - began, resident(process.pid)))
            time.sleep(2.0)
        reading.join()
    last = (np.arange(round(seconds * rate)) + 1) / rate * SAMPLE_RATE  # the sample with which each frame ends
    spoken = np.array(written)[np.minimum(last.astype(int) // PIECE, len(written) - 1)]
    rows, minutes = [], []
    for arrivals in listeners.arrivals:
        index, when = arrivals.table()
        lags = when - spoken[index]
        order = "yes" if (np.diff(index) > 0).all() else "no"
        rows.append([arrivals.name, str(len(index)), str(len(spoken) - len(index)), order, *shown(lags)])
        first, middle, end = (lags[part] for part in parts(index / rate, seconds))
        minutes.append([arrivals.name, *(f"{1000 * np.median(each):.0f} ms" for each in (first, middle, end))])
    at, megabytes = np.array(sizes).T
    memory = [f"{np.median(megabytes[part]):.1f} MB" for part in parts(at, seconds)]
    yield markdown_table(["receiver", "frames", "missing", "in order", "median", "95 %", "worst"], rows)
    yield ""
    yield markdown_table(["", "first minute", "middle", "last minute"], [*minutes, ["memory", *memory]])
    yield ""
    yield from (f"    {line.rstrip()}" for line in printed[-6:])


def parts(at: npt.NDArray[np.float64], seconds: float) -> list[npt.NDArray[np.bool_]]:
    """The first, the middle and the last minute, or fifth, of some seconds."""
    length = min(60.0, seconds / 5)
    starts = (0.0, (seconds - length) / 2, seconds - length)
    return [(at >= start) & (at <= start + length) for start in starts]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="folder of facediff export-model")
    parser.add_argument("--shapes", type=Path, default=Path("puppet"), help="blendshapes (default: puppet)")
    parser.add_argument("--minutes", type=float, default=1.0, help="of speech (default: 1)")
    parser.add_argument("--window", type=float)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args(arguments)
    print(f"{machine()}\n", flush=True)
    for line in model(options):
        print(line)


if __name__ == "__main__":
    main()
