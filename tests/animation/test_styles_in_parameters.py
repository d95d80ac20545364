"""Motion in parameters as a style: whatever file it comes in, it is in the model's channels and at its rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation.styles import channels_of, recorded_parameters
from facediff.errors import FaceDiffError
from facediff.spaces import VERTICES
from facediff.spaces.files import ParameterClip, write_parameters
from facediff.spaces.layouts import layout

LIVE_LINK = layout("live_link")
OWN = replace(LIVE_LINK, channels=(*LIVE_LINK.channels, "tongueUp"))
"""A model's channels: a phone's, and one that it does not record."""


def test_a_take_of_a_phone_is_brought_to_the_channels_of_a_model(tmp_path: Path) -> None:
    values = np.linspace(0, 1, 61 * 61, dtype=np.float32).reshape(61, 61) / 4
    write_parameters(tmp_path / "take.csv", ParameterClip("take", values, LIVE_LINK, 60.0))
    np.save(tmp_path / "take.npy", values)
    for words, rate in ((str(tmp_path / "take.csv"), 60.0), (f"{tmp_path / 'take.npy'}@live_link", 30.0)):
        recorded = recorded_parameters(words, 30.0)
        assert recorded is not None
        assert recorded.frame_rate == rate
        motion = channels_of(recorded, OWN, 30.0)
        assert np.abs(motion[:, -1]).max() == 0
        np.testing.assert_allclose(motion[:, :52], values[:: int(rate // 30), :52], atol=1e-6)


def test_what_is_no_motion_in_parameters_or_does_not_fit_is_said(tmp_path: Path) -> None:
    np.save(tmp_path / "vector.npy", np.zeros(8, np.float32))
    assert recorded_parameters(str(tmp_path / "vector.npy"), 25.0) is None
    assert recorded_parameters("F1", 25.0) is None
    with pytest.raises(FaceDiffError, match=r"gone\.npy"):
        recorded_parameters(f"{tmp_path / 'gone.npy'}@live_link", 25.0)
    without_head = ParameterClip("beat", np.zeros((4, 51), np.float32), layout("arkit_51"), 25.0)
    with pytest.raises(FaceDiffError, match="HeadYaw"):
        channels_of(without_head, OWN, 25.0)
    with pytest.raises(FaceDiffError, match="vertices"):
        channels_of(without_head, VERTICES, 25.0)
