"""All coordinates of a frame through one linear map."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from facediff.components.mesh_encoder.base import MeshEncoder, check_vertices
from facediff.registry import mesh_encoder


@mesh_encoder.register("linear")
class LinearMeshEncoder(MeshEncoder):
    """One linear map of all coordinates of a frame: X = Linear(M_ref) of the dual-path paper, section 1.3.1.

    Args:
        dim: channels of a frame's feature; given by the system.
        n_vertices: vertices of the mesh; given by the system.
    """

    def __init__(self, *, dim: int, n_vertices: int) -> None:
        super().__init__()
        self.n_vertices = n_vertices
        self.map = nn.Linear(3 * n_vertices, dim)

    def forward(self, motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames dim"]:
        """The feature of each frame."""
        check_vertices(motion, self.n_vertices)
        return self.map(motion.flatten(2))
