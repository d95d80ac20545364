"""Blinks come as often as asked, never overlap, are never cut, and never shut an eye beyond shut."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.eyelids import Eyes
from facediff.editing.controls.procedural import blink_curve
from facediff.synthetic.head.parts import build_head
from tests.fakes.single_controls import add_blinks


def pulses(curve: np.ndarray) -> list[tuple[int, int]]:
    """First and last frame of each run of frames that are not 0."""
    busy = np.concatenate([[False], curve > 0, [False]]).astype(int)
    return list(zip(np.flatnonzero(np.diff(busy) == 1), np.flatnonzero(np.diff(busy) == -1) - 1, strict=True))


@pytest.mark.parametrize("rate", [5.0, 17.0, 26.0, 40.0])
def test_the_rate_over_an_hour_is_the_one_asked_for(rate: float) -> None:
    counts = [len(pulses(blink_curve(20 * 60 * 50, 50.0, rate=rate, seed=seed))) for seed in range(3)]
    assert sum(counts) / 60 == pytest.approx(rate, rel=0.08)


@pytest.mark.parametrize("frame_rate", [25.0, 30.0, 60.0, 120.0])
def test_every_blink_is_whole_shut_for_a_frame_and_apart_from_the_next(frame_rate: float) -> None:
    for seed in range(20):
        curve = blink_curve(round(20 * frame_rate), frame_rate, rate=26, seed=seed)
        assert curve[0] == 0
        assert curve[-1] == 0
        assert curve.min() >= 0
        assert curve.max() <= 1
        runs = pulses(curve)
        for first, last in runs:
            assert curve[first : last + 1].max() == pytest.approx(1.0, abs=1e-9)
            assert 0.2 < (last - first + 2) / frame_rate < 0.55
            top = curve[first : last + 1] > 1 - 1e-9
            assert (np.diff(curve[first : last + 1][: top.argmax() + 1]) > 0).all()  # down at once, then up
        gaps = [(later[0] - earlier[1]) / frame_rate for earlier, later in zip(runs, runs[1:], strict=False)]
        assert min(gaps, default=1.0) >= 0.15


def test_lids_shut_quicker_than_they_open_and_some_blinks_are_double() -> None:
    curve = blink_curve(600 * 200, 200.0, seed=4)
    runs = pulses(curve)
    down = [int(np.argmax(curve[a : b + 1] > 0.999)) for a, b in runs]
    up = [b - a - int(np.flatnonzero(curve[a : b + 1] > 0.999)[-1]) for a, b in runs]
    assert 0.07 < np.mean(down) / 200 < 0.12
    assert 0.15 < np.mean(up) / 200 < 0.24
    gaps = np.array([later[0] - earlier[1] for earlier, later in zip(runs, runs[1:], strict=False)]) / 200
    assert 0.03 < (gaps < 0.2).mean() < 0.25


def test_equal_seeds_give_equal_blinks(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(200)
    one, two, other = (add_blinks(animation, eyes, rate=30, seed=seed).vertices for seed in (1, 1, 2))
    assert np.array_equal(one, two)
    assert not np.array_equal(one, other)


def test_lids_meet_in_a_still_and_in_a_widened_eye_and_nothing_else_moves(
    make_animation: Callable[..., Animation], eyes: Eyes
) -> None:
    mesh = build_head()
    ring = mesh.groups["eye_edge"]
    upper, lower = ring[1:12], ring[13:][::-1]
    for animation in (make_animation(250), make_animation(250, eyeWide=0.5, eyeSquint=0.1, browOuterUp=0.4)):
        made = add_blinks(animation, eyes, rate=30)
        curve = blink_curve(250, 25.0, rate=30)
        frame = int(curve.argmax())
        gap = (made.vertices[frame, upper, 1] - made.vertices[frame, lower, 1]).max()
        open_gap = (animation.vertices[frame, upper, 1] - animation.vertices[frame, lower, 1]).max()
        assert open_gap > 0.007
        assert gap < 0.0008
        still = np.setdiff1d(np.arange(len(animation.template)), eyes.lids()[0])
        assert np.array_equal(made.vertices[:, still], animation.vertices[:, still])
        assert np.array_equal(made.vertices[curve == 0], animation.vertices[curve == 0])
        assert made.metadata["procedural"] == "blinks (30 a minute, seed 0)"


def test_an_eye_that_is_shut_already_stays_as_it_is(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    shut = make_animation(250, eyeBlink=1.0)
    made = add_blinks(shut, eyes, rate=40)
    np.testing.assert_allclose(made.vertices, shut.vertices, atol=1e-6)
    half = make_animation(250, eyeBlink=0.4)
    curve = blink_curve(250, 25.0, rate=40)
    expected = make_animation(250, eyeBlink=0.4 + curve * 0.6)
    lids = eyes.lids()[0]
    np.testing.assert_allclose(add_blinks(half, eyes, rate=40).vertices[:, lids], expected.vertices[:, lids], atol=1e-6)


@pytest.mark.parametrize("frames", [0, 1, 5])
def test_animations_too_short_for_a_blink_have_none(frames: int) -> None:
    assert not blink_curve(frames, 25.0, rate=40).any()
