"""People of the second edition: faces that differ and still work."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from facediff.synthetic.head.parts import EYE_CENTRE, build_head
from facediff.synthetic.head.people import HAIR_COLOURS, SKIN_TONES, Complexion, Face, coloured, dressed
from facediff.synthetic.head.rig import eyelid_pairs, head_shapes, lip_pairs


def test_the_average_face_changes_nothing() -> None:
    mesh = build_head()
    assert np.array_equal(Face()(mesh.vertices), mesh.vertices)
    assert np.allclose(dressed(Face(), mesh, Complexion()), mesh.vertices)


@pytest.mark.parametrize("seed", range(3))
def test_anybody_can_blink_and_close_the_mouth(seed: int) -> None:
    mesh, shapes, random = build_head(), head_shapes(), np.random.default_rng(seed)
    face = Face(**{item.name: float(random.uniform(-1, 1)) for item in fields(Face)})
    rest = face(mesh.vertices)
    assert 1.0 < np.abs(rest - mesh.vertices).max() < 30.0
    closed = face(mesh.vertices + 0.5 * shapes["jawOpen"] + 0.5 * shapes["mouthClose"])
    upper, lower = lip_pairs(mesh)
    assert np.linalg.norm(closed[upper] - closed[lower], axis=1).max() < 0.3
    shut = face(mesh.vertices + shapes["eyeBlinkLeft"] + shapes["eyeBlinkRight"])
    upper, lower = eyelid_pairs(mesh)
    assert np.linalg.norm(shut[upper] - shut[lower], axis=1).max() < 0.9


def test_eyeballs_stay_balls() -> None:
    mesh = build_head()
    ball = np.concatenate([mesh.groups[name] for name in mesh.groups if name.startswith("ball_")])
    for item in fields(Face):
        points = replace(Face(), **{item.name: 1.0})(mesh.vertices)[ball]
        # The centre of a ball: the point whose distances from all of them are alike.
        system = np.concatenate([2.0 * points, np.ones((len(points), 1))], axis=1)
        solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
        distances = np.linalg.norm(points - solution[:3], axis=1)
        assert distances.std() / distances.mean() < 0.02, item.name
        assert np.linalg.norm(solution[:3] - EYE_CENTRE) < 6.0, item.name


def test_complexions_colour_what_they_name() -> None:
    mesh = build_head()
    skin, hair = mesh.groups["mouth_near"], mesh.groups["hair"]
    tones = [coloured(mesh, Complexion(skin=name))[skin].mean() for name in SKIN_TONES]
    assert tones == sorted(tones, reverse=True)
    for name, colour in HAIR_COLOURS.items():
        assert np.allclose(coloured(mesh, Complexion(hair=name))[hair].mean(axis=0), colour, atol=30), name
    eye = mesh.both("ball_3", "iris_")
    above = mesh.vertices[eye, 1] > EYE_CENTRE[1] + 2.0
    light = coloured(mesh, Complexion())[eye].sum(axis=1)
    assert light[above].mean() < 0.8 * light[~above].mean()  # the upper lid shades it
    for style in ("short", "cropped", "bald", "bob", "long", "bun"):
        points = dressed(Face(), mesh, Complexion(style=style))  # type: ignore[arg-type]
        moved = np.flatnonzero(np.abs(points - mesh.vertices).max(axis=1) > 1e-9)
        assert set(moved) <= set(mesh.both("hair")), style
        assert np.allclose(points[mesh.mirror], points * [-1, 1, 1]), style
