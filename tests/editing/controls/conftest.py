from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.eyes import Eyes
from facediff.synthetic.corpus import regions, rig_of
from facediff.synthetic.face import build_face
from facediff.synthetic.rig import CONTROLS, LINEAR_FIELDS


@pytest.fixture(scope="session")
def eyes() -> Eyes:
    """The eyes of puppet F1, put together here from the rig and from the mesh's groups."""
    mesh, rig = build_face(), rig_of("F1")
    left = np.concatenate([mesh.groups[name] for name in mesh.groups if name.startswith("eyeball") or name == "pupil"])
    closing = rig.fields[LINEAR_FIELDS.index("lids_close")].astype(np.float32)
    return Eyes(closing, (left, mesh.mirror[left]), "F1")


@pytest.fixture(scope="session")
def make_animation() -> Callable[..., Animation]:
    """An animation of puppet F1 with given weights of the rig, constant or (T,)."""

    def make(frames: int = 250, frame_rate: float = 25.0, **weights: object) -> Animation:
        rig, named = rig_of("F1"), regions()
        rows = np.zeros((frames, len(CONTROLS)))
        for name, value in weights.items():
            rows[:, CONTROLS.index(name)] = value
        return Animation(
            name="F1",
            vertices=rig.pose(rows).astype(np.float32),
            template=rig.neutral.astype(np.float32),
            frame_rate=frame_rate,
            faces=build_face().faces.astype(np.int32),
            regions={"lips": named["lve"], "upper_face": named["fdd"]},
            metadata={"identity": "F1"},
        )

    return make
