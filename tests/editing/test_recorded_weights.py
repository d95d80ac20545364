"""Recordings of ARKit's weights are played by the built-in face, and written again as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import facediff
from facediff.errors import FaceDiffError
from facediff.spaces import layout
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters
from facediff.synthetic.known_faces import built_in_rig


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_recording_is_played_and_written_again(tmp_path: Path, suffix: str) -> None:
    space = layout("live_link")
    values = np.random.default_rng(0).random((40, 61)).astype(np.float32) / 4
    take = tmp_path / f"take{suffix}"
    write_parameters(take, ParameterClip("take", values, space, 30.0))
    animation = facediff.read(take)
    assert (animation.frame_rate, len(animation.vertices)) == (30.0, 40)
    rig = built_in_rig()
    decoded = rig.decode(np.asarray(values[:, [space.index(name) for name in rig.names]]))
    np.testing.assert_allclose(animation.still().vertices, decoded, atol=1e-5)
    animation.save(tmp_path / "again.csv")
    again = read_parameters(tmp_path / "again.csv")
    columns = slice(61) if suffix == ".csv" else slice(52)
    np.testing.assert_allclose(again.values[:40, columns], values[:, columns], atol=1e-6)


@pytest.mark.parametrize("order", ["live_link", "arkit_51"])
def test_weights_exported_as_beat_are_the_same_and_absent_ones_are_left_out(tmp_path: Path, order: str) -> None:
    space = layout(order)
    values = np.random.default_rng(1).random((9, len(space.channels))).astype(np.float32)
    write_parameters(tmp_path / "take.json", ParameterClip("take", values, space, 30.0))
    facediff.read(tmp_path / "take.json").save(tmp_path / "again.json")
    again, first = (read_parameters(tmp_path / name) for name in ("again.json", "take.json"))
    assert (again.space, again.frame_rate, again.times) == (first.space, 30.0, None)
    assert ("tongueOut" in again.space.channels) == (order == "live_link")
    np.testing.assert_array_equal(again.values, first.values)


def test_other_parameters_are_refused(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("a,b\n1,2\n")
    with pytest.raises(FaceDiffError, match=r"take\.csv"):
        facediff.read(tmp_path / "take.csv")
