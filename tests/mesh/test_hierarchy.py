"""The hierarchy's levels."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from facediff.mesh.hierarchy import coarsen, mesh_hierarchy
from facediff.mesh.spirals import spirals
from tests.fakes.meshes import relief, sphere

MESH = relief(16, 18)


def test_levels_follow_from_the_parts() -> None:
    made = mesh_hierarchy(*MESH, levels=2, spiral_length=9, dilation=2)
    template, faces = MESH[0].astype(np.float32).astype(float), MESH[1]
    assert [level.n_vertices for level in made.levels] == [288, 72, 18]
    for level in made.levels[:2]:
        np.testing.assert_array_equal(level.faces, faces)
        np.testing.assert_array_equal(level.spirals, spirals(faces, len(template), 9, 2, template))
        coarse = coarsen(template, faces, -(-len(template) // 4))
        assert level.down is not None
        np.testing.assert_equal(asdict(level.down), asdict(coarse.down))
        template, faces = coarse.template, coarse.faces
    assert made.levels[2].down is None
    np.testing.assert_array_equal(made.levels[2].spirals, spirals(faces, 18, 9, 2, template))


@pytest.mark.parametrize("vertices", [23, 64, 1008])
def test_numbers_of_vertices_depend_on_sizes_alone(vertices: int) -> None:
    sizes = [vertices]
    for _ in range(3):
        sizes.append(-(-sizes[-1] // 4))
    ball, faces = sphere(vertices // 7 - 1, 7)
    surface = (np.concatenate([ball, np.ones((vertices - len(ball), 3))]), faces)
    cloud = (np.random.default_rng(0).normal(size=(vertices, 3)), np.array([[0, 1, 2]]))
    for mesh in (surface, cloud):
        assert [level.n_vertices for level in mesh_hierarchy(*mesh).levels] == sizes
