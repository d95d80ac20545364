"""What every mesh encoder is, and what it is told about the mesh."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from jaxtyping import Float
from torch import Tensor, nn


class Array(Protocol):
    """Anything that ``torch.as_tensor`` takes: a tensor or a NumPy array."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Entries along each dimension."""
        ...


class VertexOperator(Protocol):
    """A sparse linear map from the vertices of a level to those of the next."""

    @property
    def rows(self) -> Array:
        """(N,) vertex after the map of each entry, ascending."""
        ...

    @property
    def columns(self) -> Array:
        """(N,) vertex before the map of each entry."""
        ...

    @property
    def weights(self) -> Array:
        """(N,) weight of each entry."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Vertices after and before the map."""
        ...


class TopologyLevel(Protocol):
    """One resolution of the mesh."""

    @property
    def n_vertices(self) -> int:
        """Vertices of this level."""
        ...

    @property
    def spirals(self) -> Array:
        """(n_vertices, length) every vertex and those around it, in a fixed order."""
        ...

    @property
    def down(self) -> VertexOperator | None:
        """Map to the next level; None at the last."""
        ...


class MeshTopology(Protocol):
    """A mesh at several resolutions; :class:`facediff.topology.hierarchy.MeshHierarchy` is one."""

    @property
    def n_vertices(self) -> int:
        """Vertices of the motion."""
        ...

    @property
    def vertices(self) -> Array | None:
        """Those of them that are encoded; None for all."""
        ...

    @property
    def levels(self) -> Sequence[TopologyLevel]:
        """Finest first."""
        ...


class MeshEncoder(nn.Module, ABC):
    """The vertices of each frame to one feature of ``dim`` channels; frames do not see one another.

    What an encoder keeps of the mesh is in its state dict, next to the weights that were trained on it: a checkpoint
    then means the same wherever and with whichever simplifier it is opened.
    """

    @abstractmethod
    def forward(self, motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames dim"]:
        """Encode each frame's offsets from the template, in the motion's unit."""


class MeshEncoderFactory(Protocol):
    """Makes a mesh encoder once the system's width and mesh are known."""

    def __call__(self, *, dim: int, topology: MeshTopology) -> MeshEncoder:
        """Make one for features of ``dim`` channels and motion on the given mesh."""
        ...


def check_vertices(motion: Tensor, n_vertices: int) -> None:
    """Refuse motion (batch, frames, vertices, 3) on another mesh.

    Raises:
        ValueError: if the number of vertices is another one; a larger one would be encoded without a complaint.
    """
    if motion.shape[2] != n_vertices:
        raise ValueError(f"motion has {motion.shape[2]} vertices, but the mesh encoder was made for {n_vertices}")
