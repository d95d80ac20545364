"""Waiting for events instead of for times, so that a busy machine changes no result."""

from __future__ import annotations

import atexit
import re
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

PATIENCE = 120.0
"""Seconds after which an event counts as one that does not come."""


def wait_until(condition: Callable[[], object], goes_on: Callable[[], bool] = lambda: True) -> None:
    """Wait until a condition is met.

    Args:
        condition: of the event.
        goes_on: whether the event can still come; such as that a process runs.
    """
    end = time.monotonic() + PATIENCE
    while not condition():
        assert goes_on(), "what the test waits for cannot come any more"
        assert time.monotonic() < end, "what the test waits for does not come"
        time.sleep(0.005)


def wait_until_read(pipe: IO[bytes], reader: int) -> None:
    """Wait until a process has read all that a pipe holds, and waits for more."""
    import fcntl
    import termios

    def unread() -> int:
        return int.from_bytes(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)), sys.byteorder)

    def sleeps() -> bool:
        stat = Path(f"/proc/{reader}/stat")
        return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "S"

    wait_until(lambda: not unread() and sleeps())


def wait_until_signalled(process: int) -> None:
    """Wait until no signal waits any more for a process to take it."""
    status = Path(f"/proc/{process}/status")

    def pending() -> bool:
        masks = re.findall(r"(?:SigPnd|ShdPnd):\s*(\w+)", status.read_text()) if status.exists() else []
        return any(int(mask, 16) for mask in masks)

    wait_until(lambda: not pending())


def free_port() -> int:
    """A TCP port of this machine that nobody listens at, and that no other process is given until this one ends."""
    probe = socket.socket()
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    probe.bind(("127.0.0.1", 0))
    port = int(probe.getsockname()[1])
    if sys.platform == "linux":  # where a socket that does not listen keeps nobody away who asks for this very port
        atexit.register(probe.close)  # which keeps it until then
    else:
        probe.close()
    return port
