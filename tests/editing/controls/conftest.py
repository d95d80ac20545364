from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.eyelids import Eyes
from facediff.synthetic.corpus import region_vertices
from facediff.synthetic.head.parts import build_head
from facediff.synthetic.known_faces import built_in_rig


@pytest.fixture(scope="session")
def eyes() -> Eyes:
    """The eyes of speaker F1, put together here from the rig and from the mesh's groups."""
    mesh, rig = build_head(), built_in_rig("F1")
    left = np.concatenate([mesh.groups[n] for n in mesh.groups if n.startswith(("ball_", "iris_", "pupil", "glint"))])
    closing = rig.deltas[[name.startswith("eyeBlink") for name in rig.names]].sum(axis=0)
    return Eyes(closing.astype(np.float32), (left, mesh.mirror[left]), "F1")


@pytest.fixture(scope="session")
def make_animation() -> Callable[..., Animation]:
    """An animation of speaker F1 with given weights, constant or (T,), of ARKit's shapes of both sides."""
    rig, regions = built_in_rig("F1"), region_vertices()

    def make(frames: int = 250, frame_rate: float = 25.0, **weights: object) -> Animation:
        vertices = np.repeat(rig.neutral[None], frames, axis=0).astype(np.float32)
        for name, value in weights.items():
            shape = sum(rig.deltas[rig.names.index(n)] for n in (name, f"{name}Left", f"{name}Right") if n in rig.names)
            vertices += (np.broadcast_to(value, frames)[:, None, None] * shape).astype(np.float32)
        return Animation(
            name="F1",
            vertices=vertices,
            template=rig.neutral.astype(np.float32),
            frame_rate=frame_rate,
            faces=build_head().faces.astype(np.int32),
            regions={"lips": regions["lve"], "upper_face": regions["fdd"]},
            metadata={"identity": "F1"},
        )

    return make
