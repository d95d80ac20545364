"""Ranges of objects on a web server, over persistent connections.

fsspec could read them as well, and reads all that this module does not handle. But for a window of motion its event
loop and its copies take longer than the transfer from a near server.
"""

from __future__ import annotations

import http.client
import os
import socket
import ssl
from threading import local
from typing import Any
from urllib.parse import SplitResult, quote, urlsplit
from urllib.request import getproxies, proxy_bypass

QUICK = getattr(socket, "TCP_QUICKACK", None)
"""Linux's option to acknowledge data without delay; the kernel resets it, so it is set again for every read.

Without it, Nagle's algorithm at a simple server, which holds its last bytes back until all others are acknowledged, and
delayed acknowledgements on this machine can wait 40 ms for each other.
"""
BLOCK = 1 << 20
"""Bytes that are received at a time."""
SECONDS = 60.0
"""Time without an answer after which a request is given up."""


class WebServer:
    """Objects below a plain ``http`` or ``https`` address.

    Args:
        address: of the folder.
    """

    def __init__(self, address: str) -> None:
        self.address = address
        self._reset()

    def _reset(self) -> None:
        self._open, self._process = local(), os.getpid()
        self._all: list[http.client.HTTPConnection] = []

    def close(self) -> None:
        """Close what every thread has opened."""
        for connection in self._all:
            connection.close()

    def __del__(self) -> None:
        """Close."""
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out connections, which belong to their process."""
        return {"address": self.address}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start without connections."""
        self.__init__(**state)  # type: ignore[misc]

    @staticmethod
    def serves(address: str) -> bool:
        """Whether an address is one for this class: without a login, a query, or a proxy on the way."""
        try:
            parts = urlsplit(address)
            plain = parts.scheme in ("http", "https") and parts.hostname and not (parts.username or parts.query)
            _ = parts.port
        except ValueError:
            return False
        return bool(plain and (parts.scheme not in getproxies() or proxy_bypass(parts.netloc)))

    def get(self, key: str, start: int | None, stop: int | None) -> bytes | bytearray | None:
        """Bytes ``start`` to ``stop`` of an object, or all; None for any other answer than a plain one.

        Raises:
            FileNotFoundError: if the server says that there is no such object.
        """
        for fresh in (False, True):
            try:
                return self._asked(key, start, stop, fresh)
            except (http.client.HTTPException, OSError) as error:
                if isinstance(error, FileNotFoundError):
                    raise
                self._forget()  # the server may have closed a connection that was not used for a while
        return None

    def _asked(self, key: str, start: int | None, stop: int | None, fresh: bool) -> bytes | bytearray | None:
        parts = urlsplit(self.address)
        connection = self._connection(parts, fresh)
        asked = {} if start is None or stop is None else {"Range": f"bytes={start}-{stop - 1}"}
        connection.request("GET", f"{parts.path}/{quote(key)}", headers=asked)
        _hurry(connection)
        answer = connection.getresponse()
        if (
            answer.status == (206 if asked else 200)
            and answer.length is not None
            and not answer.getheader("Content-Encoding")
        ):
            if not asked:
                return answer.read()
            if start is not None and stop is not None and answer.length == stop - start:
                return _filled(connection, answer, stop - start)
        status = answer.status
        self._forget()  # the unread rest of the answer may be long
        if status == 404:
            raise FileNotFoundError(key)
        return None

    def _connection(self, parts: SplitResult, fresh: bool) -> http.client.HTTPConnection:
        if self._process != os.getpid():
            self.close()  # closes no more than this process's own hold of those that it was forked with
            self._reset()
        connection: http.client.HTTPConnection | None = getattr(self._open, "connection", None)
        if connection is None or fresh:
            host = parts.hostname or ""
            connection = (
                http.client.HTTPSConnection(host, parts.port, timeout=SECONDS, context=ssl.create_default_context())
                if parts.scheme == "https"
                else http.client.HTTPConnection(host, parts.port, timeout=SECONDS)
            )
            self._open.connection = connection
            self._all.append(connection)
            connection.connect()
            # Requests are small: Nagle's algorithm would only delay them.
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def _forget(self) -> None:
        connection = getattr(self._open, "connection", None)
        self._open.connection = None
        if connection is not None:
            connection.close()
            self._all.remove(connection)


def _hurry(connection: http.client.HTTPConnection) -> None:
    if QUICK is not None and connection.sock is not None:
        connection.sock.setsockopt(socket.IPPROTO_TCP, QUICK, 1)


def _filled(connection: http.client.HTTPConnection, answer: http.client.HTTPResponse, size: int) -> bytearray:
    content = bytearray(size)
    view, place = memoryview(content), 0
    while place < size:
        _hurry(connection)
        got = answer.readinto(view[place : place + BLOCK])
        if not got:
            raise http.client.IncompleteRead(bytes(content[:place]), size - place)
        place += got
    answer.read()  # its end, so that the connection can be used again
    return content
