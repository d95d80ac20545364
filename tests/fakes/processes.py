"""Programs of this repository in processes of their own that need not import PyTorch and Lightning again.

A cold interpreter takes five to eight seconds of processor time for these imports. A copy of the process that runs the
tests has them already, and is as good wherever a test is about arguments, output, signals and exit codes. What is
imported and how a process begins is tested with a cold one.
"""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).parents[2]


class Forked:
    """A process that runs a function; much like a ``subprocess.Popen`` whose output goes into files.

    Attributes:
        pid: of the process.
        stdin: a pipe to it.
        returncode: its exit code, or None while it runs.
    """

    def __init__(
        self, work: Callable[[], object], *, cwd: Path = ROOT, env: Mapping[str, str] | None = None, stdout: int = -1
    ) -> None:
        """Start it.

        Args:
            work: what it does; an integer that it returns is the exit code.
            cwd: its working folder.
            env: what differs in its environment.
            stdout: a file descriptor in place of the file for its output.
        """
        self.returncode: int | None = None
        self.files = [_unnamed_file() for _ in range(2)]
        read, write = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of threads; the copy has none of them
            self.pid = os.fork()
        if self.pid == 0:
            os.close(write)
            _work_and_end(work, (read, stdout if stdout >= 0 else self.files[0], self.files[1]), cwd, env or {})
        os.close(read)
        self.stdin = os.fdopen(write, "wb")

    def poll(self) -> int | None:
        """The exit code, or None while the process runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """The exit code; a process that takes longer is killed."""
        with suppress(BrokenPipeError):
            self.stdin.close()
        deadline = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > deadline:
                self.kill()
                raise subprocess.TimeoutExpired("a copy of this process", timeout, self.printed(), self.printed(1))
            time.sleep(0.01)
        return code

    def kill(self) -> None:
        """End it, if it has not ended."""
        self.stdin.close()
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
            self.returncode = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def printed(self, stream: int = 0) -> str:
        """What it has written so far to its output (0) or its errors (1)."""
        return os.pread(self.files[stream], os.fstat(self.files[stream]).st_size, 0).decode(errors="replace")

    def __del__(self) -> None:
        for file in self.files:
            os.close(file)


def _unnamed_file() -> int:
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _work_and_end(work: Callable[[], object], files: tuple[int, ...], cwd: Path, env: Mapping[str, str]) -> NoReturn:
    """What the copy does; it never comes back."""
    status = 1
    try:
        for number, file in enumerate(files):
            os.dup2(file, number)
        # The parent's pipes are let go. Their numbers stay taken: objects that have them close them some time.
        nowhere = os.open(os.devnull, os.O_RDWR)
        for number in map(int, os.listdir("/dev/fd")):
            if number > 2:
                with suppress(OSError):
                    os.dup2(nowhere, number)
        sys.stdin, sys.stdout, sys.stderr = (
            open(number, mode, closefd=False)  # noqa: SIM115
            for number, mode in enumerate("rww")
        )
        warnings.resetwarnings()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ.update(env)
        os.chdir(cwd)
        answer = work()
        status = answer if isinstance(answer, int) else 0
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:  # noqa: BLE001 - as an interpreter prints what ends it
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def program(name: str | Path, *words: object) -> Callable[[], None]:
    """A module (``facediff``) or a file of Python with these words, as ``python -m`` or ``python`` runs it."""

    def run() -> None:
        sys.argv = [str(name), *map(str, words)]
        if isinstance(name, Path):
            sys.path.insert(0, str(name.parent))
            runpy.run_path(str(name), run_name="__main__")
        else:
            runpy.run_module(name, run_name="__main__", alter_sys=True)

    return run


def run(
    name: str | Path, *words: object, cwd: Path = ROOT, env: Mapping[str, str] | None = None, timeout: float = 120
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, as ``subprocess.run`` does that captures its output."""
    process = Forked(program(name, *words), cwd=cwd, env=env)
    code = process.wait(timeout)
    return subprocess.CompletedProcess([str(name), *map(str, words)], code, process.printed(), process.printed(1))
