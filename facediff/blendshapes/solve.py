"""From a take to weights of blendshapes: one bounded least-squares problem over all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from facediff.blendshapes.arkit import mirror_pairs
from facediff.blendshapes.newton import Problem, minimise
from facediff.blendshapes.options import SolveOptions
from facediff.blendshapes.shapes import ShapeSet
from facediff.blendshapes.weights import Weights
from facediff.errors import FaceDiffError, choices
from facediff.takes import Take, metres_per_unit

Array = npt.NDArray[np.float64]

CHUNK_BYTES = 32 * 2**20
STATED_RATE = 30.0
"""Frames a second for which the smoothness is stated."""


@dataclass(frozen=True)
class _Moving:
    """The shapes that move something, on the vertices that count.

    Attributes:
        places: which of the set's shapes these are.
        vertices: (N,) vertices that count.
        area: (N,) their shares, which sum to one.
        deltas: (K, 3N) displacements.
        energy: (K,) weighted mean square of each.
    """

    places: npt.NDArray[np.int64]
    vertices: npt.NDArray[np.int64]
    area: Array
    deltas: Array
    energy: Array


def solve(take: Take, shapes: ShapeSet, options: SolveOptions | None = None) -> Weights:
    """Weights w_t that bring the shapes nearest to a take.

    Minimises Σ_t ½‖Σ_k w_tk d_k − (x_t − template)‖² + ½λ Σ_t Σ_k e_k (w_tk − w_{t−1,k})² + ½σ Σ_t Σ_(l,r) ½(e_l + e_r)
    (w_tl − w_tr)² + ½ρ Σ_t Σ_k e_k w_tk² with lower ≤ w ≤ upper, where d_k are the displacements of shape k, norms are
    means over vertices weighted by area, and e_k = ‖d_k‖² makes the strengths λ (smoothness), σ (symmetry) and ρ
    (ridge) the same for shapes that move much and little. All frames are solved for together.

    Args:
        take: the performance.
        shapes: of the take's topology.
        options: the usual ones if None.

    Raises:
        FaceDiffError: if the topologies differ, a frame is not finite, the region is unknown, or no shape moves
            anything.
    """
    options = options or SolveOptions()
    if shapes.deltas.shape[1] != len(take.template):
        raise FaceDiffError(
            f"{take.name}: has {len(take.template)} vertices and the shapes {shapes.deltas.shape[1]}; give shapes of "
            f"the same mesh, or carry them over with `facediff blendshapes --carry`"
        )
    moving = _moving(take, shapes, options)
    scale = np.sqrt(moving.energy)
    weighted = moving.deltas * np.repeat(moving.area, 3) / scale[:, None]
    right, amplitude = _products(take, moving, weighted)
    gram = weighted @ (moving.deltas / scale[:, None]).T
    problem = _problem(gram, right, scale, [shapes.names[k] for k in moving.places], options, take.frame_rate)
    found, converged = minimise(problem, torch.from_numpy(options.tolerance * scale), options.max_iterations)
    values = np.zeros((len(right), len(shapes.names)))
    values[:] = np.clip(0.0, options.lower, options.upper)
    # Division may lead past a bound by a rounding error.
    values[:, moving.places] = np.clip(found.numpy() / scale, options.lower, options.upper)
    rms, most = _residuals(take, moving, values[:, moving.places])
    millimetres = 1000.0 * metres_per_unit(take.unit)
    told = {
        "smoothness": f"{options.smoothness:g}",
        "symmetry": f"{options.symmetry:g}",
        "ridge": f"{options.ridge:g}",
        "bounds": f"{options.lower:g} {options.upper:g}",
        "region": options.region or "whole face",
        "converged": "yes" if converged else f"no, after {options.max_iterations} iterations",
    }
    return Weights(
        names=shapes.names,
        values=values,
        residual_rms_mm=millimetres * rms,
        residual_max_mm=millimetres * most,
        amplitude_mm=millimetres * amplitude,
        frame_rate=take.frame_rate,
        still=tuple(name for k, name in enumerate(shapes.names) if k not in moving.places),
        metadata={**take.metadata, **{f"solve {key}": value for key, value in told.items()}},
    )


def vertex_areas(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> Array:
    """A third of the area of every triangle around each vertex, (V,)."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    total: Array = np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices)).astype(np.float64)
    return total


def _moving(take: Take, shapes: ShapeSet, options: SolveOptions) -> _Moving:
    used = np.arange(len(take.template))
    if options.region is not None:
        if not take.regions:
            raise FaceDiffError(f"{take.name}: has no regions; give --checkpoint, or leave the region away")
        if options.region not in take.regions:
            raise FaceDiffError(
                f'{take.name}: has no region "{options.region}"; {choices(options.region, take.regions)}'
            )
        used = np.unique(np.asarray(take.regions[options.region], np.int64))
    area = np.ones(len(used))
    if options.area_weighted and take.faces is not None and len(take.faces):
        whole = vertex_areas(take.template, take.faces)[used]
        area = whole if whole.sum() > 0 else area
    area = area / max(float(area.sum()), np.finfo(float).tiny)
    deltas = shapes.deltas[:, used].reshape(len(shapes.names), -1).astype(np.float64)
    energy = np.square(deltas) @ np.repeat(area, 3)
    still = np.array([name in shapes.still for name in shapes.names])
    places = np.flatnonzero(~still & (energy > 1e-12 * energy.max(initial=0.0)))
    if not len(places):
        raise FaceDiffError(f"{take.name}: no shape moves any vertex that counts; give other shapes or another region")
    return _Moving(places, used, area, deltas[places], energy[places])


def _displacements(take: Take, moving: _Moving, frames: slice) -> Array:
    """Displacements (frames, N, 3) from the template; refuses what is not finite."""
    chunk = np.asarray(take.vertices[frames], np.float64)
    finite = np.isfinite(chunk).all(axis=(1, 2))
    if not finite.all():
        bad = frames.start + int(np.argmin(finite))
        raise FaceDiffError(f"{take.name}: frame {bad} holds NaN or infinity; make the motion anew")
    moved: Array = (chunk - np.asarray(take.template, np.float64))[:, moving.vertices]
    return moved


def _slices(take: Take) -> list[slice]:
    step = max(1, CHUNK_BYTES // (24 * len(take.template)))
    return [slice(first, first + step) for first in range(0, len(take.vertices), step)]


def _products(take: Take, moving: _Moving, weighted: Array) -> tuple[Array, float]:
    """Each frame's products with the weighted shapes (T, K), and the motion's root mean square."""
    products, square = [], 0.0
    for frames in _slices(take):
        moved = _displacements(take, moving, frames)
        products.append(moved.reshape(len(moved), -1) @ weighted.T)
        square += float(np.square(moved).sum())
    return np.concatenate(products), float(np.sqrt(square / (len(take.vertices) * len(moving.vertices))))


def _residuals(take: Take, moving: _Moving, values: Array) -> tuple[Array, Array]:
    """Root mean square and maximum (T,) over the vertices of the distances that are left."""
    rms, most = [], []
    for frames in _slices(take):
        moved = _displacements(take, moving, frames)
        square = np.square(moved - (values[frames] @ moving.deltas).reshape(moved.shape)).sum(axis=-1)
        rms.append(np.sqrt(square.mean(axis=-1)))
        most.append(np.sqrt(square.max(axis=-1)))
    return np.concatenate(rms), np.concatenate(most)


def _problem(
    gram: Array, right: Array, scale: Array, names: list[str], options: SolveOptions, frame_rate: float
) -> Problem:
    """The quadratic program in weights times the root of each shape's energy, whose matrix has ones on its diagonal."""
    matrix = gram + options.ridge * np.eye(len(scale))
    for left, other in mirror_pairs(tuple(names)):
        cost = 0.5 * options.symmetry * (scale[left] ** 2 + scale[other] ** 2)
        row = np.zeros(len(scale))
        row[left], row[other] = 1.0 / scale[left], -1.0 / scale[other]
        matrix += cost * np.outer(row, row)
    return Problem(
        torch.from_numpy(0.5 * (matrix + matrix.T)),
        torch.from_numpy(right),
        # A movement that takes as many seconds takes more steps at a higher frame rate, each the smaller.
        options.smoothness * (frame_rate / STATED_RATE) ** 2,
        torch.from_numpy(options.lower * scale),
        torch.from_numpy(options.upper * scale),
    )
