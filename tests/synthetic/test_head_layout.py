"""The layout of quads over the skin of the second edition's head."""

from __future__ import annotations

import numpy as np

from facediff.synthetic.head.layout import EYE_POINTS, MOUTH_POINTS, eye_ring, lay_out, mouth_ring
from facediff.synthetic.head.mask import N_MASK_VERTICES, build_mask
from facediff.synthetic.head.parts import N_HEAD_VERTICES, build_head
from facediff.synthetic.head.surface import plane_of, skin, skin_at


def test_quads_do_not_fold() -> None:
    layout = lay_out()
    corners = layout.plane[layout.quads] * [70.0, 1.0]
    sides = np.roll(corners, -1, axis=1) - corners
    turns = sides[:, :, 0] * np.roll(sides, -1, axis=1)[:, :, 1] - sides[:, :, 1] * np.roll(sides, -1, axis=1)[:, :, 0]
    # A quad may have a corner that is bent inwards at the rim of a hole, but none is turned over.
    assert (turns.sum(axis=1) > 0).all()
    assert (turns > 0).mean() > 0.99


def test_holes_have_the_loops_that_features_need() -> None:
    layout = lay_out()
    assert len(layout.holes["mouth"]) == MOUTH_POINTS
    assert len(layout.holes["eye"]) == EYE_POINTS
    for name, border in layout.holes.items():
        assert len(set(border.tolist())) == len(border), name
        used = np.isin(layout.quads, border).sum(axis=1)
        assert (used >= 2).sum() >= len(border) - 1, name  # each edge of the border belongs to a quad
    assert np.allclose(layout.plane[layout.holes["mouth"][[0, -1]], 0], 0.0)


def test_outlines_lie_around_one_another() -> None:
    for ring in (mouth_ring, eye_ring):
        centre = ring(0.0).mean(axis=0)
        inner, outer = (np.linalg.norm(ring(distance) - centre, axis=1) for distance in (0.0, 4.0))
        assert (outer > inner).all()


def test_the_front_is_found_again() -> None:
    places = np.array([[0.0, -46.0], [25.0, -46.0], [31.0, 25.0], [12.0, 60.0], [50.0, 0.0]])
    plane = plane_of(places)
    assert np.allclose(skin(*plane.T)[[0, 3], :2], places[[0, 3]], atol=0.6)
    assert np.allclose(skin_at(places)[0, 0], 0.0)


def test_the_counts_that_are_known_without_building_are_those_of_the_meshes() -> None:
    assert len(build_head().vertices) == N_HEAD_VERTICES
    assert build_mask().operator.shape[0] == N_MASK_VERTICES
