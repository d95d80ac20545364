"""Size and speed of the HTML player: a minute of a face of 5 023 and of 23 370 vertices, played by a real browser.

Run ``python tools/benchmarks/viewer.py`` with a Chromium at hand (``tools/browser/install.sh``); two minutes. Without
one, sizes only. The browser draws in software (SwiftShader): a graphics card is quicker.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[2]))

from facediff.animation import Animation
from facediff.export.viewer import write_page
from tools.benchmarks.rendering import head
from tools.browser.chromium import Chromium, find_chromium

RATE = 30
SAMPLE_RATE = 16_000
NOISES = {"smooth": 0.0, "0.1 mm of noise": 0.1, "1 mm of noise": 1.0}
"""White noise of this standard deviation (mm) on every coordinate of every frame; a model's and a scan's is less."""
PLAY = """(async () => {
  const before = facediff.stats, from = performance.now();
  await facediff.play();
  await new Promise((done) => setTimeout(done, SECONDS * 1000));
  const after = facediff.stats, took = (performance.now() - from) / 1000;
  facediff.pause();
  return [(after.shown - before.shown) / took, after.late - before.late, after.readyMs];
})()"""


def minute(n_vertices: int, seconds: float, noise: float) -> Animation:
    """A talking egg in metres: jaw, brows and cheeks move at speech's pace, the head sways."""
    rng = np.random.default_rng(0)
    shape, faces = head(n_vertices)
    shape = shape * 0.11
    frames = round(seconds * RATE)
    time_points = np.arange(frames) / RATE
    places = rng.normal(0, 0.08, (12, 3)) * [1, 1, 0.3] + [0, -0.02, 0.08]
    bumps = np.stack([np.exp(-((shape - place) ** 2).sum(axis=1) / 0.03**2) for place in places])
    directions = rng.normal(0, 1, (12, 3))
    pace = np.stack([np.sin(2 * np.pi * rng.uniform(1, 6) * time_points + rng.uniform(0, 6)) for _ in places], axis=1)
    moves = np.einsum("tk,kv,kc->tvc", 0.004 * pace, bumps, directions).astype(np.float32)
    sway = 0.003 * np.stack([np.sin(0.7 * time_points), np.sin(1.1 * time_points), 0 * time_points], axis=1)
    vertices = shape.astype(np.float32) + moves + sway[:, None].astype(np.float32)
    if noise:
        for frame in vertices:
            frame += rng.normal(0, noise / 1000, shape.shape).astype(np.float32)
    speech = (0.2 * np.sin(2 * np.pi * 180 * np.arange(frames * SAMPLE_RATE // RATE) / SAMPLE_RATE)).astype(np.float32)
    front = np.flatnonzero(shape[:, 2] > 0)[:20].reshape(-1, 2)
    template = shape.astype(np.float32)
    return Animation(
        f"{len(shape)} vertices", vertices, template, RATE, faces.astype(np.int32), speech=speech, inner_lip_pairs=front
    )


def played(browser: Chromium, page: Path, seconds: float) -> list[float]:
    """Frames a second, frames that came late, milliseconds until ready, and of all processors for a frame."""
    tab = browser.open(page.resolve().as_uri())
    tab.wait_for("window.facediff && facediff.ready", 60)
    before = processor_seconds(browser)
    rate, late, ready = tab.evaluate(PLAY.replace("SECONDS", str(seconds)))
    told = [rate, late, ready, 1000 * (processor_seconds(browser) - before) / max(1, rate * seconds)]
    if tab.problems:
        raise SystemExit(f"{page}: {tab.problems}")
    tab.close()
    return told


def processor_seconds(browser: Chromium) -> float:
    """Time that the browser's processes have had of all processors: other programs do not change it much."""
    return float(sum(each["cpuTime"] for each in browser.send("SystemInfo.getProcessInfo")["processInfo"]))


def line(label: str, animations: list[Animation], folder: Path, browser: Chromium | None, watch: float) -> str:
    """One row of the table: write a page, and play it where there is a browser."""
    page = folder / "page.html"
    started = time.perf_counter()
    options: dict[str, Any] = {"truth": 0} if len(animations) > 1 else {}
    write_page(page, animations, max_mb=1000, **options)
    row = f"{label:<42}{page.stat().st_size / 1e6:7.1f}{time.perf_counter() - started:9.1f}"
    if browser is not None:
        rate, late, ready, work = played(browser, page, watch)
        row += f"{ready / 1000:9.2f}{rate:10.1f}{late:7.0f}{work:14.0f}"
    return row


def main(words: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vertices", type=int, nargs="+", default=[5023, 23370])
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the animations")
    parser.add_argument("--watch", type=float, default=8.0, help="seconds that are played")
    args = parser.parse_args(words)
    program = find_chromium()
    browser = None if program is None else Chromium(program)
    version = "no browser" if browser is None else browser.send("Browser.getVersion")["product"]
    print(f"machine: {processor()}, {os.cpu_count()} cores, Python {platform.python_version()}; {version}, 1280 x 800")
    print(f"{'':<42}{'MB':>7}{'write s':>9}{'ready s':>9}{'frames/s':>10}{'late':>7}{'CPU ms/frame':>14}")
    with tempfile.TemporaryDirectory() as folder:
        for count in args.vertices:
            for label, noise in NOISES.items():
                animation = minute(count, args.seconds, noise)
                print(line(f"{animation.name}, {label}", [animation], Path(folder), browser, args.watch), flush=True)
                if not noise:
                    calm = animation
            other = replace(calm, vertices=calm.vertices[::-1], name="reversed")
            label = f"{calm.name}, truth beside prediction"
            print(line(label, [calm, other], Path(folder), browser, args.watch), flush=True)
    if browser is not None:
        browser.close()


def processor() -> str:
    """The processor's name, as Linux tells it."""
    told: npt.NDArray[np.str_] | list[str] = []
    if Path("/proc/cpuinfo").is_file():
        told = [each for each in Path("/proc/cpuinfo").read_text().splitlines() if each.startswith("model name")]
    return told[0].split(": ", 1)[1] if len(told) else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
