"""Shapes of whole avatars: several parts, skins, units; weights for the avatar's own targets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, solve
from facediff.editing.retargeting import retarget_shapes
from facediff.editing.shapes import read_shapes
from facediff.mesh import read_mesh
from facediff.mesh.glb import open_glb
from facediff.mesh.glb_scene import placed_parts
from facediff.spaces.shape_files import read_shape_files
from tests.fakes.avatar import AvatarPart, avatar_parts, write_avatar
from tests.fakes.heads import talking

LOOK = "eyeLookUpLeft"


@pytest.fixture(scope="module")
def parts() -> dict[str, AvatarPart]:
    """Eyes first, with as many targets as the head, of which few move them: as exporters of avatars write."""
    made = avatar_parts(rounds=0)
    eyes = {}
    for name in ("EyeLeft", "EyeRight"):
        still = np.zeros_like(made[name].vertices)
        up = still + [0.0, 0.004, 0.0]
        eyes[name] = AvatarPart(
            made[name].vertices,
            made[name].faces,
            {target: up if target == LOOK and name == "EyeLeft" else still for target in made["Head"].targets},
        )
    return {**eyes, **{name: part for name, part in made.items() if name not in eyes}}


@pytest.mark.parametrize("layout", [{}, {"unit": 1000.0, "z_up": False, "skinned": False, "sparse": False}])
def test_parts_are_read_together_where_they_are_shown(
    tmp_path: Path, parts: dict[str, AvatarPart], layout: dict[str, float | bool]
) -> None:
    write_avatar(tmp_path / "a.glb", parts, **layout)
    found = read_shape_files(tmp_path / "a.glb")
    assert set(found.names) == set(parts["Head"].targets)
    assert found.neutral is not None
    moves = dict(zip(found.names, found.shapes - found.neutral, strict=True))
    first = 0
    for placed in placed_parts(open_glb(tmp_path / "a.glb")):
        part = next(parts[name] for name in parts if f"{name}Material" in placed.names)
        if not part.targets:
            continue
        rows = slice(first, first + len(part.vertices))
        assert found.neutral[rows] == pytest.approx(part.vertices, abs=2e-6)
        for name in ("jawOpen", LOOK):
            assert moves[name][rows] == pytest.approx(part.targets[name], abs=2e-6)
        first += len(part.vertices)
    assert first == len(found.neutral)


def test_an_animation_on_the_avatar_gets_weights_of_its_own_targets(
    tmp_path: Path, parts: dict[str, AvatarPart]
) -> None:
    write_avatar(tmp_path / "a.glb", parts)
    mesh = read_mesh(tmp_path / "a.glb")
    shapes = read_shapes(tmp_path / "a.glb", mesh.vertices)
    jaw, look = (shapes.names.index(name) for name in ("jawOpen", LOOK))
    truth = np.zeros((7, 52))
    truth[:, jaw], truth[:, look] = np.linspace(0, 0.9, 7), np.linspace(0.5, 0, 7)
    vertices = mesh.vertices + np.einsum("tk,kvc->tvc", truth, shapes.deltas)
    animation = Animation("own", vertices.astype("f4"), mesh.vertices.astype("f4"), 25.0, faces=mesh.faces)
    found = solve(animation, shapes, SolveOptions(smoothness=0.0, sparsity=0.0))
    assert found.values == pytest.approx(truth, abs=1e-3)


def test_an_avatars_shapes_are_carried_to_another_face(tmp_path: Path, parts: dict[str, AvatarPart]) -> None:
    """Its jaw opens as far on the face, in millimetres, and the weights are those that the face was posed with."""
    write_avatar(tmp_path / "a.glb", parts)
    animation = talking()
    found = retarget_shapes(tmp_path / "a.glb", animation)
    widest = np.linalg.norm(found.deltas[found.names.index("jawOpen")], axis=1).max()
    own = np.linalg.norm(parts["Head"].targets["jawOpen"], axis=1).max()
    assert widest == pytest.approx(own, rel=0.15)
    weights = solve(animation, found, SolveOptions())
    assert weights.values[:4, weights.names.index("jawOpen")] == pytest.approx([0, 0.3, 0.7, 1], abs=0.1)
    assert (weights.residual_rms_mm[3] / weights.amplitude_mm) < 0.5
