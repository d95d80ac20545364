"""Weights without shapes that cancel one another, keys of curves, and weights that mean nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, key_frames, solve
from facediff.editing.bounded import least_squares
from facediff.editing.shapes import ShapeSet, check_shapes, read_shapes
from facediff.errors import FaceDiffError
from facediff.synthetic.known_faces import built_in_shapes

RNG = np.random.default_rng(3)
NEUTRAL = RNG.normal(0, 0.08, (60, 3))
BLINK, JAW = RNG.normal(0, 0.005, (2, 60, 3))
# Opposite shapes whose sum is a little more than nothing, as those of lids that shut and open wide.
OPPOSITE = ShapeSet(
    ("eyeBlinkLeft", "eyeWideLeft", "jawOpen"),
    NEUTRAL,
    np.stack([BLINK, -0.4 * BLINK + RNG.normal(0, 0.0005, (60, 3)), JAW]),
)


def motion(weights: np.ndarray, noise: float = 0.0) -> Animation:
    moved = NEUTRAL + np.einsum("tk,kvc->tvc", weights, OPPOSITE.deltas)
    return Animation("a", moved + RNG.normal(0, noise, moved.shape), NEUTRAL, 30.0)


def weights_of(frames: int) -> np.ndarray:
    """A blink in the middle and a jaw that never rests."""
    time = np.linspace(0, 1, frames)
    blink = np.clip(1 - np.abs(time - 0.5) / 0.1, 0, 1)
    return np.stack([blink, np.zeros(frames), 0.5 + 0.4 * np.sin(12 * time)], axis=1)


def test_shapes_that_cancel_one_another_rest() -> None:
    goal = weights_of(60)
    noisy = motion(goal, noise=0.0008)
    standing = solve(noisy, OPPOSITE, SolveOptions(sparsity=0)).values
    found = solve(noisy, OPPOSITE, SolveOptions(sparsity=0.02)).values
    resting = goal[:, 0] == 0
    both = np.minimum(standing[resting, 0], standing[resting, 1])
    assert (both > 0.01).mean() > 0.2, "without sparsity, noise puts both to work"
    assert (np.minimum(found[resting, 0], found[resting, 1]) > 0.01).mean() < 0.1
    assert np.abs(found[resting, :2]).mean() < 0.5 * np.abs(standing[resting, :2]).mean()
    assert found[:, 2] == pytest.approx(goal[:, 2], abs=0.05)


def test_what_is_at_work_keeps_its_size() -> None:
    goal = weights_of(40)
    found = solve(motion(goal), OPPOSITE, SolveOptions(sparsity=0.05, smoothness=0, ridge=0))
    assert found.values == pytest.approx(goal, abs=1e-7)
    assert found.metadata["solve sparsity"] == "0.05"
    with pytest.raises(FaceDiffError, match="sparsity of 0"):
        SolveOptions(sparsity=0.05, lower=-1.0)


def test_shapes_of_another_face_are_refused_by_what_they_leave() -> None:
    other = replace(OPPOSITE, deltas=RNG.normal(0, 0.005, OPPOSITE.deltas.shape))
    with pytest.raises(FaceDiffError, match=r"leave \d+% of the motion.*residual_limit"):
        solve(motion(weights_of(40)), other)
    assert len(solve(motion(weights_of(40)), other, SolveOptions(residual_limit=1.0)).values) == 40
    # What nobody sees is no reason to refuse.
    tiny = motion(weights_of(40) * 1e-3)
    assert len(solve(tiny, other).values) == 40


@pytest.mark.parametrize("tolerance", [0.0, 0.01, 0.1])
def test_keys_are_few_and_within_the_tolerance(tolerance: float) -> None:
    time = np.linspace(0, 1, 200)
    curves = np.stack([np.clip(np.sin(9 * time), 0, 1), np.abs(time - 0.3)], axis=1)
    keys = key_frames(curves, tolerance)
    assert keys[0] == 0
    assert keys[-1] == 199
    built = np.stack([np.interp(np.arange(200), keys, curve[keys]) for curve in curves.T], axis=1)
    assert np.abs(built - curves).max() <= tolerance + 1e-12
    if tolerance:
        assert len(keys) < 30


@pytest.mark.slow
def test_built_in_shapes_are_of_the_nearest_speaker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    neutral, _, shapes = built_in_shapes("F2")
    found = read_shapes(Path("puppet"), neutral + [0.02, 0, 0])
    for name, delta in zip(found.names, found.deltas, strict=True):
        assert delta == pytest.approx(shapes[name] - neutral, abs=1e-9), name
    centimetres = read_shapes(Path("puppet"), 100 * neutral, "cm")
    assert centimetres.deltas == pytest.approx(100 * found.deltas, abs=1e-7)
    with pytest.raises(FaceDiffError, match="5875 vertices and the animation's template 60"):
        read_shapes(Path("puppet"), NEUTRAL)
    with pytest.raises(FaceDiffError, match="shapes puppets: no such"):
        check_shapes(Path("puppets"))
    # A folder of that name goes first.
    monkeypatch.chdir(tmp_path)
    Path("puppet").mkdir()
    with pytest.raises(FaceDiffError, match="holds 0 shapes"):
        read_shapes(Path("puppet"), neutral)


@pytest.mark.parametrize("started", [False, True])
def test_least_squares_is_scipys_also_where_shapes_resemble_each_other(started: bool) -> None:
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(0)
    for _ in range(40):
        count = int(rng.integers(2, 40))
        shapes = rng.normal(size=(count, 3 * count))
        shapes[-1] = shapes[0] + 0.01 * rng.normal(size=3 * count)
        matrix = shapes @ shapes.T + 0.35 * np.eye(count)
        right = matrix @ rng.normal(0.4, 0.6, count) + rng.normal(size=count)
        lower, upper = np.zeros(count), np.where(rng.random(count) < 0.2, 1e-10, 1.0)
        start = rng.random(count) * upper if started else None
        solved = least_squares(matrix, right, lower, upper, start)
        expected = lsq_linear(matrix, right, (lower, upper), method="bvls", tol=1e-14, max_iter=1000).x
        np.testing.assert_allclose(solved, expected, atol=1e-9)
