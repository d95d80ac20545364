"""The fields are smooth, act where their names say, and the lips meet and never cross."""

import numpy as np
import pytest

from facediff.synthetic.corpus import regions, rig_of
from facediff.synthetic.face import build_face
from facediff.synthetic.rig import CONTROLS, LINEAR_FIELDS, Shape, build_rig
from facediff.synthetic.speakers import SPEAKERS


def weights(**values: float) -> np.ndarray:
    row = np.zeros((1, len(CONTROLS)))
    for name, value in values.items():
        row[0, CONTROLS.index(name)] = value
    return row


def gap(vertices: np.ndarray, rig: object) -> np.ndarray:
    return vertices[:, rig.upper, 1] - vertices[:, rig.lower, 1]  # type: ignore[attr-defined]


def test_at_least_twelve_fields_move_something_by_millimetres() -> None:
    rig = rig_of("F1")
    assert len(LINEAR_FIELDS) >= 12
    reach = np.linalg.norm(rig.fields, axis=2).max(axis=1)
    assert (reach > 0.001).all()
    assert (reach < 0.035).all()


def test_fields_are_smooth_over_the_skin() -> None:
    """Neighbours on the skin move alike: no field changes by more than its height over half a centimetre."""
    mesh = build_face()
    rig = build_rig(Shape())
    skin = np.zeros(len(mesh.vertices), dtype=bool)
    skin[mesh.both("skin")] = True
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])
    edges = edges[skin[edges].all(axis=1)]
    length = np.linalg.norm(rig.neutral[edges[:, 0]] - rig.neutral[edges[:, 1]], axis=1)
    for name, field in zip(LINEAR_FIELDS, rig.fields, strict=True):
        change = np.linalg.norm(field[edges[:, 0]] - field[edges[:, 1]], axis=1)
        peak = np.linalg.norm(field, axis=1).max()
        assert (change <= peak * (0.12 + length / 0.005)).all(), name


def test_fields_act_in_their_part_of_the_face() -> None:
    rig = rig_of("M1")
    lips, upper = regions()["lve"], regions()["fdd"]
    size = np.linalg.norm(rig.fields, axis=2)
    for name, field in zip(LINEAR_FIELDS, size, strict=True):
        if name.endswith(("brow_up", "brow_frown")) or name.startswith("lids"):
            assert field[lips].max() < 1e-6, name
        if name in ("jaw_open", "pucker", "funnel", "stretch", "lip_press", "lower_lip_tuck"):
            assert field[upper].max() < 2e-5, name


def test_a_larger_mouth_makes_larger_moves() -> None:
    small, large = build_rig(Shape(mouth_width=-1.0)), build_rig(Shape(mouth_width=1.0))
    pucker = LINEAR_FIELDS.index("pucker")
    assert np.abs(large.fields[pucker, :, 0]).max() > 1.1 * np.abs(small.fields[pucker, :, 0]).max()


@pytest.mark.parametrize("speaker", list(SPEAKERS))
def test_lips_rest_closed_open_wide_and_close_over_an_open_jaw(speaker: str) -> None:
    rig = rig_of(speaker)
    assert np.abs(gap(rig.neutral[None], rig)).max() < 1e-6
    assert 0.012 < gap(rig.pose(weights(jaw_open=1.0)), rig).max() < 0.025
    for jaw in (0.2, 0.6, 1.0):
        shut = rig.pose(weights(jaw_open=jaw, lip_closure=1.0, pucker=0.3, lower_lip_drop=0.3))
        assert np.abs(gap(shut, rig)).max() < 0.0003


def test_lips_never_cross() -> None:
    random = np.random.default_rng(3)
    rows = np.zeros((200, len(CONTROLS)))
    rows[:, : LINEAR_FIELDS.index("chin_raise") + 1] = random.uniform(0.0, 1.0, (200, 13))
    rows[:, CONTROLS.index("lip_closure")] = random.uniform(0.0, 1.0, 200)
    rig = rig_of("F2")
    assert gap(rig.pose(rows), rig).min() > -0.00025


def test_pressing_the_lips_leaves_them_shut() -> None:
    rig = rig_of("F1")
    assert np.abs(gap(rig.pose(weights(lip_press=1.0, chin_raise=1.0)), rig)).max() < 0.0006


def test_lids_close_the_eye() -> None:
    mesh = build_face()
    edge = mesh.groups["eye_0"]
    rig = rig_of("M4")
    shut = rig.pose(weights(lids_close=1.0))[0]
    top, bottom = edge[1:8], edge[9:][::-1]
    before = (rig.neutral[top, 1] - rig.neutral[bottom, 1]).max()
    after = np.abs(shut[top, 1] - shut[bottom, 1]).max()
    assert before > 0.006
    assert after < 0.1 * before
    assert np.ptp(rig.fields[:, mesh.both("pupil")], axis=0).max() == 0.0


def test_asymmetry_makes_one_side_stronger() -> None:
    mesh = build_face()
    rig = build_rig(Shape(), asymmetry=0.2)
    corner = mesh.groups["mouth_0"][7]
    smile = np.linalg.norm(rig.fields[LINEAR_FIELDS.index("corner_up")], axis=1)
    assert smile[corner] > 1.3 * smile[mesh.mirror[corner]]
