"""Drives a headless Chromium through its debugging pipe: pages in, measurements and screenshots out.

Needs Python only, beside the browser: the Chrome DevTools Protocol is JSON messages that end in a zero byte, here over
two pipes (``--remote-debugging-pipe``), so there is no port, no driver and no package to keep in step.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import Empty, Queue
from typing import Any, TypeAlias

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")
CACHES = (".cache/ms-playwright", "Library/Caches/ms-playwright", ".cache/puppeteer")
IN_CACHES = ("headless_shell", "chrome-headless-shell", "chrome", "Chromium")
FLAGS = (
    "--headless",
    "--remote-debugging-pipe",
    "--no-first-run",
    "--no-sandbox",  # containers give no user namespaces; the pages are our own
    "--no-zygote",
    "--disable-gpu-sandbox",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--ignore-gpu-blocklist",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL 2 without a graphics card
    "--enable-unsafe-swiftshader",
    "--autoplay-policy=no-user-gesture-required",
    "--disable-background-networking",
    "--disable-component-update",
    "--password-store=basic",
)
Result: TypeAlias = Any
"""What JSON can hold."""
_FIRST_FREE = 10
_SHIM = "import os,sys; os.dup2(int(sys.argv[1]),3); os.dup2(int(sys.argv[2]),4); os.execv(sys.argv[3],sys.argv[3:])"


class BrowserError(Exception):
    """The browser is missing, died, or a script in the page failed."""


def find_chromium() -> Path | None:
    """A Chromium: ``$FACEDIFF_CHROMIUM``, one on the path, or one in the cache of Playwright or Puppeteer.

    Raises:
        BrowserError: if ``$FACEDIFF_CHROMIUM`` names no file.
    """
    told = os.environ.get("FACEDIFF_CHROMIUM")
    if told:
        if not Path(told).is_file():
            raise BrowserError(f"FACEDIFF_CHROMIUM={told}: no such file")
        return Path(told)
    for name in NAMES:
        found = shutil.which(name)
        if found:
            return Path(found)
    for cache in (Path.home() / name for name in CACHES):
        if cache.is_dir():
            programs = (each for name in IN_CACHES for each in sorted(cache.rglob(name)))
            found_there = next((each for each in programs if each.is_file() and os.access(each, os.X_OK)), None)
            if found_there:
                return found_there
    return None


class Chromium:
    """A running browser; use it as a context manager.

    Args:
        program: path of the browser.
        flags: more command-line flags.
    """

    def __init__(self, program: Path, flags: Sequence[str] = ()) -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="facediff-browser-", ignore_cleanup_errors=True)
        to_read, self._out = (_high(end) for end in os.pipe())
        self._in, to_write = (_high(end) for end in os.pipe())
        words = [str(program), *FLAGS, *flags, f"--user-data-dir={self._profile.name}", "about:blank"]
        self._log = Path(self._profile.name) / "stderr"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _SHIM, str(to_read), str(to_write), *words],
                pass_fds=(to_read, to_write),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        os.close(to_read)
        os.close(to_write)
        self._number = 0
        self._answers: Queue[dict[str, Any]] = Queue()
        self.listeners: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _read(self) -> None:
        rest = b""
        while data := _read_some(self._in):
            *messages, rest = (rest + data).split(b"\0")
            for message in map(json.loads, messages):
                if "id" in message:
                    self._answers.put(message)
                elif message.get("sessionId") in self.listeners:
                    self.listeners[message["sessionId"]](message)
        self._answers.put({"id": 0, "error": {"message": "the browser ended"}})

    def send(self, method: str, session: str | None = None, timeout: float = 60.0, **parameters: object) -> Result:
        """Send a command of the protocol and wait for its result.

        Raises:
            BrowserError: if it fails, or there is no answer in time.
        """
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        left = memoryview(json.dumps(message).encode() + b"\0")
        while left:
            left = left[os.write(self._out, left) :]
        end = time.monotonic() + timeout
        while True:
            try:
                answer = self._answers.get(timeout=max(0.01, end - time.monotonic()))
            except Empty:
                raise BrowserError(f"{method}: no answer in {timeout:g} s") from None
            if answer["id"] == self._number or not answer["id"]:
                break
        if "error" in answer:
            raise BrowserError(
                f"{method}: {answer['error']['message']}\n{self._log.read_text(errors='replace')[-2000:]}"
            )
        return answer["result"]

    def open(self, url: str, *, width: int = 1280, height: int = 800, dark: bool = False, scale: float = 1) -> Page:
        """Open a page in a window of a size, in pixels of the page."""
        return Page(self, url, width, height, dark, scale)

    def close(self) -> None:
        """End the browser."""
        try:
            self.send("Browser.close", timeout=5)
            self._process.wait(10)
        except (BrowserError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._reader.join(5)
        os.close(self._out)
        os.close(self._in)
        self._profile.cleanup()


class Frame:
    """A document in which scripts are evaluated: that of a page, or of a frame within one.

    Args:
        browser: it runs in.
        session: of the process that shows it.
        world: number of the context that scripts run in; None for the document's own.
        problems: what went wrong in it so far, for errors.
    """

    def __init__(self, browser: Chromium, session: str, world: int | None, problems: list[str]) -> None:
        self._browser, self._session, self._world, self.problems = browser, session, world, problems

    def evaluate(self, script: str) -> Result:
        """Value of a JavaScript expression, awaited if it is a promise.

        Raises:
            BrowserError: with what it throws.
        """
        context = {} if self._world is None else {"contextId": self._world}
        result = self._browser.send(
            "Runtime.evaluate", self._session, expression=script, awaitPromise=True, returnByValue=True, **context
        )
        if "exceptionDetails" in result:
            raise BrowserError(json.dumps(result["exceptionDetails"])[:2000])
        return result["result"].get("value")

    def wait_for(self, condition: str, timeout: float = 30.0) -> None:
        """Wait until an expression is true.

        Raises:
            BrowserError: if it is not in time.
        """
        end = time.monotonic() + timeout
        while True:
            try:
                if self.evaluate(f"Boolean({condition})"):
                    return
            except BrowserError as error:
                if "target navigated" not in str(error):  # between two pages there is none to be asked
                    raise
            if time.monotonic() > end:
                raise BrowserError(f"not in {timeout:g} s: {condition}; {self.problems[:3]}")
            time.sleep(0.03)


class Page(Frame):
    """A page in a tab of its own. What it logs, throws and asks for is kept from its first moment on."""

    def __init__(self, browser: Chromium, url: str, width: int, height: int, dark: bool, scale: float) -> None:
        self.requests: list[str] = []
        self._frame_sessions: list[str] = []  # of frames that live in processes of their own
        self._target = browser.send("Target.createTarget", url="about:blank")["targetId"]
        session = browser.send("Target.attachToTarget", targetId=self._target, flatten=True)["sessionId"]
        super().__init__(browser, session, None, [])
        browser.listeners[self._session] = self._receive
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.resize(width, height, scale)
        self.send(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}],
        )
        self.send("Page.navigate", url=url)

    def _receive(self, message: dict[str, Any]) -> None:
        method, told = message["method"], message["params"]
        if method == "Runtime.exceptionThrown":
            details = told["exceptionDetails"]
            self.problems.append(str(details.get("exception", {}).get("description", details["text"])))
        elif method == "Log.entryAdded" and told["entry"]["level"] == "error":
            self.problems.append(told["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and told["type"] in ("error", "assert"):
            self.problems.append(" ".join(str(each.get("value")) for each in told["args"]))
        elif method == "Network.requestWillBeSent":
            self.requests.append(told["request"]["url"])
        elif method == "Target.attachedToTarget" and told["targetInfo"]["type"] == "iframe":
            self._browser.listeners[told["sessionId"]] = self._receive
            self._frame_sessions.append(told["sessionId"])

    def send(self, method: str, **parameters: object) -> Result:
        """Send a command of the protocol to this page."""
        return self._browser.send(method, self._session, **parameters)

    def resize(self, width: int, height: int, scale: float = 1) -> None:
        """Give the window another size."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=False
        )

    def frame(self) -> Frame:
        """The page's only frame, as soon as it is there.

        Raises:
            BrowserError: if there is none in time.
        """
        # Until its document has loaded, a frame may still move to another process.
        self.wait_for("document.readyState === 'complete' && document.querySelector('iframe')")
        # Newer browsers run frames of other origins in processes of their own, which are attached one by one; in older
        # ones, and for the page's own origin, frames stand in the page's tree.
        self.send("Target.setAutoAttach", autoAttach=True, waitForDebuggerOnStart=False, flatten=True)
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            if self._frame_sessions:
                for domain in ("Runtime", "Log", "Network"):
                    self._browser.send(f"{domain}.enable", self._frame_sessions[-1])
                return Frame(self._browser, self._frame_sessions[-1], None, self.problems)
            if children := self.send("Page.getFrameTree")["frameTree"].get("childFrames"):
                world = self.send("Page.createIsolatedWorld", frameId=children[0]["frame"]["id"])
                return Frame(self._browser, self._session, world["executionContextId"], self.problems)
            time.sleep(0.03)
        raise BrowserError("the page's frame did not appear in 30 s")

    def press(self, key: str) -> None:
        """Press a key on what has the focus."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at one point, move it to another and let go; a click if they are the same."""
        for kind, (x, y), buttons in (("mousePressed", start, 1), ("mouseMoved", end, 1), ("mouseReleased", end, 0)):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Write what the window shows as a .png."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"]))

    def close(self) -> None:
        """Close the tab."""
        self._browser.send("Target.closeTarget", targetId=self._target)
        self._browser.listeners.pop(self._session, None)


def _high(end: int) -> int:
    """The end of a pipe under a number that is out of the way of those that the browser expects."""
    moved = fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, _FIRST_FREE)
    os.close(end)
    return moved


def _read_some(end: int) -> bytes:
    try:
        return os.read(end, 1 << 20)
    except OSError:
        return b""
