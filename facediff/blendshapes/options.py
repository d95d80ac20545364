"""How weights are solved for."""

from __future__ import annotations

import math
from dataclasses import dataclass

from facediff.errors import FaceDiffError


@dataclass(frozen=True)
class SolveOptions:
    """Choices of a solve; all strengths are shares of a shape's own energy, so that they mean the same for every shape.

    Attributes:
        smoothness: how much a weight's change from frame to frame costs; at 0.02, a movement to and fro five times a
            second keeps 98 % of its size. Stated for 30 frames a second and converted to the take's frame rate.
        symmetry: how much a difference between the weights of a left shape and its right one costs.
        ridge: how much weights cost by themselves, which chooses the smallest among equally good ones.
        lower: least weight.
        upper: greatest weight.
        region: name of the take's region that is looked at; None for the whole face.
        area_weighted: count vertices by the area around them, so that finely meshed places do not count for more;
            without triangles, all count alike.
        tolerance: what may be left of the optimality conditions, in weights.
        max_iterations: of Newton's method.
    """

    smoothness: float = 0.02
    symmetry: float = 0.0
    ridge: float = 1e-6
    lower: float = 0.0
    upper: float = 1.0
    region: str | None = None
    area_weighted: bool = True
    tolerance: float = 1e-8
    max_iterations: int = 200

    def __post_init__(self) -> None:
        for name in ("smoothness", "symmetry", "ridge"):
            if not 0 <= getattr(self, name) < math.inf:
                raise FaceDiffError(f"{name} {getattr(self, name):g}: expected a strength of 0 (off) or more")
        if not -math.inf < self.lower < self.upper < math.inf:
            raise FaceDiffError(f"bounds {self.lower:g} to {self.upper:g}: expected the lower one first, as in 0 1")
        if not (self.tolerance > 0 and self.max_iterations > 0):
            raise FaceDiffError(
                f"tolerance {self.tolerance:g} and {self.max_iterations} iterations: expected both above 0"
            )
