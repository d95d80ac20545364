"""Lids of one face moved as those of another: they meet, keep their share of the opening, and stay out of eyeballs."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation
from facediff.editing.face_features import Features, find_features
from facediff.editing.lid_transfer import EyeLids, eye_lids, eyeball_depth, lid_edges, swing, with_lids, without_lids
from facediff.editing.surface import Surface
from tests.fakes.heads import talking
from tests.fakes.small_face import eyelid_pairs

BLINK = 9  # the frame of `talking` in which the lids are shut


@pytest.fixture(scope="module")
def animation() -> Animation:
    return talking()


def taller(points: np.ndarray) -> np.ndarray:
    """Eyes that open one and a half times as far, in a face that stays as it is."""
    away = points - np.where(points[:, :1] < 0, [[-0.032, 0.0255, 0.07]], [[0.032, 0.0255, 0.07]])
    grown = 1 + 0.5 / (1 + (np.linalg.norm(away, axis=1) / 0.03) ** 6)
    return points + np.stack([0 * grown, (grown - 1) * away[:, 1], 0 * grown], axis=1)


@pytest.fixture(scope="module")
def lids(animation: Animation) -> tuple[Surface, Surface, list[EyeLids]]:
    source = Surface(animation.template.astype(np.float64), animation.triangles.astype(np.int64))
    laid = Surface(taller(source.vertices), source.faces)
    both = features_of(source, laid)
    found = eye_lids(source, laid, both, at_rest=False)
    assert found is not None
    return source, laid, found


def features_of(source: Surface, laid: Surface) -> tuple[Features, Features]:
    own = find_features(source.vertices, source.faces)
    assert own is not None
    seen = find_features(laid.vertices, laid.faces, own)
    assert seen is not None
    return own, seen


def carried(lids: tuple[Surface, Surface, list[EyeLids]], displacements: np.ndarray) -> np.ndarray:
    """The target's frames with nothing but what the lids do."""
    _, laid, eyes = lids
    moved = np.zeros((len(displacements), *laid.vertices.shape))
    with_lids(eyes, laid.vertices, moved, without_lids(eyes, displacements)[1])
    return laid.vertices + moved


def test_lids_of_taller_eyes_meet_and_do_not_pass(
    animation: Animation, lids: tuple[Surface, Surface, list[EyeLids]]
) -> None:
    source, laid, _ = lids
    blink = animation.vertices[BLINK].astype(np.float64) - source.vertices
    posed = carried(lids, np.stack([0 * blink, 0.5 * blink, blink, 1.4 * blink]))
    upper, lower = eyelid_pairs()

    def gaps(points: np.ndarray) -> np.ndarray:
        return np.asarray((points[..., upper, 1] - points[..., lower, 1]).mean(axis=-1))

    own = gaps(source.vertices)
    assert gaps(laid.vertices) > 1.3 * own
    left = gaps(posed) / gaps(laid.vertices)
    assert left[0] == pytest.approx(1)
    # Half of a blink leaves the share of the opening that it leaves on the source.
    assert left[1] == pytest.approx(gaps(source.vertices + 0.5 * blink) / own, abs=0.1)
    assert -0.15 < left[2] < 0.05
    assert left[3] == pytest.approx(left[2], abs=0.03)


def test_what_no_lid_does_is_carried_as_everything_else(
    animation: Animation, lids: tuple[Surface, Surface, list[EyeLids]]
) -> None:
    source, _, eyes = lids
    brows = animation.vertices[[10]].astype(np.float64) - source.vertices
    rest, _ = without_lids(eyes, brows)
    most = np.linalg.norm(brows, axis=2).max()
    above = np.linalg.norm(brows[0], axis=1) > 0.5 * most
    assert rest[0][above] == pytest.approx(brows[0][above], abs=0.1 * most)
    blink = animation.vertices[[BLINK]].astype(np.float64) - source.vertices
    left, _ = without_lids(eyes, blink)
    assert np.linalg.norm(left, axis=2).max() < 0.45 * np.linalg.norm(blink, axis=2).max()


def test_lids_that_rest_do_not_move(animation: Animation, lids: tuple[Surface, Surface, list[EyeLids]]) -> None:
    source, laid, _ = lids
    eyes = eye_lids(source, laid, features_of(source, laid), at_rest=True)
    assert eyes is not None
    blink = animation.vertices[[BLINK]].astype(np.float64) - source.vertices
    assert carried((source, laid, eyes), blink)[0] == pytest.approx(laid.vertices)


def test_lids_slide_over_eyeballs(animation: Animation, lids: tuple[Surface, Surface, list[EyeLids]]) -> None:
    """Balls that stand out further than the straight way of the lids: halfway no part of a lid is in them."""
    source, laid, eyes = lids
    middle = [eye.target.opening.centre for eye in eyes if eye.target is not None]
    ball = trimesh.creation.icosphere(3, 0.0165)
    points, faces = [laid.vertices], [laid.faces]
    for centre in middle:
        faces.append(np.array(ball.faces) + sum(map(len, points)))
        points.append(np.array(ball.vertices) + centre - [0, 0, 0.0125])
    whole = Surface(np.concatenate(points), np.concatenate(faces))
    both = features_of(source, whole)
    sliding = eye_lids(source, whole, both, at_rest=False)
    assert sliding is not None
    blink = 0.5 * (animation.vertices[[BLINK]].astype(np.float64) - source.vertices)
    dives = []
    for own in (eyes, sliding):
        posed = carried((source, whole, own), blink)[0]
        depths = []
        for eye in (0, 1):
            front = eyeball_depth(whole, both[1], eye)
            edges = lid_edges(whole.vertices, both[1], eye)
            assert front is not None
            assert edges is not None
            rim = np.unique(np.concatenate(edges.rims))
            before, after = (front.at(one[rim]) - one[rim, 2] for one in (whole.vertices, posed))
            depths.append(np.where(np.isfinite(after), after - np.maximum(before, 0), 0).max())
        dives.append(max(depths))
    assert dives[0] > 0.0002
    assert dives[1] < 0.0001


def test_lashes_turn_down_with_the_upper_lid(
    animation: Animation, lids: tuple[Surface, Surface, list[EyeLids]]
) -> None:
    """Lashes keep their length, point down at a full blink, and those of the lower lid keep their direction."""
    source, laid, eyes = lids
    upper, lower = (np.concatenate([eye.target.rims[side][2:-2] for eye in eyes if eye.target]) for side in (0, 1))
    roots = np.concatenate([upper, lower])
    lashes = len(laid.vertices) + np.arange(len(roots))
    outwards = np.array([0.0, 0.002, 0.008])
    vertices = np.concatenate([laid.vertices, laid.vertices[roots] + outwards])
    blink = animation.vertices[BLINK].astype(np.float64) - source.vertices
    skin = carried(lids, np.stack([0 * blink, 0.5 * blink, blink])) - laid.vertices
    moved = np.concatenate([skin, skin[:, roots]], axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(roots), 1))
    turned = outwards + swing(eyes, vertices, lashes, np.repeat(roots[:, None], 3, axis=1), weights, moved)
    assert np.linalg.norm(turned, axis=2) == pytest.approx(np.linalg.norm(outwards))
    pitch = np.rad2deg(np.arctan2(turned[..., 1], turned[..., 2]))
    assert pitch[0] == pytest.approx(pitch[0, 0])
    assert turned[:, len(upper) :] == pytest.approx(np.broadcast_to(outwards, turned[:, len(upper) :].shape))
    full = pitch[2, : len(upper)]
    assert np.median(pitch[0, 0] - full) > 25
    assert (full < pitch[1, : len(upper)] + 1e-9).mean() > 0.9
    assert np.median(full) < -10
    # A lid turns as one: the same at its middle and near its corners, up to how the axes of both eyes lie.
    assert np.ptp(full) < 3
