"""Servers of facediff's applications on free ports, as the commands run them."""

from __future__ import annotations

import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn

from facediff.utils.server import make_server


class Servers:
    """Servers that run until the test is over."""

    def __init__(self) -> None:
        self._running: list[tuple[uvicorn.Server, threading.Thread, socket.socket]] = []

    def start(self, app: Any) -> tuple[str, uvicorn.Server]:  # noqa: ANN401 - an ASGI application
        """Serve an application, and give its address without a slash at its end."""
        listening = socket.create_server(("127.0.0.1", 0))
        ready = threading.Event()
        config = uvicorn.Config(app, log_level="error", lifespan="off", ws="none", server_header=False)
        server = make_server(config, ready.set)
        thread = threading.Thread(target=server.run, args=([listening],), daemon=True)
        thread.start()
        assert ready.wait(20)
        self._running.append((server, thread, listening))
        return f"http://127.0.0.1:{listening.getsockname()[1]}", server

    def stop(self) -> None:
        """Stop all of them."""
        for server, thread, listening in self._running:
            server.should_exit = True
            thread.join(10)
            listening.close()


@contextmanager
def servers() -> Iterator[Servers]:
    """Servers that stop at the end of the context."""
    made = Servers()
    try:
        yield made
    finally:
        made.stop()


def ask(
    url: str, content: object = None, *, raw: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers in lower case and answer; a POST of JSON if there is anything to send."""
    body = raw if raw is not None else None if content is None else json.dumps(content).encode()
    kind = {"Content-Type": "application/json"} if body is not None else {}
    request = urllib.request.Request(url, body, {**kind, **headers})  # noqa: S310 - our own server
    try:
        with urllib.request.urlopen(request, timeout=20) as response:  # noqa: S310 - our own server
            return response.status, {key.lower(): value for key, value in response.headers.items()}, response.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, {}, error.read()
