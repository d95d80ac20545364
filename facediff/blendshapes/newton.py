"""Box-bounded quadratic programs over a whole take: projected Newton with block-tridiagonal steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

SUFFICIENT = 1e-4
"""Share of the promised decrease that a step must bring (Armijo)."""
SHORTEST = 1e-12
NEAR = 1e-3
"""How near a bound counts as on it, at most; less near the solution."""
JITTER = 1e-10
"""Added to the diagonal, which is one, of the matrix of a step only: dependent shapes leave it singular."""


@dataclass(frozen=True)
class Problem:
    """½ Σ_t x_tᵀ M x_t − Σ_t r_tᵀ x_t + ½ c Σ_t ‖x_t − x_{t−1}‖², lower ≤ x_t ≤ upper; float64 throughout.

    Attributes:
        matrix: M (K, K), symmetric, positive semi-definite, with a diagonal of about one.
        right: r (T, K).
        coupling: c, not negative.
        lower: (K,).
        upper: (K,).
    """

    matrix: Tensor
    right: Tensor
    coupling: float
    lower: Tensor
    upper: Tensor

    def clip(self, x: Tensor) -> Tensor:
        """The nearest point of the box."""
        return torch.minimum(torch.maximum(x, self.lower), self.upper)

    def gradient(self, x: Tensor) -> Tensor:
        """Of the objective, (T, K)."""
        slope = x @ self.matrix - self.right
        step = self.coupling * (x[1:] - x[:-1])
        slope[1:] += step
        slope[:-1] -= step
        return slope

    def change(self, slope: Tensor, moved: Tensor) -> float:
        """How the objective changes when x with this gradient moves; free of the cancellation of a difference."""
        curve = (moved @ self.matrix * moved).sum() + self.coupling * (moved[1:] - moved[:-1]).square().sum()
        return float((slope * moved).sum() + 0.5 * curve)

    def residual(self, x: Tensor) -> Tensor:
        """|x − clip(x − gradient)|, (T, K): zero exactly where the optimality (KKT) conditions hold."""
        return (x - self.clip(x - self.gradient(x))).abs()


def minimise(problem: Problem, tolerance: Tensor, max_iterations: int) -> tuple[Tensor, bool]:
    """The box's point of least value.

    Bertsekas, "Projected Newton methods for optimization problems with simple constraints", SIAM J. Control 1982:
    variables on a bound whose gradient pushes outwards follow the gradient, the others take Newton's step; both are
    clipped to the box, and the step is shortened until the objective falls enough, which makes it converge from
    anywhere. The free variables of all frames are solved for at once.

    Args:
        problem: the program.
        tolerance: (K,) what may be left of :meth:`Problem.residual`.
        max_iterations: steps at most.

    Returns:
        x (T, K), and whether it met the tolerance.
    """
    free = torch.ones_like(problem.right, dtype=torch.bool)
    x = problem.clip(_newton(problem, problem.right, free))
    width = float((problem.upper - problem.lower).min())
    for _ in range(max_iterations):
        left = problem.residual(x)
        if bool((left <= tolerance).all()):
            return x, True
        slope = problem.gradient(x)
        near = min(NEAR * width, float(left.max()))
        held = ((x <= problem.lower + near) & (slope > 0)) | ((x >= problem.upper - near) & (slope < 0))
        direction = torch.where(held, -slope, _newton(problem, torch.where(held, 0.0, -slope), ~held))
        following = _step(problem, x, slope, direction, held)
        if following is None:
            break
        x = following
    return x, bool((problem.residual(x) <= tolerance).all())


def _step(problem: Problem, x: Tensor, slope: Tensor, direction: Tensor, held: Tensor) -> Tensor | None:
    """The longest sufficient step along the clipped direction; None where rounding lets the objective fall no more."""
    length = 1.0
    promise = -float((slope * torch.where(held, 0.0, direction)).sum())
    while length > SHORTEST:
        following = problem.clip(x + length * direction)
        moved = following - x
        wanted = length * promise - float((slope * torch.where(held, moved, 0.0)).sum())
        if problem.change(slope, moved) <= -SUFFICIENT * wanted:
            return following if bool(moved.any()) else None
        length /= 2
    return None


def _newton(problem: Problem, right: Tensor, free: Tensor) -> Tensor:
    """Solve for the free variables, the others being zero: (T, K).

    The matrix is block-tridiagonal, M + c·(number of neighbours) on the diagonal and −c beside it; block elimination
    goes once forth and once back over the frames.
    """
    frames, count = right.shape
    eye = torch.eye(count, dtype=right.dtype)
    both = free[:, :, None] & free[:, None, :]
    neighbours = torch.full((frames,), 2.0, dtype=right.dtype)
    neighbours[0] -= 1
    neighbours[-1] -= 1
    extra = problem.coupling * neighbours[:, None] + JITTER
    # Variables that are held get a row of the identity.
    blocks = torch.where(both, problem.matrix, 0.0) + torch.diag_embed(torch.where(free, extra, 1.0))
    if not problem.coupling:
        return torch.linalg.solve(blocks, right[..., None])[..., 0] * free
    beside = problem.coupling * (free[1:] & free[:-1]).to(right.dtype)
    solved = torch.empty_like(right)
    factors: list[Tensor] = []
    for t in range(frames):
        block, goal = blocks[t], right[t]
        if t:
            inverse = torch.cholesky_solve(eye, factors[-1])
            block = block - beside[t - 1][:, None] * inverse * beside[t - 1]
            goal = goal + beside[t - 1] * (inverse @ solved[t - 1])
        factors.append(torch.linalg.cholesky(block))
        solved[t] = goal
    for t in reversed(range(frames)):
        goal = solved[t] if t == frames - 1 else solved[t] + beside[t] * solved[t + 1]
        solved[t] = torch.cholesky_solve(goal[:, None], factors[t])[:, 0]
    return solved * free
