"""Maps of vertices against plain NumPy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from facediff.evaluation.figures import FigureData, motion_maps
from facediff.evaluation.figures import material as material_module
from facediff.utils.pickles import load_pickle

Read = Callable[[str, str], NDArray[np.float64]]
NAMES = ["truth", "ours", "theirs"]
CLIPS = ["A_e06", "A_e07", "B_e06"]


@pytest.fixture(params=[2**20, 100], ids=["whole clips", "single frames"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(material_module, "CHUNK", request.param)


@pytest.mark.usefixtures("chunk")
def test_motion_maps_are_distances_from_the_identitys_template(
    own_material: FigureData, read: Read, tiny_root: Path
) -> None:
    templates = load_pickle(tiny_root / "templates.pkl")
    maps, notes = motion_maps(own_material, own_material.choose())
    assert own_material.choose() == CLIPS
    assert list(maps) == NAMES
    assert notes == []
    for name, found in maps.items():
        far = np.concatenate(
            [np.sqrt(((read(name, clip) - np.float32(templates[clip[0]])) ** 2).sum(2)) for clip in CLIPS]
        )
        np.testing.assert_allclose(found.mean, far.mean(0), rtol=1e-9)
        np.testing.assert_allclose(found.deviation, far.std(0), rtol=1e-9)
        assert found.frames == len(far)
