"""Names under which a page is served."""

from __future__ import annotations

import pytest

from facediff.utils.server import LOOPBACK, is_own_page


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8000", "localhost:8000", "LOCALHOST", "[::1]:8000", "[::1]"])
def test_own_names(host: str) -> None:
    assert is_own_page(host, None, LOOPBACK)
    assert is_own_page(host, f"http://{host}", LOOPBACK)


@pytest.mark.parametrize(
    "host",
    [
        *(
            "evil.example",
            "evil.example\\@127.0.0.1",
            "127.0.0.1:8000.evil.example",
            "127.0.0.1:8000,evil",
            "a@localhost",
        ),
        *(
            "localhost/evil",
            "localhost?evil",
            "localhost#evil",
            "localhost:80:80",
            "[::1].evil.example",
            "local host",
            "",
        ),
    ],
)
def test_other_names(host: str) -> None:
    assert not is_own_page(host, None, LOOPBACK)
