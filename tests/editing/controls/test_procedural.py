"""Eyes jump and rest, heads drift; both are small, begin and end at rest, and move rigid things rigidly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.eyelids import Eyes
from facediff.editing.controls.procedural import (
    gaze_curve,
    gaze_rotations,
    sphere_centre,
    sway_curve,
)
from facediff.mesh import robust_align
from tests.fakes.single_controls import add_blinks, add_gaze, add_sway, scale_regions


def test_gaze_stays_in_its_bounds_and_begins_and_ends_straight_ahead() -> None:
    reached = 0.0
    for seed in range(40):
        for frames in (3, 20, 250):
            curve = gaze_curve(frames, 25.0, degrees=6, seed=seed)
            assert np.abs(curve[0]).max() == 0
            assert np.abs(curve[-1]).max() < 1e-9
            size = np.linalg.norm(curve, axis=1)
            assert size.max() <= 6 + 1e-9
            reached = max(reached, float(size.max()))
    assert reached > 5


def test_gaze_is_fixations_and_quick_saccades() -> None:
    curve = gaze_curve(100 * 300, 100.0, seed=2)
    moving = np.linalg.norm(np.diff(curve, axis=0), axis=1) > 1e-9
    assert moving.mean() < 0.08
    starts = np.flatnonzero(np.diff(np.concatenate([[False], moving]).astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.concatenate([moving, [False]]).astype(int)) == -1)
    assert len(starts) > 150
    assert (ends - starts + 1).max() <= 5  # 21 ms + 2.2 ms for each of at most 8 degrees, in 10 ms frames
    assert np.diff(starts).min() / 100 > 0.2


def test_eyeballs_turn_about_their_centres_by_the_angle(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(250, jawOpen=0.3)
    made = add_gaze(animation, eyes, degrees=8, seed=1)
    angles = gaze_curve(250, 25.0, degrees=8, seed=1)
    frame = int(np.abs(angles).sum(1).argmax())
    for ball in eyes.eyeballs:
        rest = animation.template[ball].astype(float)
        fit = robust_align(rest, made.vertices[frame, ball].astype(float))
        turned = np.degrees(np.arccos((np.trace(fit.rotation) - 1) / 2))
        forward = fit.rotation @ [0, 0, 1]
        left, up = np.deg2rad(angles[frame])
        expected = [np.sin(left) * np.cos(up), np.sin(up), np.cos(left) * np.cos(up)]
        np.testing.assert_allclose(forward, expected, atol=1e-4)
        assert turned == pytest.approx(np.linalg.norm(angles[frame]), rel=0.02)
        centre = sphere_centre(rest)
        np.testing.assert_allclose(fit.apply(centre[None])[0], centre, atol=2e-6)
    skin = np.setdiff1d(np.arange(len(animation.template)), np.concatenate([*eyes.eyeballs, eyes.lids()[0]]))
    assert np.array_equal(made.vertices[:, skin], animation.vertices[:, skin])
    assert made.metadata["procedural"] == "gaze (8 degrees, seed 1)"


def test_lids_follow_eyes_that_look_down(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(250)
    made = add_gaze(animation, eyes, degrees=8, seed=1)
    up = gaze_curve(250, 25.0, degrees=8, seed=1)[:, 1]
    lids, closing = eyes.lids()
    share = ((made.vertices - animation.vertices)[:, lids] * closing).sum((1, 2)) / (closing**2).sum()
    assert up.min() < -1
    assert up.max() > 1
    np.testing.assert_allclose(share, -0.012 * up, atol=1e-5)


def test_rotations_turn_left_and_up() -> None:
    forward = gaze_rotations(np.array([[90.0, 0.0], [0.0, 90.0], [0.0, 0.0]])) @ [0, 0, 1]
    np.testing.assert_allclose(forward, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)


def test_sway_moves_the_head_as_one_within_its_bounds(make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(250, jawOpen=np.linspace(0, 1, 250))
    made = add_sway(animation, degrees=3, seed=5)
    angles, shifts = [], []
    for frame in range(0, 250, 10):
        fit = robust_align(animation.vertices[frame].astype(float), made.vertices[frame].astype(float))
        np.testing.assert_allclose(fit.apply(animation.vertices[frame].astype(float)), made.vertices[frame], atol=1e-6)
        angles.append(np.degrees(np.arccos(np.clip((np.trace(fit.rotation) - 1) / 2, -1, 1))))
        shifts.append(np.linalg.norm((made.vertices[frame] - animation.vertices[frame]).mean(0)))
    assert 1.5 < max(angles) <= 3 + 1e-3
    assert max(shifts) < 0.02
    assert np.array_equal(made.vertices[[0, -1]], animation.vertices[[0, -1]])
    assert made.metadata["procedural"] == "head sway (3 degrees, seed 5)"
    assert np.array_equal(made.vertices, add_sway(animation, degrees=3, seed=5).vertices)


def test_sway_is_slow() -> None:
    turns, shifts = sway_curve(30 * 60, 30.0, seed=3)
    for track in (*turns.T, *shifts.T):
        power = np.abs(np.fft.rfft(track)) ** 2
        rates = np.fft.rfftfreq(len(track), 1 / 30)
        assert power[rates > 1.0].sum() < 1e-3 * power.sum()
    speed = np.degrees(np.linalg.norm(np.diff(turns, axis=0), axis=1)) * 30
    assert speed.max() < 12  # degrees a second
    assert np.degrees(np.linalg.norm(turns, axis=1).max()) == pytest.approx(2.0)


@pytest.mark.parametrize("frames", [1, 2, 3, 10])
def test_short_animations_can_sway_and_gaze(frames: int, make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(frames)
    made = add_sway(add_gaze(animation, eyes))
    assert np.isfinite(made.vertices).all()
    np.testing.assert_allclose(made.vertices[[0, -1]], animation.vertices[[0, -1]], atol=1e-7)


def test_layers_do_not_change_one_another_and_are_all_named(
    make_animation: Callable[..., Animation], eyes: Eyes
) -> None:
    animation = make_animation(250)
    alone = add_blinks(animation, eyes).vertices - animation.vertices
    gazing = add_gaze(animation, eyes)
    both = add_blinks(gazing, eyes)
    changed = np.flatnonzero(np.abs(alone).max((1, 2)))
    again = np.flatnonzero(np.abs(both.vertices - gazing.vertices).max((1, 2)))
    assert np.array_equal(changed, again)
    assert both.metadata["procedural"] == "gaze (4 degrees, seed 0); blinks (17 a minute, seed 0)"


def test_an_animation_on_disk_is_changed_on_disk_and_leaves_no_file(
    make_animation: Callable[..., Animation], eyes: Eyes, tmp_path: Path
) -> None:
    animation = make_animation(300, jawOpen=0.5)
    np.save(tmp_path / "long.npy", animation.vertices)
    mapped = replace(animation, vertices=np.load(tmp_path / "long.npy", mmap_mode="r"))

    def all_of_it(animation: Animation) -> Animation:
        return add_sway(add_blinks(add_gaze(scale_regions(animation, {"lips": 1.5}, eyes), eyes), eyes))

    made = all_of_it(mapped)
    assert isinstance(made.vertices, np.memmap)
    assert np.array_equal(made.vertices, all_of_it(animation).vertices)
    assert [path.name for path in tmp_path.iterdir()] == ["long.npy"]
