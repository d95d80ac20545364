"""Weights frame by frame: optimal within the bounds, causal, and near those of the whole motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, solve, vertex_areas
from facediff.editing.bounded import Pivoting, Problem
from facediff.editing.live_weights import FrameSolver
from facediff.editing.shapes import ShapeSet

NO_PRIOR = SolveOptions(smoothness=0.0, sparsity=0.0, ridge=0.0, area_weighted=False)


def some_shapes(count: int = 12, vertices: int = 60, seed: int = 0) -> ShapeSet:
    """Overlapping bumps, so that weights compete for the same vertices."""
    random = np.random.default_rng(seed)
    rest = random.normal(size=(vertices, 3))
    centres = rest[random.integers(0, vertices, count)]
    bumps = np.exp(-np.square(rest - centres[:, None]).sum(-1))
    deltas = bumps[..., None] * random.normal(size=(count, 1, 3)) * 0.01
    return ShapeSet(tuple(f"shape{k}" for k in range(count)), rest, deltas)


def some_motion(shapes: ShapeSet, frames: int = 40, noise: float = 1e-3, seed: int = 1) -> np.ndarray:
    """Offsets (T, V, 3) of weights that run into both bounds, and what no weights explain."""
    random = np.random.default_rng(seed)
    weights = 0.4 + np.cumsum(random.normal(size=(frames, len(shapes.names))) * 0.15, axis=0)
    clean = np.einsum("tk,kvc->tvc", weights, shapes.deltas)
    return clean + noise * random.normal(size=clean.shape)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 30), rows=st.integers(1, 40))
def test_pivoting_meets_the_optimality_conditions(seed: int, count: int, rows: int) -> None:
    random = np.random.default_rng(seed)
    basis = random.normal(size=(rows, count))  # with fewer rows than columns, many solutions are equally good
    basis /= np.linalg.norm(basis, axis=0)
    matrix = basis.T @ basis
    solver = Pivoting(matrix)
    for scale in (0.3, 1.0, 1.05, 5.0):
        lower = random.uniform(-1, 0.5, count)
        upper = lower + random.choice([0.0, 0.2, 1.0], count)
        right = basis.T @ (scale * random.normal(size=rows))
        found = solver.solve(right, lower, upper)
        assert (found >= lower).all()
        assert (found <= upper).all()
        assert Problem(matrix, right[None], 0.0, lower, upper).residual(found[None]).max() < 1e-6


@pytest.mark.parametrize("options", [NO_PRIOR, replace(NO_PRIOR, upper=0.4), replace(NO_PRIOR, lower=-0.5)])
def test_weights_are_those_of_an_independent_solver(options: SolveOptions) -> None:
    shapes = some_shapes()
    basis = shapes.deltas.reshape(len(shapes.names), -1).T
    solver = FrameSolver(shapes, 30.0, options=options)
    scale = np.linalg.norm(basis)
    for offsets in some_motion(shapes):
        bounds = options.lower, options.upper
        goal = lsq_linear(basis / scale, offsets.ravel() / scale, bounds, method="bvls", tol=1e-14).x
        np.testing.assert_allclose(solver.solve(offsets), goal, atol=1e-6)


def test_a_frame_is_held_near_the_last_one_by_the_stated_strength() -> None:
    """With areas, ridge, symmetry and a frame rate, against the same least squares written out as rows."""
    shapes = some_shapes(4)
    shapes = replace(shapes, names=("mouthLeft", "mouthRight", "jawOpen", "cheekPuff"))
    faces = np.random.default_rng(2).permuted(np.tile(np.arange(60), (30, 1)), axis=1)[:, :3]
    options = SolveOptions(smoothness=0.3, sparsity=0.0, ridge=0.05, symmetry=0.4)
    solver = FrameSolver(shapes, 60.0, faces=faces, options=options)
    area = vertex_areas(shapes.neutral.astype(np.float32), faces)
    root = np.sqrt(np.repeat(area / area.sum(), 3))
    basis = (shapes.deltas.reshape(4, -1) * root).T
    energy = np.square(basis).sum(0)
    coupling = 0.3 * (60 / 30) ** 2
    pair = np.zeros((1, 4))
    pair[0, :2] = np.sqrt(0.4 * 0.5 * (energy[0] + energy[1])) * np.array([1.0, -1.0])
    rows = np.vstack([basis, np.diag(np.sqrt(0.05 * energy)), pair, np.diag(np.sqrt(coupling * energy))])
    last = np.zeros(4)
    for offsets in some_motion(shapes, frames=8):
        goal = np.concatenate([offsets.ravel() * root, np.zeros(5), np.sqrt(coupling * energy) * last])
        last = lsq_linear(rows / 1e-3, goal / 1e-3, (0, 1), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(solver.solve(offsets), last, atol=1e-6)


def test_weights_do_not_depend_on_the_future_and_a_reset_forgets_the_past() -> None:
    shapes = some_shapes()
    motion = some_motion(shapes)
    solver = FrameSolver(shapes, 30.0)
    whole = [solver.solve(offsets) for offsets in motion]
    solver.reset()
    again = [solver.solve(offsets) for offsets in motion[:15]]
    np.testing.assert_allclose(again, whole[:15], atol=1e-9)


def test_weights_are_near_those_of_the_whole_motion() -> None:
    shapes = some_shapes()
    time = np.arange(90) / 30
    smooth = 0.5 + 0.5 * np.sin(2 * np.pi * np.outer(time, np.linspace(0.4, 1.5, 12)) + np.arange(12))
    offsets = np.einsum("tk,kvc->tvc", smooth, shapes.deltas)
    solver = FrameSolver(shapes, 30.0)
    live = np.array([solver.solve(frame) for frame in offsets])
    rest = shapes.neutral.astype(np.float32)
    offline = solve(Animation("a", rest + offsets.astype(np.float32), rest, 30.0), shapes).values
    assert np.abs(live - offline).mean() < 0.01
    assert np.abs(live - smooth).mean() < 0.02


def test_a_shape_that_gains_too_little_stays_at_zero_and_fades_as_offline() -> None:
    shapes = some_shapes()
    solver = FrameSolver(shapes, 30.0, options=SolveOptions(sparsity=0.2))
    weights = [solver.solve(0.05 * shapes.deltas[0])]  # less than it costs
    weights += [solver.solve(0.8 * shapes.deltas[0])]
    weights += [solver.solve(0.05 * shapes.deltas[0]) for _ in range(4)]
    first = np.array(weights)[:, 0]
    assert first[0] == 0
    assert first[1] > 0.7
    assert (first[2:4] > 0.01).all()  # 1/15 s are two frames
    assert (first[4:] == 0).all()


def test_shapes_without_effect_keep_weight_zero() -> None:
    shapes = some_shapes(3)
    shapes = replace(shapes, deltas=np.concatenate([shapes.deltas[:2], np.zeros_like(shapes.deltas[:1])]))
    solver = FrameSolver(shapes, 30.0, options=NO_PRIOR)
    weights = solver.solve(shapes.deltas[0] + 0.0)
    assert weights[2] == 0
