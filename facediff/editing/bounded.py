"""Least squares within bounds: quadratic programs with a least and a greatest value of each variable.

Three solvers: :func:`minimise` for all frames of a motion in one problem; :class:`Pivoting` for one frame after the
other, each of which is nearly the last one; and :func:`least_squares` of a system itself, without squaring its
condition.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from facediff.utils.numerics import Array, has_scipy, solve_block_chain

Mask = npt.NDArray[np.bool_]

ACTIVE = 1e-3  # Share of the cost of a weight above which a shape is at work
MOST_STEPS = 200  # of any of the solvers

# A box-bounded quadratic program over all frames, solved by projected Newton steps. scipy's bounded solvers either know
# no banded matrices or stop far from the 1e-8 that is promised for weights; its banded Cholesky solver takes the steps.

SUFFICIENT = 1e-4  # Share of the promised decrease that a step must bring (Armijo)
SHORTEST = 1e-12
NEAR = 1e-3  # How near a bound counts as on it, at most; less near the solution
JITTER = 1e-10  # Added to the diagonal, which is one, of the matrix of a step only: dependent shapes leave it singular


@dataclass(frozen=True)
class Problem:
    """½ Σ_t x_tᵀ M x_t − Σ_t r_tᵀ x_t + ½ c Σ_t ‖x_t − x_{t−1}‖², lower ≤ x_t ≤ upper; float64 throughout."""

    matrix: Array  # M (K, K), symmetric, positive semi-definite, with a diagonal of about one
    right: Array  # r (T, K)
    coupling: float  # c, not negative
    lower: Array  # (K,) or (T, K)
    upper: Array  # (K,) or (T, K)

    def clip(self, x: Array) -> Array:
        """The nearest point of the box."""
        return np.clip(x, self.lower, self.upper)

    def gradient(self, x: Array) -> Array:
        """Of the objective, (T, K)."""
        slope = x @ self.matrix - self.right
        step = self.coupling * np.diff(x, axis=0)
        slope[1:] += step
        slope[:-1] -= step
        return slope

    def change(self, slope: Array, moved: Array) -> float:
        """How the objective changes when x with this gradient moves; free of the cancellation of a difference."""
        curve = (moved @ self.matrix * moved).sum() + self.coupling * np.square(np.diff(moved, axis=0)).sum()
        return float((slope * moved).sum() + 0.5 * curve)

    def residual(self, x: Array) -> Array:
        """|x − clip(x − gradient)|, (T, K): zero exactly where the optimality (KKT) conditions hold."""
        return np.abs(x - self.clip(x - self.gradient(x)))


def minimise_sparse(problem: Problem, cost: Array, tolerance: Array, *, frames_around: int) -> tuple[Array, bool]:
    """The box's point of least value with few shapes at work in each frame; bounds are not negative.

    The sum Σ_t Σ_k cost_k x_tk is added to the objective, which keeps shapes at 0 that gain less than they cost. It
    also takes something from all others. The second problem, without the sum and with those shapes held at 0, gives it
    back (Meinshausen, "Relaxed Lasso", Computational Statistics & Data Analysis 2007).

    Returns:
        x (T, K), and whether the residual of the second problem meets the tolerance (K,).
    """
    sparse = minimise(replace(problem, right=problem.right - cost), tolerance)[0]
    # A shape that is at work in a frame is free in those around it, or its curve would begin and end with a jump.
    window = np.lib.stride_tricks.sliding_window_view
    reach = np.pad(sparse > ACTIVE * cost, ((frames_around, frames_around), (0, 0)))
    active = window(reach, 2 * frames_around + 1, axis=0).any(axis=-1)
    lower = np.where(active, problem.lower, np.clip(0.0, problem.lower, problem.upper))
    upper = np.where(active, problem.upper, np.clip(0.0, problem.lower, problem.upper))
    return minimise(replace(problem, lower=lower, upper=upper), tolerance)


def minimise(problem: Problem, tolerance: Array) -> tuple[Array, bool]:
    """The box's point of least value.

    Bertsekas, "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control 1982:
    variables on a bound with a gradient outwards follow the gradient, the others take Newton's step; both are
    clipped to the box, and the step is shortened until the objective falls enough, which makes it converge from
    anywhere. The free variables of all frames are solved for together.

    Returns:
        x (T, K), and whether its :meth:`Problem.residual` meets the tolerance (K,).
    """
    # The unbounded minimum, clipped to the box, is near the solution: few weights lie on a bound in the end.
    x = problem.clip(_newton(problem, problem.right, np.ones(problem.right.shape, bool)))
    widths = problem.upper - problem.lower
    width = float(widths[widths > 0].min(initial=1.0))
    for _ in range(MOST_STEPS):
        left = problem.residual(x)
        if (left <= tolerance).all():
            return x, True
        slope = problem.gradient(x)
        # A set of bound variables that changed with every step would keep the steps short: near a bound counts as on
        # it.
        # The distance that counts as near shrinks with the residual, so that the solution is not affected.
        near = min(NEAR * width, float(left.max()))
        bound = ((x <= problem.lower + near) & (slope > 0)) | ((x >= problem.upper - near) & (slope < 0))
        direction = np.where(bound, -slope, _newton(problem, -slope, ~bound))
        following = _step(problem, x, slope, direction, bound)
        if following is None:
            break
        x = following
    return x, bool((problem.residual(x) <= tolerance).all())


def _step(problem: Problem, x: Array, slope: Array, direction: Array, bound: Mask) -> Array | None:
    """The longest sufficient step along the clipped direction; None where rounding lets the objective fall no more."""
    length = 1.0
    promise = -float((slope * direction)[~bound].sum())
    while length > SHORTEST:
        following = problem.clip(x + length * direction)
        moved = following - x
        # Armijo's rule for projected steps: free variables promise a decrease by their slope along the direction,
        # bound ones by how far they really move, since the box may cut their way short.
        promised_decrease = length * promise - float((slope * moved)[bound].sum())
        if problem.change(slope, moved) <= -SUFFICIENT * promised_decrease:
            return following if moved.any() else None
        length /= 2
    return None


def _newton(problem: Problem, right: Array, inner: Mask) -> Array:
    """Solve for the inner variables (those not on a bound), the others being zero: (T, K)."""
    frames, count = right.shape
    neighbours = np.full((frames, 1), 2.0)
    neighbours[0] -= 1
    neighbours[-1] -= 1
    # A base install lacks SciPy: the same system is solved as a chain of blocks, frame by frame.
    if not has_scipy():
        blocks = np.where(inner[:, :, None] & inner[:, None], problem.matrix, 0.0)
        diagonal = np.where(inner, np.diagonal(problem.matrix) + problem.coupling * neighbours + JITTER, 1.0)
        blocks[:, np.arange(count), np.arange(count)] = diagonal
        links = np.where(inner[1:] & inner[:-1], -problem.coupling, 0.0)
        return np.where(inner, solve_block_chain(blocks, links, np.where(inner, right, 0.0)), 0.0)
    from scipy.linalg import solveh_banded

    # M + c · (number of neighbours) on the block diagonal and −c next to it make a band of K below the diagonal, stored
    # as LAPACK expects it: the last axis counts how far below. The lower form is some twenty times faster than the
    # upper one: OpenBLAS spreads its small products over threads. A variable on a bound gets a row of the identity.
    rows = max(count, 2) + 1  # scipy fails on a single variable with a narrower band
    band = np.zeros((frames, count, rows))
    band[:, :, 0] = np.where(inner, np.diagonal(problem.matrix) + problem.coupling * neighbours + JITTER, 1.0)
    for d in range(1, count):
        band[:, :-d, d] = np.where(inner[:, d:] & inner[:, :-d], np.diagonal(problem.matrix, d), 0.0)
    band[:-1, :, count] = np.where(inner[1:] & inner[:-1], -problem.coupling, 0.0)
    goal = np.where(inner, right, 0.0).ravel()
    solved = solveh_banded(band.reshape(-1, rows).T, goal, overwrite_ab=True, lower=True, check_finite=False)
    return np.where(inner, solved.reshape(frames, count), 0.0)


# One frame at a time. The variables on a bound change little from frame to frame. The others solve a linear system; its
# inverse is kept for the next frame with the same inner variables.

MISSED = 1e-10  # How far a variable may lie beyond its bound, or a slope on the wrong side of zero: rounding
PATIENCE = 3  # Exchanges of all wrong variables that may fail to make them fewer
MOST_INVERSES = 64
ROUNDING = 1e-14  # Share of its terms' sum below which a slope of a system is zero


class Pivoting:
    """Minimises ½ xᵀ M x − rᵀ x within lower ≤ x ≤ upper for many r (K,), quickly where they differ little.

    Júdice & Pires, "A block principal pivoting algorithm for large-scale strictly monotone linear complementarity
    problems", Computers & Operations Research 1994, for variables with two bounds: each lies between them or on one;
    those that break a condition change sides all together, and one at a time where that does not make them
    fewer. It begins with the sides of the last solution. Should it not end, :func:`minimise` solves the frame.

    Args:
        matrix: M (K, K), symmetric, positive semi-definite, with a diagonal of about one.

    Example:
        >>> solver = Pivoting(np.array([[1.0, 0.5], [0.5, 1.0]]))
        >>> solver.solve(np.array([1.0, -1.0]), np.zeros(2), np.ones(2)).tolist()
        [1.0, 0.0]
    """

    def __init__(self, matrix: Array) -> None:
        self.matrix = matrix
        # Positive definite, so that the solution is one, also where shapes depend on one another.
        self._solvable = matrix + JITTER * np.eye(len(matrix))
        self._inverses: OrderedDict[bytes, Array] = OrderedDict()
        self._side = np.zeros(len(matrix), np.int8)  # -1 on the lower bound, 1 on the upper one, 0 between them

    def solve(self, right: Array, lower: Array, upper: Array) -> Array:
        """The point (K,) of least value for r (K,) and bounds (K,); a variable with equal bounds stays there."""
        side = np.where(upper <= lower, -1, self._side).astype(np.int8)
        fewest, patience = len(side) + 1, PATIENCE
        for _ in range(MOST_STEPS):
            x = self._at(side, right, lower, upper)
            slope = self.matrix @ x - right
            below, above = (side == 0) & (x < lower - MISSED), (side == 0) & (x > upper + MISSED)
            freed = ((side < 0) & (slope < -MISSED)) | ((side > 0) & (slope > MISSED))
            wrong = np.flatnonzero(below | above | (freed & (upper > lower)))
            if not len(wrong):
                self._side = side
                return np.clip(x, lower, upper)
            # Exchanging all wrong variables is quick and may run in circles. When it has not made them fewer for some
            # rounds, only the last one changes sides: Murty's rule, which always ends.
            if len(wrong) < fewest:
                fewest, patience = len(wrong), PATIENCE
            elif patience:
                patience -= 1
            else:
                wrong = wrong[-1:]
            changed = np.where(below, -1, np.where(above, 1, 0)).astype(np.int8)
            side[wrong] = changed[wrong]
        problem = Problem(self.matrix, right[None], 0.0, lower, upper)
        solution: Array = minimise(problem, np.full(len(right), MISSED))[0][0]
        self._side = np.where(solution <= lower, -1, np.where(solution >= upper, 1, 0)).astype(np.int8)
        return solution

    def _at(self, side: npt.NDArray[np.int8], right: Array, lower: Array, upper: Array) -> Array:
        """The variables on a bound there, and the others where their slope is zero."""
        x = np.where(side < 0, lower, upper)
        inner = side == 0
        if not inner.any():
            return x
        # The bound variables' terms move to the right-hand side; a system of the inner ones is left.
        x[inner] = 0.0
        goal = (right - self.matrix @ x)[inner]
        key = inner.tobytes()
        inverse = self._inverses.get(key)
        block = self._solvable[np.ix_(inner, inner)]
        if inverse is None:
            # The same few sets of inner variables return frame after frame, so that an inverse pays.
            inverse = self._inverses[key] = np.asarray(np.linalg.inv(block), np.float64)
            if len(self._inverses) > MOST_INVERSES:
                self._inverses.popitem(last=False)
        else:
            self._inverses.move_to_end(key)
        solution = inverse @ goal
        x[inner] = solution + inverse @ (goal - block @ solution)  # once more against rounding
        return x


# Of a system A x = b as it is. The quadratic program of its normal equations has the square of A's condition, which
# leaves no correct digits where A is the Gram matrix of shapes that resemble each other.


def least_squares(matrix: Array, right: Array, lower: Array, upper: Array, start: Array | None = None) -> Array:
    """The point of a box at which |A x − b|² is least, where A has full rank.

    Stark & Parker, "Bounded-variable least-squares: an algorithm and applications", Computational Statistics 1995:
    the variables between their bounds are solved for and go only as far as the box allows; of the variables on a bound,
    the one with the steepest slope into the box is released, until there is none.

    Args:
        matrix: A (M, K).
        right: b (M,).
        lower: least values (K,).
        upper: greatest values (K,).
        start: a point near the solution.

    Example:
        >>> least_squares(np.eye(2), np.array([0.5, -1.0]), np.zeros(2), np.ones(2)).tolist()
        [0.5, 0.0]
    """
    count = matrix.shape[1]
    x = np.clip(np.linalg.lstsq(matrix, right)[0] if start is None else start, lower, upper)
    side = np.where(x <= lower, -1, np.where(x >= upper, 1, 0))
    x = np.where(side < 0, lower, np.where(side > 0, upper, x))
    scale = np.abs(matrix).T @ np.abs(right) + np.abs(matrix.T @ matrix) @ np.maximum(np.abs(lower), np.abs(upper))
    refused: set[int] = set()  # released, and pushed back by rounding: stays until something else moves
    for _ in range(20 * count):
        while (inner := side == 0).any():
            goal = right - matrix[:, ~inner] @ x[~inner]
            target = x.copy()
            target[inner] = np.linalg.lstsq(matrix[:, inner], goal)[0]
            beyond = inner & ((target < lower) | (target > upper))
            if not beyond.any():
                x = target
                break
            # Only as far as the first bound that is met.
            bound = np.where(target < lower, lower, upper)
            shares = np.full(count, np.inf)
            shares[beyond] = (bound - x)[beyond] / (target - x)[beyond]
            first = int(shares.argmin())
            x = np.where(inner, x + min(1.0, max(0.0, float(shares[first]))) * (target - x), x)
            x[first], side[first] = bound[first], -1 if bound[first] == lower[first] else 1
            x = np.clip(x, lower, upper)
        slope = matrix.T @ (right - matrix @ x)
        inwards = np.where(side < 0, slope, np.where(side > 0, -slope, 0.0)) / np.maximum(scale, 1e-300)
        inwards[upper <= lower] = 0.0
        inwards[list(refused)] = 0.0
        released = int(inwards.argmax())
        if inwards[released] <= ROUNDING:
            break
        before = side[released]
        side[released] = 0
        inner = side == 0
        goal = right - matrix[:, ~inner] @ x[~inner]
        moved = np.linalg.lstsq(matrix[:, inner], goal)[0][int(inner[:released].sum())] - x[released]
        if moved * before >= 0:  # it would leave the box at once: its slope is nothing but rounding
            side[released] = before
            refused.add(released)
        else:
            refused.clear()
    return x
