"""All coordinates of a frame through one linear map."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.components.mesh_encoder.base import MeshEncoder, MeshTopology, check_vertices
from facediff.registry import mesh_encoder


@mesh_encoder.register("linear")
class LinearMeshEncoder(MeshEncoder):
    """One linear map of all coordinates of a frame.

    Args:
        dim: channels of a frame's feature; given by the system.
        topology: the mesh; given by the system.
    """

    vertices: Tensor | None

    def __init__(self, *, dim: int, topology: MeshTopology) -> None:
        super().__init__()
        self.n_vertices = topology.n_vertices
        chosen = None if topology.vertices is None else torch.as_tensor(topology.vertices, dtype=torch.int64)
        self.register_buffer("vertices", chosen)
        self.map = nn.Linear(3 * (self.n_vertices if chosen is None else len(chosen)), dim)

    def forward(self, motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames dim"]:
        """The feature of each frame."""
        check_vertices(motion, self.n_vertices)
        if self.vertices is not None:
            motion = motion.index_select(2, self.vertices)
        return self.map(motion.flatten(2))
