"""The page of `facediff serve` in a headless Chromium: its speed, and a picture.

    python tools/browser/talking_page.py puppet-onnx speech.wav --picture page.png

prints for one and two threads of WebAssembly the seconds until the page is ready, and the seconds of computing for a
second of speech: in one pass, by the model's own windows, and by the windows for a microphone.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from facediff.reporting.documents import markdown_table
from tests.fakes.chromium import Chromium, Page, find_chromium

ROUNDS = 3
# The frame that is furthest from the face at rest.
WIDEST = """(({ frames, offsets, size }) => {
  const far = (frame) => offsets.subarray(frame * size, (frame + 1) * size).reduce((sum, each) => sum + each * each, 0);
  const all = Array.from({ length: frames }, (_, frame) => far(frame));
  return all.indexOf(Math.max(...all));
})(facediff.page.animated)"""


@contextmanager
def served(words: list[str]) -> Iterator[str]:
    """The address of the page while the command serves it."""
    command = [sys.executable, "-m", "facediff", "serve", *words, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        try:
            found = None
            while found is None and (line := process.stdout.readline()):
                found = re.match(r"http://\S+", line)
            if found is None:
                raise SystemExit(f"{' '.join(command)}: does not serve")
            yield found[0]
        finally:
            process.terminate()


def choose(page: Page, speech: Path) -> None:
    """Choose a recording as a person does, and wait for its motion."""
    root = page.send("DOM.getDocument")["root"]["nodeId"]
    field = page.send("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    page.send("DOM.setFileInputFiles", files=[str(speech.resolve())], nodeId=field)
    page.wait_for("facediff.finished", 120)


def factor(page: Page, windows: str) -> float:
    """Seconds of computing for a second of speech with some windows, the best of several rounds."""
    found = []
    for _ in range(ROUNDS):
        page.evaluate(f"facediff.page.animate(facediff.page.choices, {windows})")
        page.evaluate("facediff.page.pause()")
        found.append(page.evaluate("facediff.page.animated.seconds / (facediff.page.animated.samples.length / 16000)"))
    return float(min(found))


def main(words: list[str] | None = None) -> None:
    """Measure, and take the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="folder of facediff export-model")
    parser.add_argument("speech", type=Path)
    parser.add_argument("--runtime", help="npm's package of ONNX Runtime for browsers")
    parser.add_argument("--picture", type=Path, help=".png")
    parser.add_argument("--frame", type=int, help="take the picture at this frame, and measure nothing")
    args = parser.parse_args(words)
    program = find_chromium() or sys.exit(
        "no Chromium found: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER)"
    )
    options = [args.model, *(["--runtime", args.runtime] if args.runtime else [])]
    rows = []
    with served(options) as address:
        for threads in (1, 2):
            with Chromium(program) as browser:
                began = time.perf_counter()
                page = browser.open(f"{address}?threads={threads}", width=960, height=640)
                page.wait_for("window.facediff && facediff.ready", 60)
                ready = time.perf_counter() - began
                choose(page, args.speech)
                if args.picture and threads == 1:
                    page.evaluate("facediff.page.pause()")
                    page.evaluate(f"facediff.page.seek({WIDEST if args.frame is None else args.frame})")
                    time.sleep(0.5)  # a still picture is drawn sharper
                    page.screenshot(args.picture)
                if args.frame is not None:
                    return
                own = "{...facediff.page.about.windows, above: 0}"
                kinds = ("null", own, "facediff.page.delays[2]", "facediff.page.delays[1]", "facediff.page.delays[0]")
                speeds = [f"{factor(page, f'({kind})'):.2f}" for kind in kinds]
                rows.append([str(threads), f"{ready:.1f}", *speeds])
    heads = ["threads", "ready (s)", "one pass", "own windows", "1.5 s late", "0.3 s late", "0.2 s late"]
    print(markdown_table(heads, rows))


if __name__ == "__main__":
    main()
