"""Takes a picture of a page that `facediff view` or `facediff study` wrote, in a headless Chromium.

``python tools/browser/screenshot.py page.html picture.png --frame 46 --dark --script "facediff.heat(true)"``
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.fakes.chromium import Chromium, find_chromium

READY = "window.facediff && (facediff.ready || facediff.errors.length)"


def main(words: list[str] | None = None) -> None:
    """Open the page, run the scripts, go to the frame, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("picture", type=Path, help=".png")
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=800)
    parser.add_argument("--scale", type=float, default=1, help="pixels of the picture for one of the page")
    parser.add_argument("--frame", type=int, help="go there first")
    parser.add_argument("--ready", default=READY, help="JavaScript that is true once the page is ready")
    parser.add_argument("--until", default="true", help="JavaScript that is true once the scripts have done their work")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument(
        "--script", action="append", default=[], help="JavaScript to run before, e.g. facediff.heat(true)"
    )
    args = parser.parse_args(words)
    program = find_chromium() or sys.exit(
        "no Chromium found: export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER)"
    )
    with Chromium(program) as browser:
        page = browser.open(
            args.page.resolve().as_uri(), width=args.width, height=args.height, dark=args.dark, scale=args.scale
        )
        page.wait_for(args.ready)
        for script in args.script:
            page.evaluate(script)
        page.wait_for(args.until)
        if args.frame is not None:
            page.evaluate(f"facediff.seek({args.frame})")
        page.evaluate("new Promise((done) => setTimeout(done, 400))")  # the faces fade in
        page.screenshot(args.picture)
        if page.problems:
            raise SystemExit(f"{args.page}: {page.problems}")


if __name__ == "__main__":
    main()
