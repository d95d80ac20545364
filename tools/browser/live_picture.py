"""Takes a picture of the page of a live performance, in a headless Chromium: the built-in face opens its mouth.

``python tools/browser/live_picture.py docs/images/live_page.png``
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from facediff.live import LiveFrame, Performance, Receiver, open_receiver
from facediff.spaces.arkit import ARKIT
from facediff.synthetic.known_faces import built_in_shapes
from facediff.utils.hub import BUNDLED
from tests.fakes.chromium import Chromium, find_chromium

FRAMES, FRAME_RATE, LAG, PORT = 60, 30.0, 0.12, 8350


def main(words: list[str] | None = None) -> None:
    """Perform two seconds to a page and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("picture", type=Path, help=".png")
    args = parser.parse_args(words)
    program = find_chromium() or sys.exit(
        "no Chromium found: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER)"
    )
    neutral, faces, shapes = built_in_shapes("F1")
    receiver = open_receiver(f"browser:{PORT}")
    performance = Performance(
        FRAME_RATE,
        neutral.astype(np.float32),
        faces.astype(np.int32),
        subject="Puppet",
        shapes=ARKIT,
        colours=np.load(BUNDLED / "arrays.npz")["colours"][0],
        speech=True,
    )
    receiver.open(performance)
    with closing(receiver), Chromium(program) as browser:
        page = browser.open(f"http://127.0.0.1:{PORT}/", width=560, height=620)
        page.wait_for("window.facediff && facediff.ready")
        over = threading.Event()
        acting = threading.Thread(target=act, args=(receiver, neutral, shapes, over))
        acting.start()
        page.wait_for(f"facediff.stats.index > {FRAMES}")
        page.screenshot(args.picture)
        over.set()
        acting.join()
        if page.problems:
            raise SystemExit(f"{args.picture}: {page.problems}")


def act(receiver: Receiver, neutral: np.ndarray, shapes: dict[str, np.ndarray], over: threading.Event) -> None:
    """Open the mouth and smile, and stay so until it is over."""
    began, index = time.monotonic(), 0
    smile = 0.5 * (shapes["mouthSmileLeft"] + shapes["mouthSmileRight"] - 2 * neutral)
    while not over.wait(max(0.0, began + index / FRAME_RATE - time.monotonic())):
        offsets = min(index / FRAMES, 1.0) * (0.6 * (shapes["jawOpen"] - neutral) + smile)
        receiver.send(LiveFrame(index, index / FRAME_RATE, time.monotonic() - LAG, offsets.astype(np.float32)))
        index += 1


if __name__ == "__main__":
    main()
