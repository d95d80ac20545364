"""The live page in a real browser: the face, its numbers and its speech."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from facediff.live.frames import LiveFrame, Performance
from facediff.live.receivers.browser import STEP, Browser
from tests.fakes.chromium import Chromium, Page
from tests.fakes.small_face import build_face
from tests.live.conftest import FRAME_RATE
from tests.live.test_browser_receiver import serving
from tests.live.test_json_lines import wait_for


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
        # A loudspeaker that is 80 ms slow, as the browser would say: its sound is planned so much earlier.
        page.evaluate(
            "void (AudioContext.prototype.getOutputTimestamp = function () {"
            " return { contextTime: this.currentTime - 0.08, performanceTime: performance.now() }; })"
        )
        page.evaluate("document.getElementById('sound').click()")
        page.wait_for("facediff.speech.played > 4000")
        page.wait_for("/ms (before|after) the face; output 80 ms/.test(document.getElementById('apart').textContent)")
        assert page.evaluate("facediff.speech.ahead") == pytest.approx(0, abs=0.06)
        # Switched off, nothing is planned; switched on again, it goes on at once.
        page.evaluate("document.getElementById('sound').click()")
        page.wait_for("!facediff.speech.on")
        heard = page.evaluate("facediff.speech.played")
        page.wait_for(f"facediff.stats.index > {acting.index + 3}")
        assert page.evaluate("facediff.speech.played") == heard
        page.evaluate("document.getElementById('sound').click()")
        page.wait_for(f"facediff.speech.played > {heard + 1000}")
        acting.stop()
        last = acting.index - 1
        page.wait_for(f"facediff.stats.index === {last}")
        wanted = 1000 * (puppet.neutral + moved(puppet, last).vertices)
        # A frame is counted when it arrives, and drawn with the picture after that.
        page.wait_for(f"Math.abs(facediff.positions[1] - {wanted[0, 1]:.4f}) < 0.5")
        at = page.evaluate("Array.from(facediff.positions)")
        np.testing.assert_allclose(np.reshape(at, (-1, 3)), wanted, atol=0.5 * STEP + 1e-3)
        assert page.evaluate("document.querySelector('h1').textContent") == "<b>Ann</b>"
        assert page.evaluate("document.getElementById('sound').getAttribute('aria-pressed')") == "true"
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert 0.1 <= numbers(page)["lag"] < 5
        # Speech of a time is planned for when its frames are shown, which here is five frames after it was heard.
        plan = page.evaluate("facediff.speech")
        shown = plan["planned"]["time"] + plan["delay"] + plan["drawn"]
        assert plan["planned"]["at"] - plan["heard"] == pytest.approx(shown - plan["now"], abs=0.15)
        assert plan["sounding"] - plan["heard"] == pytest.approx(0.08, abs=0.01)
        assert 0.005 < plan["drawn"] <= 0.1
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
        wait_for(receiver, "1 page at")
        receiver.send(moved(puppet, 1))
        page.wait_for("facediff.stats.index === 1 && facediff.state === 'Live'")
        assert page.evaluate("facediff.errors") == []
    # Another face: what is drawn belongs to the old one, so the page begins again.
    with serving(replace(puppet, neutral=2 * puppet.neutral), port):
        page.wait_for("window.facediff?.ready && facediff.connections === 1")
        np.testing.assert_allclose(page.evaluate("facediff.positions[1]"), 2000 * puppet.neutral[0, 1], rtol=1e-5)
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
