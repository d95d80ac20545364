"""Motion through a correspondence."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from facediff.retarget.correspondence import Correspondence
from facediff.retarget.order import refuse_other_mesh
from facediff.retarget.smoothing import averaging
from facediff.retarget.surface import Surface
from facediff.takes import Take, metres_per_unit
from facediff.takes.units import METRES
from facediff.topology import Mesh

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

ROUNDS = 20
"""How often vertices whose place is not well known are averaged with their neighbours."""
CHUNK_BYTES = 32 * 2**20
SAME_UNIT = 1.4
"""Named units lie further apart than this factor, and people's heads differ by less."""


def carry_displacements(correspondence: Correspondence, displacements: npt.NDArray[np.floating]) -> Array:
    """Displacements of the source's vertices (T, Vs, 3) as those of the target's (T, Vt, 3), in its unit and axes.

    Each target vertex takes the weighted mean of its triangle's corners, turned and scaled by the similarity. Where
    its place on the source is not well known, neighbours are averaged; where it is far from anything, motion fades.
    """
    matrix = correspondence.similarity.scale * correspondence.similarity.rotation
    moved = np.asarray(displacements, np.float64)
    made = sum(correspondence.weights[:, k, None] * moved[:, correspondence.corners[:, k]] for k in range(3)) @ matrix.T
    smoothing = averaging(correspondence.trust, correspondence.target_faces)
    if smoothing is not None:
        flat = torch.from_numpy(np.ascontiguousarray(made.transpose(1, 0, 2)).reshape(made.shape[1], -1))
        known = torch.from_numpy(correspondence.trust)[:, None] * flat
        for _ in range(ROUNDS):
            flat = known + torch.sparse.mm(smoothing, flat)
        made = flat.numpy().reshape(made.shape[1], made.shape[0], 3).transpose(1, 0, 2)
    result: Array = correspondence.share[:, None] * made
    return result


def carry(take: Take, correspondence: Correspondence, target: Mesh) -> Take:
    """A take's motion on another mesh.

    The target's vertices, triangles and colours are kept as they are; its unit follows from how large it is.

    Args:
        take: of the correspondence's source mesh, of the same or another identity.
        correspondence: from :func:`facediff.retarget.correspond`.
        target: its target mesh.

    Raises:
        FaceDiffError: if one of the meshes is not the correspondence's, or has its vertices in another order, or a
            frame is not finite.
    """
    refuse_other_mesh(
        take.name, take.template, take.triangles, correspondence.source_vertices, correspondence.source_faces
    )
    refuse_other_mesh(
        "target mesh", target.vertices, target.faces, correspondence.target_vertices, correspondence.target_faces
    )
    take.refuse_not_finite()
    rest = np.asarray(target.vertices, np.float64)
    neutral = np.asarray(take.template, np.float64)
    vertices = np.empty((len(take.vertices), len(rest), 3), np.float32)
    step = max(1, CHUNK_BYTES // (24 * max(len(rest), len(neutral))))
    for first in range(0, len(vertices), step):
        some = slice(first, first + step)
        vertices[some] = rest + carry_displacements(
            correspondence, np.asarray(take.vertices[some], np.float64) - neutral
        )
    return Take(
        name=take.name,
        vertices=vertices,
        template=rest.astype(np.float32),
        frame_rate=take.frame_rate,
        faces=np.asarray(target.faces, np.int32),
        unit=unit_of(take.unit, correspondence.similarity.scale),
        speech=take.speech,
        sample_rate=take.sample_rate,
        colours=target.colours,
        regions={name: carried_region(correspondence, indices) for name, indices in take.regions.items()},
        inner_lip_pairs=carried_pairs(correspondence, take.inner_lip_pairs),
        metadata={
            **take.metadata,
            "carried": f"from a mesh of {len(neutral)} vertices to one of {len(rest)} by nearest points of its surface",
        },
    )


def unit_of(unit: str, scale: float) -> str:
    """The target's unit: the take's own or a named one, if the sizes say so within what people differ; else a number.

    Args:
        unit: the source's.
        scale: target units to a source unit.
    """
    if 1 / SAME_UNIT < scale < SAME_UNIT:
        return unit
    metres = metres_per_unit(unit) / scale
    near = [name for name, value in METRES.items() if 1 / SAME_UNIT < metres / value < SAME_UNIT]
    return near[0] if near else f"{metres:.6g}"


def carried_region(correspondence: Correspondence, indices: npt.NDArray[np.integer]) -> Indices:
    """A region of the source as that of the target: vertices whose place is more inside than out, and that move."""
    member = np.zeros(len(correspondence.source_vertices))
    member[indices] = 1.0
    inside = (member[correspondence.corners] * correspondence.weights).sum(axis=1)
    return np.flatnonzero((inside > 0.5) & (correspondence.share > 0))


def carried_pairs(correspondence: Correspondence, pairs: npt.NDArray[np.integer] | None) -> Indices | None:
    """Pairs of facing vertices of the source as those of the target's vertices that lie nearest on the same sheet."""
    if pairs is None or not len(pairs):
        return None
    source = Surface(correspondence.source_vertices, correspondence.source_faces)
    shown = np.einsum("vc,vcd->vd", correspondence.weights, source.vertices[correspondence.corners])
    facing = np.einsum("vc,vcd->vd", correspondence.weights, source.normals[correspondence.corners])
    wanted, places = np.unique(np.asarray(pairs).ravel(), return_inverse=True)
    away = np.linalg.norm(shown[None] - source.vertices[wanted, None], axis=2)
    away += source.size * ((facing[None] * source.normals[wanted, None]).sum(axis=2) <= 0)
    # Of vertices in one place, the first is the same one in both meshes where these have one topology.
    found = away.argmin(axis=1)[places].reshape(-1, 2)
    made = np.unique(found[found[:, 0] != found[:, 1]], axis=0)
    return made if len(made) else None
