"""Drawn speakers."""

from dataclasses import fields, replace

import numpy as np
import pytest

from facediff import synthetic as puppet
from facediff.synthetic.motion import SpeakingStyle
from facediff.synthetic.speakers import SPEAKERS, drawn_speaker


def test_drawn_speakers_know_nothing_of_those_who_are_only_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = [drawn_speaker.__wrapped__(number) for number in range(1, 40)]
    for field in fields(SpeakingStyle):
        values = [getattr(SPEAKERS[name].style, field.name) for name in puppet.SEEN_IDENTITIES]
        wider = 0.1 * (max(values) - min(values)) + 1e-9
        assert all(min(values) - wider <= getattr(s.style, field.name) <= max(values) + wider for s in drawn)
        spread = np.ptp([getattr(speaker.style, field.name) for speaker in drawn])
        assert spread > 0.7 * (max(values) - min(values))
    for name in puppet.UNSEEN_IDENTITIES:
        monkeypatch.setitem(SPEAKERS, name, replace(SPEAKERS[name], style=SpeakingStyle(jaw=9.0, blinks=9.0)))
    assert drawn_speaker.__wrapped__(1) == drawn[0]
    assert len({speaker.voice for speaker in drawn}) > 30
