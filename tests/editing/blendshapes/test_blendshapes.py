"""The solve against optimality conditions, brute force, closed forms and known weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, solve, vertex_areas
from facediff.editing.shapes import ShapeSet
from facediff.errors import FaceDiffError

NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "mouthFunnel", "mine")
PLAIN = SolveOptions(smoothness=0, ridge=0, sparsity=0, residual_limit=9)


def shapes(seed: int = 0, vertices: int = 40, names: tuple[str, ...] = NAMES) -> ShapeSet:
    rng = np.random.default_rng(seed)
    neutral = rng.normal(0, 0.08, (vertices, 3))
    return ShapeSet(names, neutral, rng.normal(0, 0.005, (len(names), vertices, 3)))


def animation_of(made: ShapeSet, weights: np.ndarray, off: float = 0.0, seed: int = 1, **more: object) -> Animation:
    """A motion made of the shapes, plus noise of a size in metres; in float64, so that only the solver rounds."""
    rng = np.random.default_rng(seed)
    moved = made.neutral + np.einsum("tk,kvc->tvc", weights, made.deltas)
    vertices = moved + rng.normal(0, 1, moved.shape) * off
    return Animation("a", vertices, made.neutral, 30.0, **more)  # type: ignore[arg-type]


def dense(made: ShapeSet, animation: Animation, options: SolveOptions) -> tuple[np.ndarray, np.ndarray]:
    """Hessian (TK, TK) and right side (TK,) of the objective in the docstring, written out with loops."""
    frames, count = len(animation.vertices), len(made.names)
    area = np.ones(len(animation.template)) / len(animation.template)
    flat = made.deltas.reshape(count, -1) * np.sqrt(np.repeat(area, 3))
    goal = (animation.vertices - animation.template).reshape(frames, -1) * np.sqrt(np.repeat(area, 3))
    gram, energy = flat @ flat.T, (flat**2).sum(1)
    hessian, right = np.zeros((frames * count, frames * count)), np.zeros(frames * count)
    for t in range(frames):
        here = slice(t * count, (t + 1) * count)
        hessian[here, here] += gram + options.ridge * np.diag(energy)
        right[here] = flat @ goal[t]
        for k in range(count):
            if t:
                a, b = t * count + k, (t - 1) * count + k
                cost = options.smoothness * (animation.frame_rate / 30) ** 2 * energy[k]
                hessian[[a, b], [a, b]] += cost
                hessian[[a, b], [b, a]] -= cost
        left, other = (t * count + NAMES.index(f"mouthSmile{side}") for side in ("Left", "Right"))
        cost = options.symmetry * (energy[1] + energy[2]) / 2
        hessian[[left, other], [left, other]] += cost
        hessian[[left, other], [other, left]] -= cost
    return hessian, right


def wild(frames: int = 12) -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.6, 1.6, (frames, len(NAMES)))


@pytest.mark.parametrize(
    "options",
    [
        PLAIN,
        SolveOptions(sparsity=0, residual_limit=9),
        SolveOptions(smoothness=0.3, symmetry=0.7, sparsity=0, residual_limit=9),
        SolveOptions(symmetry=5, lower=-0.2, upper=0.7, sparsity=0, residual_limit=9),
    ],
)
@pytest.mark.parametrize("rate", [25.0, 60.0])
def test_the_optimality_conditions_hold(options: SolveOptions, rate: float) -> None:
    made = shapes()
    animation = replace(animation_of(made, wild(), off=0.004), frame_rate=rate)
    found = solve(animation, made, options).values
    hessian, right = dense(made, animation, options)
    slope = ((hessian @ found.ravel()) - right) / np.diag(hessian)
    w = found.ravel()
    assert w.min() >= options.lower
    assert w.max() <= options.upper
    low, high = w <= options.lower + 1e-7, w >= options.upper - 1e-7
    assert (low | high).any()
    assert not (low | high).all()
    assert np.abs(slope[~low & ~high]).max() < 1e-6
    assert (slope[low] > -1e-6).all()
    assert (slope[high] < 1e-6).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([0.0, 1e-6, 0.01, 10.0]), smooth=st.sampled_from([0.0, 0.5]))
def test_any_motion_stays_in_bounds_and_settles(seed: int, size: float, smooth: float) -> None:
    made = shapes()
    animation = animation_of(made, np.zeros((7, 5)), off=size, seed=seed)
    found = solve(animation, made, SolveOptions(smoothness=smooth, sparsity=0, residual_limit=9))
    assert found.values.min() >= 0
    assert found.values.max() <= 1
    assert np.isfinite(found.residual_rms_mm).all()
    assert found.metadata["solve converged"] == "yes"


def test_the_residual_is_what_the_shapes_do_not_span() -> None:
    made = shapes()
    known = np.random.default_rng(2).uniform(0.2, 0.8, (6, 5))
    animation = animation_of(made, known)
    basis = np.linalg.qr(made.deltas.reshape(5, -1).T)[0]
    extra = np.random.default_rng(9).normal(0, 0.002, (6, 120))
    extra = (extra - extra @ basis @ basis.T).reshape(6, 40, 3)
    found = solve(replace(animation, vertices=animation.vertices + extra), made, PLAIN)
    assert np.abs(found.values - known).max() < 1e-7
    away = np.linalg.norm(extra, axis=2) * 1000
    assert found.residual_rms_mm == pytest.approx(np.sqrt((away**2).mean(axis=1)), rel=1e-6)
    assert found.residual_max_mm == pytest.approx(away.max(axis=1), rel=1e-5)
    moved = np.square(animation.vertices + extra - animation.template).sum(-1).mean()
    assert found.residual_share == pytest.approx(found.residual_rms_mm / (1000 * np.sqrt(moved)))


def test_weights_do_not_depend_on_the_unit() -> None:
    made = shapes()
    animation = animation_of(made, wild(), off=0.003)
    mm = ShapeSet(made.names, 1000 * made.neutral, 1000 * made.deltas)
    big = replace(animation, vertices=1000 * animation.vertices, template=1000 * animation.template, unit="mm")
    options = SolveOptions(smoothness=0.2, symmetry=0.1, sparsity=0, residual_limit=9)
    one, two = solve(animation, made, options), solve(big, mm, options)
    assert one.values == pytest.approx(two.values, abs=1e-6)
    assert one.residual_rms_mm == pytest.approx(two.residual_rms_mm, rel=1e-6)


def test_a_region_looks_at_its_vertices_only() -> None:
    made = shapes()
    known = np.random.default_rng(2).uniform(0.1, 0.9, (4, 5))
    animation = animation_of(made, known, regions={"lips": np.arange(20)})
    spoilt = animation.vertices.copy()
    spoilt[:, 20:] += 0.05
    found = solve(replace(animation, vertices=spoilt), made, replace(PLAIN, region="lips"))
    assert found.values == pytest.approx(known, abs=1e-6)
    with pytest.raises(FaceDiffError, match=r'no region "lip": did you mean "lips"'):
        solve(animation, made, replace(PLAIN, region="lip"))


def test_area_counts_and_not_the_number_of_vertices() -> None:
    """Two squares of equal area, one cut finely: with areas both count alike."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    grid = np.array([[2 + x / 9, y / 9, 0] for y in range(10) for x in range(10)])
    quad = [(4 + 10 * y + x, 5 + 10 * y + x, 14 + 10 * y + x) for y in range(9) for x in range(9)]
    quad += [(5 + 10 * y + x, 15 + 10 * y + x, 14 + 10 * y + x) for y in range(9) for x in range(9)]
    faces = np.array([(0, 1, 2), (0, 2, 3), *quad])
    neutral = np.concatenate([corners, grid])
    assert vertex_areas(neutral, faces)[:4].sum() == pytest.approx(1)
    assert vertex_areas(neutral, faces)[4:].sum() == pytest.approx(1)
    delta = np.zeros((1, 104, 3))
    delta[:, :, 2] = 1.0
    goal = neutral[None].copy()
    goal[0, :4, 2] = 0.8
    goal[0, 4:, 2] = 0.2
    animation = Animation("a", goal, neutral, 30.0, faces=faces.astype(np.int32))
    made = ShapeSet(("jawOpen",), neutral, delta)
    assert solve(animation, made, PLAIN).values[0, 0] == pytest.approx(0.5)
    plain = solve(animation, made, replace(PLAIN, area_weighted=False)).values[0, 0]
    assert plain == pytest.approx((4 * 0.8 + 100 * 0.2) / 104)


def test_dependent_and_still_shapes_do_no_harm() -> None:
    made = shapes()
    deltas = np.concatenate([made.deltas, made.deltas[:1], np.zeros((1, 40, 3))])
    more = ShapeSet((*made.names, "twin", "tongueOut"), made.neutral, deltas)
    known = np.random.default_rng(2).uniform(0, 1, (6, 5))
    found = solve(animation_of(made, known), more, SolveOptions(smoothness=0, sparsity=0, residual_limit=9))
    assert found.metadata["solve converged"] == "yes"
    assert found.residual_share.max() < 1e-4
    assert found.still == ("tongueOut",)
    assert not found.values[:, -1].any()
    without = solve(
        animation_of(made, known), more, SolveOptions(smoothness=1e-3, ridge=0, sparsity=0, residual_limit=9)
    )
    assert without.metadata["solve converged"] == "yes"
    # The ridge chooses the smallest weights: the twins share.
    assert found.values[:, 0] == pytest.approx(found.values[:, 5], abs=1e-3)


def test_a_motion_that_stands_still_has_no_share() -> None:
    made = shapes()
    found = solve(animation_of(made, np.zeros((3, 5))), made)
    assert not found.values.any()
    assert not found.residual_share.any()
    assert found.absent[0] == "eyeBlinkLeft"
    assert found.extra == ("mine",)


def test_shapes_of_a_larger_mesh_are_not_cut() -> None:
    """They would fit the first vertices of another mesh, without a word."""
    neutral = np.random.default_rng(0).normal(size=(9, 3))
    animation = Animation("nod", neutral[None] + 0.01, neutral, frame_rate=30.0)
    larger = ShapeSet(("jawOpen",), np.zeros((12, 3)), np.full((1, 12, 3), 0.01))
    with pytest.raises(FaceDiffError, match="has 9 vertices and the shapes 12"):
        solve(animation, larger)
