"""A Dask scheduler and workers in processes of their own on this machine's loopback, for tests, drills and benchmarks.

with DaskProcesses(folder, workers=2) as cluster:
    subprocess.run([sys.executable, "-m", "facediff", "evaluate", ..., "--scheduler", cluster.address])
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType

ROOT = Path(__file__).resolve().parents[1]
SECONDS = 60.0


class DaskProcesses:
    """Started when entered, and killed when left.

    Args:
        folder: for logs, the scheduler's address, and as the working folder of all of them.
        workers: how many workers.
    """

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self.folder, self.count = folder, workers
        self.programs: list[subprocess.Popen[bytes]] = []
        self.address = ""

    def __enter__(self) -> DaskProcesses:
        """Start, and wait until all workers have come."""
        self.folder.mkdir(parents=True, exist_ok=True)
        facts = self.folder / "scheduler.json"
        facts.unlink(missing_ok=True)
        port = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self.start("scheduler", *port, "--scheduler-file", str(facts))
        end = time.monotonic() + SECONDS
        while not self.address:
            with suppress(FileNotFoundError, json.JSONDecodeError):
                self.address = json.loads(facts.read_text())["address"]
            self.check(end)
        for _ in range(self.count):
            self.start_worker()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Kill all of them."""
        for program in self.programs:
            self.kill(program)

    def start(self, *words: str) -> subprocess.Popen[bytes]:
        """Start one of Dask's programs."""
        search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH", "")]))
        with (self.folder / f"log{len(self.programs)}.txt").open("wb") as log:
            program = subprocess.Popen(
                [sys.executable, "-m", "facediff.benchmark.exit_with_parent", "dask", *words],
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": search},
                stdin=subprocess.PIPE,  # which ends it with this process
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self.programs.append(program)
        return program

    def start_worker(self) -> subprocess.Popen[bytes]:
        """Start a worker, and wait until the scheduler has it."""
        program = self.start("worker", self.address, "--nthreads", "1", "--no-dashboard")
        log = self.folder / f"log{len(self.programs) - 1}.txt"
        end = time.monotonic() + SECONDS
        while b"Registered to" not in log.read_bytes():
            self.check(end)
        return program

    def check(self, end: float) -> None:
        """Wait a little.

        Raises:
            RuntimeError: if a program has ended, or it takes too long.
        """
        time.sleep(0.02)
        program = self.programs[-1]
        if program.poll() is not None or time.monotonic() > end:
            raise RuntimeError((self.folder / f"log{len(self.programs) - 1}.txt").read_text())

    def kill(self, program: subprocess.Popen[bytes]) -> None:
        """Kill -9, with whatever the program has started."""
        with suppress(ProcessLookupError):
            os.killpg(program.pid, signal.SIGKILL)
        program.wait()
        if program.stdin is not None:
            program.stdin.close()
