"""Pages of animations in the browser of the tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from facediff.animation import Animation
from facediff.export.viewer import write_page
from tests.fakes.chromium import Chromium, Page

# Colour in the middle of the first face's place, read in the moment in which it was drawn.
PIXEL = """
window.pixel = () => {
  const gl = document.getElementById("view").getContext("webgl2"), colour = new Uint8Array(4);
  const { place: [left, top, width, height], inset: [above, below] } = facediff.views[0];
  const x = left + width / 2, y = top + (height * (1 + above - below)) / 2;
  const [wide, high] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  gl.readPixels(Math.floor(x * wide), Math.floor((1 - y) * high), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, colour);
  return [...colour];
};
"""


@pytest.fixture
def show(browser: Chromium, tmp_path: Path) -> Iterator[Callable[..., Page]]:
    """Writes a page, opens it and waits until it is ready; at the end nothing may have gone wrong in it."""
    pages: list[Page] = []

    def shown(
        animations: list[Animation],
        *,
        truth: int | None = None,
        width: int = 1280,
        height: int = 800,
        dark: bool = False,
    ) -> Page:
        path = tmp_path / f"page {len(pages)}.html"
        write_page(path, animations, truth=truth)
        page = browser.open(path.as_uri(), width=width, height=height, dark=dark)
        pages.append(page)
        page.wait_for("window.facediff && facediff.ready")
        page.evaluate(PIXEL)
        return page

    yield shown
    for page in pages:
        assert page.problems == []
        assert page.evaluate("facediff.errors") == []
        assert {url.split(":")[0] for url in page.requests} <= {"file", "blob", "data"}
        assert len([url for url in page.requests if url.startswith("file")]) == 1
        page.close()
