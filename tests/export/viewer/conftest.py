"""The browser of this folder's tests, which are skipped without one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tools.browser.chromium import Chromium, find_chromium


@pytest.fixture(scope="session")
def program() -> Path:
    """A Chromium; without one the test is skipped, or fails where FACEDIFF_REQUIRE_BROWSER is set."""
    found = find_chromium()
    if found is None:
        words = (
            "no Chromium found: put one on the PATH, or run  export FACEDIFF_CHROMIUM=$(tools/browser/install.sh DIR)"
        )
        if os.environ.get("FACEDIFF_REQUIRE_BROWSER"):
            pytest.fail(words)
        pytest.skip(words)
    return found


@pytest.fixture(scope="session")
def browser(program: Path) -> Iterator[Chromium]:
    with Chromium(program) as running:
        yield running
