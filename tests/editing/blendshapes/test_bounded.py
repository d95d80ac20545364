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
from facediff.spaces.arkit import ARKIT
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


def motion(weights: np.ndarray) -> Animation:
    return Animation("a", NEUTRAL + np.einsum("tk,kvc->tvc", weights, OPPOSITE.deltas), NEUTRAL, 30.0)


def weights_of(frames: int) -> np.ndarray:
    """A blink in the middle and a jaw that never rests."""
    time = np.linspace(0, 1, frames)
    blink = np.clip(1 - np.abs(time - 0.5) / 0.1, 0, 1)
    return np.stack([blink, np.zeros(frames), 0.5 + 0.4 * np.sin(12 * time)], axis=1)


def test_sparsity_finds_the_weights_of_a_motion() -> None:
    """ARKit's shapes, of which a third is at work at a time; ``pytest -s`` prints the table of docs/blendshapes.md."""
    neutral, _, moved = built_in_shapes("F1")
    shapes, random = ShapeSet(ARKIT, neutral, np.stack([moved[name] - neutral for name in ARKIT])), RNG.spawn(1)[0]
    waves = np.linspace(0, 4, 120)[:, None] * random.uniform(0.3, 2.0, 52) + random.uniform(size=52)
    goal = np.clip(1.5 * np.sin(2 * np.pi * waves) - 0.7, 0.0, 1.0)
    offsets = np.einsum("tk,kvc->tvc", goal, shapes.deltas)
    animation = Animation("a", neutral + offsets + random.normal(0, 1e-4, offsets.shape), neutral, 30.0)
    errors, idle = [], []
    for sparsity in (0.0, 0.001, 0.003, 0.01, 0.02, 0.05):
        found = solve(animation, shapes, SolveOptions(sparsity=sparsity))
        errors.append(float(np.sqrt(np.square(found.values - goal).mean())))
        idle.append(float((found.values[goal == 0] > 0.001).mean()))
        print(f"| {sparsity} | {errors[-1]:.3f} | {found.residual_rms_mm.mean():.3f} mm | {idle[-1]:.0%} |")
    assert errors[2] < 0.6 * errors[0], "the default"
    assert idle == sorted(idle, reverse=True)


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
    assert len(solve(motion(weights_of(40) * 1e-3), other).values) == 40, "invisible"


@pytest.mark.parametrize("tolerance", [0.0, 0.01, 0.1])
def test_keys_are_few_and_within_the_tolerance(tolerance: float) -> None:
    time = np.linspace(0, 1, 200)
    curves = np.stack([np.clip(np.sin(9 * time), 0, 1), np.abs(time - 0.3)], axis=1)
    keys = key_frames(curves, tolerance)
    assert (keys[0], keys[-1]) == (0, 199)
    built = np.stack([np.interp(np.arange(200), keys, curve[keys]) for curve in curves.T], axis=1)
    assert np.abs(built - curves).max() <= tolerance + 1e-12
    assert not tolerance or len(keys) < 30


@pytest.mark.slow
def test_built_in_shapes_are_of_the_nearest_speaker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    neutral, _, shapes = built_in_shapes("F2")
    found = read_shapes(Path("puppet"), neutral + [0.02, 0, 0])
    for name, delta in zip(found.names, found.deltas, strict=True):
        assert delta == pytest.approx(shapes[name] - neutral, abs=1e-9), name
    assert read_shapes(Path("puppet"), 100 * neutral, "cm").deltas == pytest.approx(100 * found.deltas, abs=1e-7)
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
