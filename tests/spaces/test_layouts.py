"""Named layouts: orders, widths and what shares a width."""

from __future__ import annotations

from facediff.spaces import Space, layout
from facediff.spaces.arkit import ARKIT
from facediff.spaces.layouts import LAYOUTS


def test_every_layout_is_a_space_that_survives_its_plain_form() -> None:
    for name, entry in LAYOUTS.items():
        assert Space.from_state(entry.space.state()) == entry.space, name
        columns = sum(part.stop - part.start for part in (entry.arrays or {}).values())
        assert entry.arrays is None or columns == len(entry.space.channels), name


def test_arkit_orders_are_one_alphabet() -> None:
    alphabet = {name.casefold() for name in ARKIT}
    for name, count in (("arkit", 52), ("arkit_51", 51), ("live_link", 52), ("audio2face", 52), ("mediapipe", 51)):
        own = {channel.casefold() for channel in layout(name).channels}
        assert len(own & alphabet) == count, name
    live, omniverse = layout("live_link").channels, layout("audio2face").channels
    assert live[15:17] == ("jawRight", "jawLeft")
    assert omniverse[15:17] == ("jawLeft", "jawRight")
    assert layout("arkit").channels[:3] == ("browDownLeft", "browDownRight", "browInnerUp")
    assert layout("arkit").channels[-1] == "tongueOut"
    assert layout("mediapipe").channels[0] == "_neutral"
    assert layout("live_link").head == (52, 53, 54)
