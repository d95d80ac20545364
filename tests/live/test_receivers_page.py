"""The page about receivers: its Python runs, and its tables say what the code does."""

from __future__ import annotations

import doctest
from collections.abc import Iterator
from pathlib import Path

import pytest

from facediff import registry
from facediff.live.frames import open_receiver
from facediff.registry import Kind

PAGE = Path(__file__).parents[2] / "docs" / "live.md"


@pytest.fixture
def own_kind(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The page registers a receiver: not for other tests."""
    kind = Kind("receiver", "", "tests")
    monkeypatch.setattr(registry, "receiver", kind)
    monkeypatch.setattr("facediff.live.frames.receiver", kind)
    return


@pytest.mark.usefixtures("own_kind")
def test_the_python_of_the_page_runs() -> None:
    failed, attempted = doctest.testfile(str(PAGE), module_relative=False)
    assert attempted >= 10
    assert failed == 0


def test_every_receiver_is_described_with_its_usual_place() -> None:
    text = PAGE.read_text()
    for name in registry.receiver.names():
        if not registry.receiver.get(name).__module__.startswith("facediff."):
            continue
        assert f"`{name}" in text, name
        assert str(getattr(open_receiver(name), "port", "")) in text, name
