"""Weights of blendshapes frame by frame, while the face still moves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.blendshapes import AROUND, SolveOptions, objective
from facediff.editing.bounded import ACTIVE, Pivoting
from facediff.editing.shapes import ShapeSet
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.numerics import Array, Floats, Indices


class FrameSolver:
    """Solves for the weights of one frame after the other, in well under 2 ms for 52 shapes of 5 023 vertices.

    Objective, bounds and options are as in :func:`~facediff.editing.blendshapes.solve`. That knows the
    whole motion; here, the future is not known yet:

    - A frame is held near the last one only, which has final weights; the face at rest goes before the first one.
    - A shape that gains less than it costs is at 0 until the frame in which it begins to work. It fades for as long as
      there; it does not begin before.

    Args:
        shapes: K shapes of the face's topology.
        frame_rate: frames a second.
        faces: triangles (F, 3) for weights by area; None to count all vertices alike.
        regions: vertices by name, for ``options.region``.
        options: the usual ones if None; `residual_limit` has no meaning here.

    Example:
        >>> rest = np.random.default_rng(0).normal(size=(9, 3))
        >>> solver = FrameSolver(ShapeSet(("jawOpen",), rest, np.full((1, 9, 3), 0.01)), frame_rate=30.0)
        >>> [solver.solve(np.full((9, 3), offset)).round(3).tolist() for offset in (0.0, 0.005, 0.02)]
        [[0.0], [0.49], [1.0]]
    """

    def __init__(
        self,
        shapes: ShapeSet,
        frame_rate: ranges.FrameRate,
        *,
        faces: npt.NDArray[np.int32] | None = None,
        regions: Mapping[str, Indices] | None = None,
        options: SolveOptions | None = None,
    ) -> None:
        self.shapes = shapes
        self.options = options = options or SolveOptions()
        rest = shapes.neutral.astype(np.float32)
        face = Animation("shapes", rest[None], rest, frame_rate, faces=faces, regions=dict(regions or {}))
        terms = objective(face, shapes, options)
        self._scale, self._coupling = terms.scale, terms.coupling
        matrix = terms.matrix + terms.coupling * np.eye(len(terms.scale))
        self._lower, self._upper = options.lower * terms.scale, options.upper * terms.scale
        self._rest = np.clip(np.zeros(len(terms.scale)), self._lower, self._upper)
        self._cost = options.sparsity * terms.scale
        self._sum, self._final = Pivoting(matrix), Pivoting(matrix)
        self._fading = max(1, round(AROUND * frame_rate))
        # Vertices that no shape moves add nothing to a product.
        moved = (terms.projection.reshape(len(matrix), -1, 3) != 0).any(axis=(0, 2))
        self._indices, self._used = terms.indices, terms.vertices[moved]
        self._projection = np.ascontiguousarray(
            terms.projection.reshape(len(matrix), -1, 3)[:, moved].reshape(len(matrix), -1)
        )
        self.reset()

    def reset(self) -> None:
        """Begin another motion, with the face at rest."""
        self._last = self._rest
        self._idle = np.full(len(self._scale), self._fading + 1)

    def solve(self, offsets: Floats) -> Array:
        """The weights (K,) of the next frame, with offsets (V, 3) from the neutral face; in the order of the names."""
        right = self._projection @ offsets[self._used].reshape(-1).astype(np.float64)
        if not np.isfinite(right).all():
            raise FaceDiffError("frame: holds NaN or infinity; generate the motion again")
        right += self._coupling * self._last
        lower, upper = self._lower, self._upper
        if self.options.sparsity > 0:
            at_work = self._sum.solve(right - self._cost, lower, upper) > ACTIVE * self._cost
            self._idle = np.where(at_work, 0, self._idle + 1)
            resting = self._idle > self._fading
            lower, upper = np.where(resting, self._rest, lower), np.where(resting, self._rest, upper)
        self._last = self._final.solve(right, lower, upper)
        weights = np.full(len(self.shapes.names), np.clip(0.0, self.options.lower, self.options.upper))
        # Division may lead past a bound by a rounding error.
        weights[self._indices] = np.clip(self._last / self._scale, self.options.lower, self.options.upper)
        return weights
