"""The live page: who may see it, and what it is sent."""

from __future__ import annotations

import json
import socket
import struct
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from facediff.live.frames import Performance, open_receiver
from facediff.live.receivers.browser import ON_THE_WAY, STEP, Browser
from tests.fakes.waiting import PATIENCE, free_port, wait_until
from tests.live.conftest import FRAME_RATE, frame
from tests.live.test_json_lines import wait_for

HEADER = 24


@contextmanager
def serving(performance: Performance, port: int | None = None) -> Iterator[Browser]:
    receiver = open_receiver(f"browser:{port or free_port()}")
    assert isinstance(receiver, Browser)
    receiver.open(performance)
    with closing(receiver):
        yield receiver


@pytest.fixture
def served(performance: Performance) -> Iterator[Browser]:
    with serving(replace(performance, speech=True)) as receiver:
        yield receiver


def visit(receiver: Browser, **options: object) -> ClientConnection:
    """A program that takes part as the page does; it has read the description and the mesh."""
    return connect(receiver.url.replace("http", "ws") + "live", **{"proxy": None, **options})  # type: ignore[arg-type]


@pytest.fixture
def visitor(served: Browser) -> Iterator[ClientConnection]:
    with visit(served) as connection:
        assert json.loads(connection.recv(PATIENCE))["format"] == "facediff live page 1"
        connection.recv(PATIENCE)
        wait_for(served, "1 page at")
        yield connection


def test_the_description_the_mesh_and_frames(served: Browser, performance: Performance) -> None:
    count = len(performance.neutral)
    with visit(served) as connection:
        about = json.loads(connection.recv(PATIENCE))
        assert (about["frameRate"], about["subject"], about["speech"]) == (FRAME_RATE, "Ann", True)
        assert about["metadata"] == {"licence": "CC0"}
        mesh = connection.recv(PATIENCE)
        assert isinstance(mesh, bytes)
        assert struct.unpack_from("<B3xIII", mesh) == (0, count, len(performance.faces), 0)
        rest = np.frombuffer(mesh, "<f4", 3 * count, HEADER).reshape(-1, 3)
        np.testing.assert_allclose(rest, 1000 * performance.neutral, rtol=1e-6)
        faces = np.frombuffer(mesh, "<u4", offset=HEADER + 12 * count).reshape(-1, 3)
        assert [set(row) for row in faces.tolist()] == [set(row) for row in performance.faces.tolist()]
        wait_for(served, "1 page at")
        for index in (4, 6):
            served.send(frame(index, dropped=3))
            data = connection.recv(PATIENCE)
            assert isinstance(data, bytes)
            kind, number, dropped, lag, seconds = struct.unpack_from("<B3xIIfd", data)
            assert (kind, number, dropped, seconds) == (1, index, 3, index / FRAME_RATE)
            assert 0.1 <= lag < PATIENCE
            steps = np.frombuffer(data, "<i2", offset=HEADER).reshape(-1, 3)
            apart = np.abs(STEP * steps - 1000 * frame(index).vertices)
            assert apart.max() <= 0.5 * STEP + 1e-4
            connection.send(str(index))


def test_speech_is_sent_as_samples_with_their_time(served: Browser, visitor: ClientConnection) -> None:
    served.hear(np.array([0.0, 0.5, -1.0, 2.0], np.float32), 1.25)
    data = visitor.recv(PATIENCE)
    assert isinstance(data, bytes)
    assert struct.unpack_from("<B3xIIfd", data) == (2, 4, 0, 0.0, 1.25)
    assert np.frombuffer(data, "<i2", offset=HEADER).tolist() == [0, 16384, -32767, 32767]


def number(data: str | bytes) -> int:
    assert isinstance(data, bytes)
    return int(struct.unpack_from("<B3xI", data)[1])


def test_a_page_that_falls_behind_gets_fewer_frames_and_blocks_nobody(
    served: Browser, visitor: ClientConnection
) -> None:
    (page,) = served._viewers.values()
    served.send(frame(0))
    visitor.send(str(number(visitor.recv(PATIENCE))))
    wait_until(lambda: page._answers)
    for index in range(1, 41):
        served.send(frame(index))  # does not wait for the page, which neither reads nor answers
        wait_until(lambda sent=index: page._on_the_way == min(sent, ON_THE_WAY))
    assert [number(visitor.recv(PATIENCE)) for _ in range(ON_THE_WAY)] == list(range(1, ON_THE_WAY + 1))
    assert f"{40 - ON_THE_WAY} frames missed" in served.status()
    visitor.send("1")
    wait_until(lambda: page._on_the_way < ON_THE_WAY)
    served.send(frame(50))
    assert number(visitor.recv(PATIENCE)) == 50


def test_a_program_that_never_answers_gets_what_it_reads(served: Browser, visitor: ClientConnection) -> None:
    for index in range(40):
        served.send(frame(index))
        assert number(visitor.recv(PATIENCE)) == index


@pytest.mark.parametrize("words", ["hello", "-1", "1", b"\0\1", "9" * 100, "١"])
def test_whoever_says_anything_else_is_shown_out(
    served: Browser, visitor: ClientConnection, words: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    visitor.send(words)  # no frame is on the way: not even a number is right
    with pytest.raises(ConnectionClosed):
        visitor.recv(PATIENCE)
    wait_for(served, "1 refused")
    wait_for(served, "0 pages")
    assert len([record for record in caplog.records if "refused" in record.message]) == 1
    with visit(served) as another:
        another.recv(PATIENCE)
        another.recv(PATIENCE)
        wait_for(served, "1 page at")
        served.send(frame(1))
        another.recv(PATIENCE)


@pytest.mark.parametrize(
    "headers",
    [{"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": "https://127.0.0.1"}, {"Host": "evil.example"}],
)
def test_another_pages_script_gets_no_frames(
    served: Browser, headers: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(3):
        assert status_of(served, headers) == 403
    assert "3 refused" in served.status()
    assert len([record for record in caplog.records if "refused" in record.message]) == 1
    assert status_of(served, {"Origin": served.url.rstrip("/")}) == 101
    assert status_of(served, {"Origin": served.url.rstrip("/").replace("127.0.0.1", "localhost")}) == 403


def status_of(receiver: Browser, headers: dict[str, str]) -> int:
    """Of a handshake with these headers, by hand: libraries set some of them themselves."""
    given = {"Host": f"127.0.0.1:{receiver.port}", **headers}
    lines = ["GET /live HTTP/1.1", "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
    lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", *(f"{name}: {value}" for name, value in given.items())]
    with socket.create_connection((receiver.host, receiver.port), PATIENCE) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(client.recv(64).split()[1])


def test_the_page_loads_nothing_and_other_paths_are_not_there(served: Browser) -> None:
    with urllib.request.urlopen(served.url, timeout=PATIENCE) as response:  # noqa: S310 - our own server
        text, headers = response.read().decode(), response.headers
    assert headers["X-Frame-Options"] == "DENY"
    assert "connect-src 'self'" in text
    assert "default-src 'none'" in text
    assert "http://" not in text.replace("http://127", "")
    for path in ("../etc/passwd", "x", "live"):
        with pytest.raises(urllib.error.HTTPError) as failed:
            urllib.request.urlopen(served.url + path, timeout=PATIENCE)  # noqa: S310
        failed.value.close()
        assert failed.value.code in (404, 426)


def test_noise_and_half_open_connections_stop_nothing(served: Browser, visitor: ClientConnection) -> None:
    for noise in (
        b"",
        b"\x16\x03\x01\x02\x00",
        b"GET / HTTP/1.1\r\n",
        b"POST / HTTP/1.1\r\nHost: a\r\n\r\n",
        b"\0" * 9000,
    ):
        client = socket.create_connection((served.host, served.port), PATIENCE)
        client.sendall(noise)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
    served.send(frame(0))
    assert isinstance(visitor.recv(PATIENCE), bytes)


def test_more_pages_than_are_served_are_refused(served: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facediff.live.receivers.browser.MOST_VIEWERS", 1)
    with visit(served) as first:
        first.recv(PATIENCE)
        wait_for(served, "1 page at")
        with pytest.raises(InvalidStatus), visit(served):
            pass
