"""Picks six landmarks on a mask that is refused without them, in a headless Chromium, and takes a picture of the page.

``python tools/browser/picking_picture.py picture.png`` runs `facediff retarget` twice, without landmarks and with
``--pick``, and prints what it says.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import trimesh

from facediff.animation import write_archive
from facediff.editing.landmarks import NAMES
from tests.fakes.chromium import Chromium, Page, find_chromium
from tests.fakes.heads import lower_face, lower_face_marks, talking_second, turned


def click(page: Page, side: str, vertex: int) -> None:
    """Click where a vertex of one of the faces is seen."""
    part = f"facediffPicking.positions('{side}').slice({3 * vertex}, {3 * vertex + 3})"
    x, y = page.evaluate(f"facediffPicking.seen('{side}', {part})")
    for kind in ("mousePressed", "mouseReleased"):
        page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


def main(words: list[str] | None = None) -> None:
    """Run the commands, pick, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", type=Path, help=".png")
    args = parser.parse_args(words)
    program = find_chromium() or sys.exit(
        "no Chromium found: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER)"
    )
    head = lower_face()
    command = [sys.executable, "-m", "facediff", "retarget", "talking.npz", "--target-mesh", "mask.obj"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with tempfile.TemporaryDirectory() as name, Chromium(program) as browser:
        folder = Path(name)
        write_archive(folder / "talking.npz", talking_second())
        mask = trimesh.Trimesh(head.vertices @ turned(20, 140, 0), head.faces, process=False)
        mask.export(folder / "mask.obj", include_normals=False)
        subprocess.run([*command, "-o", "plain.npz"], cwd=folder, env=environment, check=False)
        with subprocess.Popen(
            [*command, "-o", "mask.npz", "--pick"], cwd=folder, env=environment, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            found = re.match(r"\S+", process.stdout.readline())
            assert found is not None
            page = browser.open(found[0], width=1280, height=720)
            page.wait_for("window.facediffPicking && document.body.classList.contains('ready')")
            for place, vertex in lower_face_marks(head).items():
                page.evaluate(f"document.querySelectorAll('#list button')[{list(NAMES).index(place)}].click()")
                click(page, "target", vertex)
            page.evaluate("new Promise((done) => setTimeout(done, 300))")
            page.screenshot(args.picture)
            page.evaluate("document.getElementById('save').click()")
            page.wait_for("facediffPicking.saved")
            print(process.communicate(timeout=300)[0])
            if page.problems:
                raise SystemExit(f"{page.problems}")


if __name__ == "__main__":
    main()
