"""Addresses of receivers: what they name, what is refused, and that packages add receivers of their own."""

from __future__ import annotations

from typing import Annotated

import pytest

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.live.frames import Address, LiveFrame, Performance, Receiver, open_receiver, read_address
from facediff.registry import Kind
from facediff.utils.ranges import Range


class Noted(Receiver):
    """Keeps what it is given."""

    def __init__(self, address: Address, *, subject: str = "me", rate: Annotated[int, Range(1, 9)] = 5) -> None:
        super().__init__(address)
        self.subject, self.rate = subject, rate

    def open(self, performance: Performance) -> None:
        """Nothing to open."""

    def send(self, frame: LiveFrame) -> None:
        """Nothing to send."""

    def close(self) -> None:
        """Nothing to close."""


@pytest.fixture
def noted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kind of receivers with one of a third party's."""
    kind = Kind("receiver", "", "tests")
    kind.register("noted")(Noted)
    monkeypatch.setattr(registry, "receiver", kind)
    monkeypatch.setattr("facediff.live.frames.receiver", kind)


@pytest.mark.parametrize(
    ("text", "host", "port", "path", "options"),
    [
        ("vmc://127.0.0.1:39539", "127.0.0.1", 39539, "", {}),
        ("livelink://[::1]:11111?subject=A%20B&x=1", "::1", 11111, "", {"subject": "A B", "x": "1"}),
        ("livelink://studio", "studio", None, "", {}),
        ("jsonl:-", None, None, "-", {}),
        ("jsonl:takes/a b.jsonl?vertices=true", None, None, "takes/a b.jsonl", {"vertices": "true"}),
        ("browser", None, None, "", {}),
        ("browser?open=false", None, None, "", {"open": "false"}),
        ("browser:8080", None, 8080, "", {}),
    ],
)
def test_an_address_is_read(text: str, host: str | None, port: int | None, path: str, options: dict[str, str]) -> None:
    scheme = text.split(":")[0].split("?")[0]
    assert read_address(text) == Address(text, scheme, host, port, path, options)


@pytest.mark.parametrize(
    "text",
    ["", ":1", "//x:1", "Two Words", "vmc://", "vmc://:1", "vmc://a:0", "vmc://a:65536", "vmc://a:b", "vmc://u@a:1"]
    + ["vmc://a:1#x", "browser:0", "vmc://a:1?x", "vmc://[::1:1", "vmc://a:1?" + "&".join(["x=1"] * 30)],
)
def test_a_malformed_address_is_refused_by_name(text: str) -> None:
    with pytest.raises(FaceDiffError) as caught:
        read_address(text)
    assert f"--to {text}"[:40] in str(caught.value)


@pytest.mark.usefixtures("noted")
def test_options_of_an_address_are_the_constructors() -> None:
    made = open_receiver("noted://here:1?subject=Ann&rate=7")
    assert isinstance(made, Noted)
    assert (made.subject, made.rate, made.name) == ("Ann", 7, "noted://here:1?subject=Ann&rate=7")
