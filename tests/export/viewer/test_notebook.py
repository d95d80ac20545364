"""What a notebook shows of an animation, in a real browser: the face plays, on its own, with sound and no network."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fakes.chromium import Chromium
from tests.fakes.clicks import FRAMES, RATE, clicks


@pytest.mark.parametrize("kind", ["animation", "comparison"])
def test_output_of_a_notebook_plays_by_itself(kind: str, browser: Chromium, tmp_path: Path) -> None:
    anim = clicks()
    shown = anim if kind == "animation" else anim.compare(clicks(lower=3.0))
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<!doctype html><title>notebook</title><body>{shown._repr_html_()}", encoding="utf-8")
    page = browser.open(notebook.as_uri(), width=900, height=640)
    frame = page.frame()
    frame.wait_for(f"document.getElementById('frame')?.textContent === 'frame 0 / {FRAMES - 1}'")
    frame.wait_for("sound.readyState >= 3")
    assert abs(frame.evaluate("sound.duration") - FRAMES / RATE) < 0.01
    assert frame.evaluate("document.querySelectorAll('.panel').length") == (1 if kind == "animation" else 2)
    assert frame.evaluate("document.getElementById('heat').hidden") is (kind == "animation")
    frame.evaluate("document.getElementById('play').click()")
    frame.wait_for("sound.currentTime > 0.5 && !sound.paused")
    frame.wait_for("parseInt(document.getElementById('frame').textContent.slice(6)) > 12")
    # The frame has no access to the notebook, and loads nothing.
    assert page.evaluate("document.querySelector('iframe').contentDocument") is None
    assert page.problems == []
    assert {url.partition(":")[0] for url in page.requests} <= {"file", "blob"}
    page.close()
