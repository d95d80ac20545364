"""What every mesh encoder is, and what it is told about the mesh."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Protocol

from jaxtyping import Float
from torch import Tensor, nn


class MeshEncoder(nn.Module, ABC):
    """The vertices of each frame to one feature of ``dim`` channels; frames do not see one another.

    An encoder is made from sizes alone and told about the mesh later, before its first use: weight averaging copies the
    module before a corpus is known. What it keeps of the mesh are buffers whose shapes follow from the sizes; they are
    in its state dict, next to the weights that were trained on them, so that a checkpoint means the same wherever and
    with whichever simplifier it is opened.
    """

    @property
    def attached(self) -> bool:
        """Whether the encoder knows all that it needs of the mesh."""
        return True

    @property
    def mesh_options(self) -> dict[str, Any]:
        """What :func:`facediff.topology.hierarchy.mesh_hierarchy` is to make for :meth:`attach`."""
        return {}

    def attach(self, topology: Any) -> None:  # noqa: ANN401, B027 - an encoder that needs no mesh has nothing to do
        """Take over what follows from the mesh.

        Args:
            topology: a :class:`facediff.topology.hierarchy.MeshHierarchy` of :attr:`mesh_options`.
        """

    @abstractmethod
    def forward(self, motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames dim"]:
        """Encode each frame's offsets from the template, in the motion's unit."""


class MeshEncoderFactory(Protocol):
    """Makes a mesh encoder once the system's sizes are known."""

    def __call__(self, *, dim: int, n_vertices: int) -> MeshEncoder:
        """Make one for features of ``dim`` channels and motion of ``n_vertices`` vertices."""
        ...


def check_vertices(motion: Tensor, n_vertices: int) -> None:
    """Refuse motion (batch, frames, vertices, 3) on another mesh.

    Raises:
        ValueError: if the number of vertices is another one; a larger one would be encoded without a complaint.
    """
    if motion.shape[2] != n_vertices:
        raise ValueError(f"motion has {motion.shape[2]} vertices, but the mesh encoder was made for {n_vertices}")
