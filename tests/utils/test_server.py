"""Names under which a page is served."""

from __future__ import annotations

import pytest

from facediff.utils.server import LOOPBACK, is_own_page


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8000", "localhost:8000", "LOCALHOST", "[::1]:8000", "[::1]"])
def test_own_names(host: str) -> None:
    assert is_own_page(host, None, LOOPBACK)
    assert is_own_page(host, f"http://{host}", LOOPBACK)


OTHERS = (
    *("evil.example", "evil.example\\@127.0.0.1", "127.0.0.1:8000.evil.example", "127.0.0.1:8000,evil", "a@localhost"),
    *("localhost/evil", "localhost?evil", "localhost#evil", "localhost:80:80", "[::1].evil.example", "local host", ""),
)


@pytest.mark.parametrize("host", OTHERS)
def test_other_names(host: str) -> None:
    assert not is_own_page(host, None, LOOPBACK)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://[evil", "http://127.0.0.1.evil.example"])
def test_pages_from_elsewhere(origin: str) -> None:
    assert not is_own_page("127.0.0.1", origin, LOOPBACK)
