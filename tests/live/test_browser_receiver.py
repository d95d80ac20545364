"""The live page: who may see it, what it is sent, and the face, the numbers and the sound in a real browser."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.live.frames import LiveFrame, Performance, open_receiver
from facediff.live.receivers.browser import ON_THE_WAY, STEP, Browser
from facediff.synthetic.face import build_face
from tests.live.conftest import FRAME_RATE, frame
from tests.live.test_json_lines import free_port, wait_for
from tools.browser.chromium import Chromium, Page

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
        assert json.loads(connection.recv(5))["format"] == "facediff live page 1"
        connection.recv(5)
        wait_for(served, "1 pages")
        yield connection


def test_the_description_the_mesh_and_frames(served: Browser, performance: Performance) -> None:
    count = len(performance.neutral)
    with visit(served) as connection:
        about = json.loads(connection.recv(5))
        assert (about["frameRate"], about["subject"], about["speech"]) == (FRAME_RATE, "Ann", True)
        assert about["metadata"] == {"licence": "CC0"}
        mesh = connection.recv(5)
        assert isinstance(mesh, bytes)
        assert struct.unpack_from("<B3xIII", mesh) == (0, count, len(performance.faces), 0)
        rest = np.frombuffer(mesh, "<f4", 3 * count, HEADER).reshape(-1, 3)
        np.testing.assert_allclose(rest, 1000 * performance.neutral, rtol=1e-6)
        faces = np.frombuffer(mesh, "<u4", offset=HEADER + 12 * count).reshape(-1, 3)
        assert [set(row) for row in faces.tolist()] == [set(row) for row in performance.faces.tolist()]
        wait_for(served, "1 pages")
        for index in (4, 6):
            served.send(frame(index, dropped=3))
            data = connection.recv(5)
            assert isinstance(data, bytes)
            kind, number, dropped, lag, seconds = struct.unpack_from("<B3xIIfd", data)
            assert (kind, number, dropped, seconds) == (1, index, 3, index / FRAME_RATE)
            assert 0.1 <= lag < 5
            steps = np.frombuffer(data, "<i2", offset=HEADER).reshape(-1, 3)
            apart = np.abs(STEP * steps - 1000 * frame(index).vertices)
            assert apart.max() <= 0.5 * STEP + 1e-4
            connection.send(str(index))


def test_speech_is_sent_as_samples_with_their_time(served: Browser, visitor: ClientConnection) -> None:
    served.hear(np.array([0.0, 0.5, -1.0, 2.0], np.float32), 1.25)
    data = visitor.recv(5)
    assert isinstance(data, bytes)
    assert struct.unpack_from("<B3xIIfd", data) == (2, 4, 0, 0.0, 1.25)
    assert np.frombuffer(data, "<i2", offset=HEADER).tolist() == [0, 16384, -32767, 32767]


def test_a_page_that_does_not_answer_gets_no_more_frames_and_blocks_nobody(
    served: Browser, visitor: ClientConnection
) -> None:
    began = time.monotonic()
    for index in range(40):
        served.send(frame(index))
    assert time.monotonic() - began < 1
    got = [struct.unpack_from("<B3xI", visitor.recv(5))[1] for _ in range(ON_THE_WAY)]  # type: ignore[arg-type]
    assert got == list(range(ON_THE_WAY))
    assert f"{40 - ON_THE_WAY} frames missed" in served.status()
    visitor.send("0")
    time.sleep(0.1)
    served.send(frame(50))
    assert struct.unpack_from("<B3xI", visitor.recv(5))[1] == 50  # type: ignore[arg-type]


@pytest.mark.parametrize("words", ["hello", "-1", "1", b"\0\1", "9" * 100, "١"])
def test_whoever_says_anything_else_is_shown_out(
    served: Browser, visitor: ClientConnection, words: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    visitor.send(words)  # no frame is on the way: not even a number is right
    with pytest.raises(ConnectionClosed):
        visitor.recv(5)
    wait_for(served, "1 refused")
    wait_for(served, "0 pages")
    assert len([record for record in caplog.records if "refused" in record.message]) == 1
    with visit(served) as another:
        another.recv(5)
        another.recv(5)
        wait_for(served, "1 pages")
        served.send(frame(1))
        another.recv(5)


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
    with socket.create_connection((receiver.host, receiver.port), 5) as client:
        client.sendall("\r\n".join([*lines, "", ""]).encode())
        return int(client.recv(64).split()[1])


def test_the_page_loads_nothing_and_other_paths_are_not_there(served: Browser) -> None:
    with urllib.request.urlopen(served.url, timeout=5) as response:  # noqa: S310 - our own server
        text, headers = response.read().decode(), response.headers
    assert headers["X-Frame-Options"] == "DENY"
    assert "connect-src 'self'" in text
    assert "default-src 'none'" in text
    assert "http://" not in text.replace("http://127", "")
    for path in ("../etc/passwd", "x", "live"):
        with pytest.raises(urllib.error.HTTPError) as failed:
            urllib.request.urlopen(served.url + path, timeout=5)  # noqa: S310
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
        client = socket.create_connection((served.host, served.port), 5)
        client.sendall(noise)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
    served.send(frame(0))
    assert isinstance(visitor.recv(5), bytes)


def test_a_taken_port_is_named(performance: Performance, served: Browser) -> None:
    with pytest.raises(FaceDiffError, match=str(served.port)), serving(performance, served.port):
        pass


def test_a_model_without_triangles_is_refused(performance: Performance) -> None:
    with (
        pytest.raises(FaceDiffError, match="triangles"),
        serving(replace(performance, faces=np.zeros((0, 3), np.int32))),
    ):
        pass


def test_the_package_that_is_missing_is_named(performance: Performance, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "websockets", None)
    with pytest.raises(MissingExtraError, match="websockets"), serving(performance):
        pass


def test_more_pages_than_are_served_are_refused(served: Browser, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facediff.live.receivers.browser.MOST_VIEWERS", 1)
    with visit(served) as first:
        first.recv(5)
        wait_for(served, "1 pages")
        with pytest.raises(InvalidStatus), visit(served):
            pass


# In a real browser.


@pytest.fixture(scope="module")
def puppet() -> Performance:
    face = build_face()
    return Performance(
        FRAME_RATE, face.vertices.astype(np.float32), face.faces.astype(np.int32), subject="<b>Ann</b>", speech=True
    )


def moved(performance: Performance, index: int, lag: float = 0.1) -> LiveFrame:
    offsets = np.zeros_like(performance.neutral)
    offsets[:, 1] = 0.001 * (index % 7)
    return LiveFrame(index, index / FRAME_RATE, time.monotonic() - lag, offsets)


class Acting(threading.Thread):
    """Sends frames and speech at their rate, the speech 5 frames earlier, until it is stopped."""

    def __init__(self, receiver: Browser, performance: Performance, index: int = 0) -> None:
        super().__init__(daemon=True)
        self.receiver, self.performance, self.index = receiver, performance, index
        self.over = threading.Event()

    def run(self) -> None:
        began, first, chunk = time.monotonic(), self.index, round(self.performance.sample_rate / FRAME_RATE)
        while not self.over.wait(max(0.0, began + (self.index - first) / FRAME_RATE - time.monotonic())):
            start = (self.index + 5) / FRAME_RATE
            self.receiver.hear(0.1 * np.sin(np.arange(chunk) / 5).astype(np.float32), start)
            self.receiver.send(moved(self.performance, self.index))
            self.index += 1

    def stop(self) -> None:
        self.over.set()
        self.join(5)


def numbers(page: Page) -> dict[str, float]:
    found: dict[str, float] = page.evaluate("facediff.stats")
    return found


def test_the_page_shows_frames_plays_speech_and_comes_back(browser: Chromium, puppet: Performance) -> None:
    with serving(puppet) as receiver:
        page = browser.open(receiver.url, width=375, height=740)
        page.wait_for("window.facediff && facediff.ready")
        acting = Acting(receiver, puppet)
        acting.start()
        page.wait_for("facediff.stats.received > 3")
        page.evaluate("document.getElementById('sound').click()")
        page.wait_for("facediff.speech.played > 4000")
        acting.stop()
        last = acting.index - 1
        page.wait_for(f"facediff.stats.index === {last}")
        at = page.evaluate("Array.from(facediff.positions)")
        wanted = 1000 * (puppet.neutral + moved(puppet, last).vertices)
        np.testing.assert_allclose(np.reshape(at, (-1, 3)), wanted, atol=0.5 * STEP + 1e-3)
        assert page.evaluate("document.querySelector('h1').textContent") == "<b>Ann</b>"
        assert page.evaluate("document.getElementById('sound').getAttribute('aria-pressed')") == "true"
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert 0.1 <= numbers(page)["lag"] < 5
        assert numbers(page)["shown"] > 1
        # Gaps in the numbers of frames are dropped ones.
        missed = numbers(page)["missed"]
        receiver.send(moved(puppet, last + 5))
        page.wait_for(f"facediff.stats.index === {last + 5}")
        assert numbers(page)["missed"] == missed + 4
        port = receiver.port
    page.wait_for("document.body.classList.contains('lost')")
    with serving(puppet, port) as receiver:
        page.wait_for("facediff.connections === 2")
        wait_for(receiver, "1 pages")
        receiver.send(moved(puppet, 1))
        page.wait_for("facediff.stats.index === 1 && facediff.state === 'Live'")
        assert page.evaluate("facediff.errors") == []
        # While nobody answered, the browser itself says so; nothing else went wrong.
        assert [each for each in page.problems if "ERR_CONNECTION_REFUSED" not in each] == []
        assert {url.split("/")[2] for url in page.requests if not url.startswith("data")} == {f"127.0.0.1:{port}"}
        page.close()


def test_the_page_is_driven_by_keys_and_its_buttons_have_names(browser: Chromium, puppet: Performance) -> None:
    with serving(puppet) as receiver:
        page = browser.open(receiver.url, width=1000, height=700, dark=True)
        page.wait_for("window.facediff && facediff.ready")
        buttons = "[...document.querySelectorAll('button')]"
        assert page.evaluate(f"{buttons}.every((b) => (b.getAttribute('aria-label') ?? b.textContent).trim())")
        page.press("e")
        assert page.evaluate("document.getElementById('wireframe').getAttribute('aria-pressed')") == "true"
        page.press("?")
        assert page.evaluate("document.getElementById('keys').open")
        assert page.problems == []
        page.close()


@pytest.mark.slow
def test_a_minute_in_the_browser(browser: Chromium, puppet: Performance) -> None:
    """All frames arrive, in order and at their rate; the lag does not grow; speech stays with its face."""
    with serving(puppet) as receiver:
        page = browser.open(receiver.url, width=600, height=500)
        page.wait_for("window.facediff && facediff.ready")
        wait_for(receiver, "1 pages")
        acting = Acting(receiver, puppet)
        acting.start()
        page.wait_for("facediff.stats.received > 3")
        page.evaluate("document.getElementById('sound').click()")
        time.sleep(60)
        early = page.evaluate("facediff.speech")
        acting.stop()
        page.wait_for(f"facediff.stats.index === {acting.index - 1}")
        found = numbers(page)
        assert found["received"] + found["missed"] == acting.index
        assert found["missed"] < 0.02 * acting.index
        assert found["lag"] < 0.2
        assert early["anchors"] <= 3
        assert early["played"] > 55 * puppet.sample_rate
        assert page.problems == []
        page.close()
