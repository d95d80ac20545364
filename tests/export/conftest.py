"""A face in miniature that moves, speaks and has colours; none of it comes from the code under test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation

FRAMES, RATE = 40, 30.0


@pytest.fixture(scope="session")
def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2, radius=0.1)


@pytest.fixture
def make_animation(ball: trimesh.Trimesh) -> Callable[..., Animation]:
    """An animation of 162 vertices in which five shapes move up and down; keyword arguments override."""

    def make(**changes: object) -> Animation:
        rng = np.random.default_rng(0)
        template = (np.array(ball.vertices) * [1, 1.3, 0.8] + [0, 0.02, 0.01]).astype(np.float32)
        shapes = rng.normal(0, 2e-3, (5, *template.shape))
        time = np.arange(FRAMES)[:, None] / RATE
        weights = np.sin(2 * np.pi * (1 + np.arange(5)) * time + np.arange(5)) * 0.5 ** np.arange(5)
        animation = Animation(
            name="Hello Zoë",
            vertices=(template + np.tensordot(weights, shapes, axes=1)).astype(np.float32),
            template=template,
            frame_rate=RATE,
            faces=np.asarray(ball.faces, np.int32),
            speech=(rng.integers(-20000, 20000, 20_000) / 32768).astype(np.float32),
            colours=rng.integers(0, 256, (len(template), 3)).astype(np.uint8),
            metadata={"identity": "Zoë", "style": "F1_e01"},
        )
        return replace(animation, **changes)

    return make


@pytest.fixture
def animation(make_animation: Callable[..., Animation]) -> Animation:
    return make_animation()
