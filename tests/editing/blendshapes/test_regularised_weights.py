"""NVIDIA's weight solve, against SciPy's solver of the same system."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from facediff.editing.regularised_weights import Regularisation, RegularisedSolver, TemporalTerm, pairs_of

RNG = np.random.default_rng(0)
NEUTRAL = RNG.normal(size=(30, 3)) * 10
DELTAS = RNG.normal(size=(8, 30, 3))
MASK = np.arange(0, 30, 3)
ACTIVE = [True] * 7 + [False]
MOTION = NEUTRAL + np.tensordot(RNG.normal(size=(12, 8)) * 0.7, DELTAS, 1) + RNG.normal(size=(12, 30, 3)) * 0.3
STRENGTHS: dict[str, Any] = {"l1": 0.3, "l2": 0.05, "temporal": 0.02, "symmetry": 0.2, "template_size": 40.0}


def reference(term: str, **strengths: float) -> np.ndarray:
    """The published formulas in matrices of the shapes in use."""
    o = STRENGTHS | strengths
    d = DELTAS[:7, MASK].reshape(7, -1).T
    s = (np.linalg.norm(NEUTRAL.max(0) - NEUTRAL.min(0)) / o["template_size"]) ** 2
    pair = np.array([[1.0, -1, 0, 0, 0, 0, 0]])
    a = d.T @ d + s * (
        0.25 * o["l1"] ** 2 * np.ones((7, 7))
        + 10 * o["l2"] * np.eye(7)
        + 100 * o["temporal"] * np.eye(7)
        + 10 * o["symmetry"] * pair.T @ pair
    )
    last, rows = np.zeros(7), []
    for pose in MOTION:
        b = d.T @ (pose - NEUTRAL)[MASK].ravel() + s * o["temporal"] * last * (100 if term == "corrected" else 1)
        upper = np.ones(7)

        def bounded(b: np.ndarray = b, upper: np.ndarray = upper) -> np.ndarray:
            return lsq_linear(a, b, (np.zeros(7), upper), method="bvls", tol=1e-14, max_iter=200).x

        w = bounded()
        upper[3 if w[2] >= w[3] else 2] = 1e-10
        last = bounded()
        rows.append([*last, 0.0])
    return np.array(rows) * MULTIPLIERS + OFFSETS


MULTIPLIERS = np.array([1, 0.5, 1, 1, 2, 1, 1, 1])
OFFSETS = np.array([0, 0.1, 0, 0, 0, 0, 0, 0.2])


@pytest.mark.parametrize("term", ["published", "corrected"])
def test_solve_is_the_published_system(term: TemporalTerm) -> None:
    solver = RegularisedSolver(
        NEUTRAL,
        DELTAS,
        mask=MASK,
        regularisation=Regularisation(**STRENGTHS, temporal_term=term),
        active=ACTIVE,
        symmetric=[(0, 1), (6, 7)],  # a pair whose other shape is not used has no effect
        cancel=pairs_of([-1, -1, 4, 4, -1, -1, -1, -1]),
        multipliers=MULTIPLIERS.tolist(),
        offsets=OFFSETS.tolist(),
    )
    weights = solver.solve(MOTION)
    np.testing.assert_allclose(weights, reference(term), atol=1e-9)
    assert ((weights[:, 2] <= 1e-10) | (weights[:, 3] <= 1e-10)).all()
    assert np.isclose(weights[:, :1], 0).any() or np.isclose(weights[:, :1], 1).any()
