"""Ambient occlusion against what geometry says: nothing hides on a convex body, a wall hides its share of the sky."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from facediff.render.occlusion import KEPT, lines_of_sight, occlusion, sky_seen
from facediff.synthetic.head.parts import build_head
from facediff.synthetic.head.rig import head_shapes

Array = NDArray[np.float64]


@pytest.mark.parametrize("seed", range(3))
def test_nothing_hides_anything_on_a_convex_body(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.normal(size=(60, 3)) * [1.0, 0.6, 1.4]
    for body in (
        trimesh.creation.icosphere(2, 0.3),
        trimesh.convex.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True)),
    ):
        assert sky_seen(body.vertices, body.faces).min() == 1.0
        assert occlusion(body.vertices, body.faces).min() == 1.0


def floor_and_wall(height: float, rows: int = 24) -> tuple[Array, NDArray[np.int64]]:
    """A floor, 24 long and 2 deep, and a wall along its edge, as grids of (rows, 49) vertices each."""
    place, along = np.meshgrid(np.linspace(0, 1, rows), np.linspace(-12, 12, 49), indexing="ij")
    flat, number = np.zeros_like(place), np.arange(place.size).reshape(place.shape)
    wall = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], -1).reshape(-1, 4)
    quads = np.concatenate([wall[:, ::-1], wall + place.size])
    vertices = (
        np.stack([[along, flat, 2.0 * place], [along, height * place, flat]]).transpose(0, 2, 3, 1).reshape(-1, 3)
    )
    halves = np.split(quads, 2)
    return vertices, np.concatenate([half[:, corners] for half in halves for corners in ([0, 1, 2], [0, 2, 3])])


def test_a_wall_hides_what_the_form_factor_says() -> None:
    height, rows = 4.0, 24
    vertices, faces = floor_and_wall(height, rows)
    middle = np.arange(rows) * 49 + 24
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    assert (normals[: len(faces) // 2, 1] > 0).all()
    assert (normals[len(faces) // 2 :, 2] > 0).all()
    seen = sky_seen(vertices, faces)[middle]
    distance = vertices[middle, 2]
    # A floor element next to a wall of endless length (Howell, catalogue of configuration factors, A-1).
    expected = 0.5 * (1.0 + distance / np.hypot(distance, height))
    assert np.abs(seen - expected)[3:-1].max() < 0.15  # the lines of sight are 24
    assert seen[2:8].mean() < seen[-8:-2].mean() - 0.05


def test_little_sky_is_seen_inside_a_closed_room() -> None:
    room = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
    seen = sky_seen(room.vertices, room.faces[:, ::-1])  # at a grazing angle the depth maps are too coarse
    assert seen.max() < 0.25
    assert seen.mean() < 0.12
    assert occlusion(room.vertices, room.faces[:, ::-1]).min() >= KEPT


def test_size_and_mirror_change_nothing() -> None:
    body = trimesh.creation.torus(1.0, 0.45, 24, 12)
    seen = sky_seen(body.vertices, body.faces)
    assert 0.2 < seen.min() < 0.8
    assert np.allclose(sky_seen(1000.0 * body.vertices, body.faces), seen, atol=0.02)
    mirrored = sky_seen(body.vertices * [-1, 1, 1], body.faces[:, ::-1])
    assert np.allclose(mirrored, seen, atol=1e-9)
    axes = lines_of_sight(24)
    assert np.allclose(np.linalg.norm(axes, axis=1), 1.0)
    assert np.abs(axes.mean(axis=0) * [1, 0, 1]).max() < 0.1


def test_teeth_have_the_light_of_an_open_mouth_and_no_other_place_has() -> None:
    head, shapes = build_head(), head_shapes()
    light = occlusion(head.vertices, head.faces)
    smile = {
        "jawOpen": 0.3,
        "mouthSmileLeft": 0.6,
        "mouthSmileRight": 0.6,
        "mouthUpperUpLeft": 0.5,
        "mouthUpperUpRight": 0.5,
    }
    opened = head.vertices + sum(weight * shapes[name] for name, weight in smile.items())
    teeth = head.groups["teeth_upper_middle"][:6]  # in front
    assert np.abs(light[teeth] - (KEPT + (1 - KEPT) * sky_seen(opened, head.faces)[teeth])).max() < 0.15
    others = np.setdiff1d(np.arange(len(light)), head.both("teeth_", "tongue_"))
    expected = KEPT + (1 - KEPT) * sky_seen(head.vertices, head.faces)
    assert np.allclose(light[others], expected[others])
    assert expected[teeth].max() < KEPT + 0.05  # with the mouth shut
