"""Mesh encoders: the vertices of a frame to one feature, by a linear map of them or of components, or by spirals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Protocol

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from facediff.errors import FaceDiffError
from facediff.models.layers import Frames, Width
from facediff.models.motion_space import PrincipalComponents
from facediff.registry import mesh_encoder
from facediff.utils.ranges import Dims, Range, Vertices

Motion = Float[Tensor, "batch frames points dims"]
"""Offsets from the template."""

SLOPE = 0.2
"""Of the leaky ReLU after each spiral convolution (Chai et al., style-content disentanglement)."""


class MeshEncoder(nn.Module, ABC):
    """The vertices of each frame to one feature of ``dim`` channels; frames do not see one another.

    An encoder is made from sizes alone and given the mesh later, before its first use: weight averaging copies the
    module before a corpus is known. Its tensors of the mesh are buffers with shapes that follow from the sizes; they
    are in its state dict, next to the weights that were trained on them, so that a checkpoint does not depend on the
    version of the mesh simplifier.
    """

    @property
    def attached(self) -> bool:
        """Whether the encoder has all that it needs of the mesh."""
        return True

    @property
    def mesh_options(self) -> dict[str, Any]:
        """What :func:`facediff.mesh.hierarchy.mesh_hierarchy` is to make for :meth:`attach`."""
        return {}

    def attach(self, topology: Any) -> None:  # noqa: ANN401, B027 - an encoder that needs no mesh has nothing to do
        """Take over the mesh's tensors."""

    @abstractmethod
    def forward(self, motion: Motion) -> Frames:
        """Encode each frame's offsets from the template, in the motion's unit."""


class MeshEncoderFactory(Protocol):
    """Makes a mesh encoder once the model's sizes are known."""

    def __call__(self, *, dim: int, n_vertices: int, dims: int) -> MeshEncoder:
        """Make one for features of ``dim`` channels and motion of ``n_vertices`` points of ``dims`` numbers."""


@mesh_encoder.register("linear")
class LinearMeshEncoder(MeshEncoder):
    """One linear map of all coordinates of a frame: X = Linear(M_ref) of the dual-path paper, section 1.3.1."""

    def __init__(self, *, dim: Width, n_vertices: Vertices, dims: Dims) -> None:
        super().__init__()
        self.n_vertices, self.dims = n_vertices, dims
        self.map = nn.Linear(dims * n_vertices, dim)

    def forward(self, motion: Motion) -> Frames:
        """The feature of each frame."""
        return self.map(motion.flatten(2))


@mesh_encoder.register("components")
class ComponentMeshEncoder(MeshEncoder):
    """One linear map of a frame's principal components, each of unit variance.

    In X = Linear(M_ref) on vertices, the map's gradient for a movement grows with the movement's size: it sees the jaw
    and hardly the lids and brows, by which people differ as well. Here all movements come alike.

    Args:
        count: components.
    """

    def __init__(
        self, *, dim: Width, n_vertices: Vertices, dims: Dims, count: Annotated[int, Range(1, 4096)] = 64
    ) -> None:
        super().__init__()
        self.n_vertices, self.dims = n_vertices, dims
        self.components = PrincipalComponents(n_vertices, dims, count)
        self.map = nn.Linear(count, dim)

    def forward(self, motion: Motion | Float[Tensor, "batch frames all_components"]) -> Frames:
        """The feature of each frame, of offsets or of their components."""
        return self.map(self.components.project(motion))


class SpiralDown(nn.Module):
    """Spiral convolution, then vertex down-sampling.

    Gong et al. 2019, SpiralNet++, eq. 1: a vertex's new feature is a linear map of the features along its spiral, one
    after the other. The convolution is evaluated only at the vertices that the down-sampling takes.
    """

    table: Tensor
    rows: Tensor | None
    weights: Tensor | None
    map: nn.Linear

    def __init__(
        self, n_fine: int, n_coarse: int, length: int, in_channels: int, out_channels: int, *, mean: bool = False
    ) -> None:
        super().__init__()
        self.sizes = n_fine, n_coarse
        n_points = n_fine if mean else n_coarse
        self.register_buffer("table", torch.zeros(n_points, length, dtype=torch.int64))
        self.register_buffer("rows", torch.zeros(n_points, dtype=torch.int64) if mean else None)
        self.register_buffer("weights", torch.zeros(n_points) if mean else None)
        # A linear map of the concatenated spiral is a convolution with a filter that depends on the position along the
        # spiral: the fixed order of neighbours stands in for the grid of pixels.
        self.map = nn.Linear(length * in_channels, out_channels)
        nn.init.xavier_uniform_(self.map.weight)
        nn.init.zeros_(self.map.bias)

    def forward(self, x: Float[Tensor, "vertices in_channels frames"]) -> Float[Tensor, "coarse out_channels frames"]:
        """Features of the next level's vertices."""
        # Vertices come first, so that a gather and its gradient move whole rows, and the features along each vertex's
        # spiral are one after the other without a copy. A plain matmul would make one, to fold the vertices.
        around = x.index_select(0, self.table.flatten()).view(len(self.table), self.map.in_features, x.shape[-1])
        out = torch.bmm(self.map.weight.expand(len(around), -1, -1), around) + self.map.bias[:, None]
        if self.rows is None or self.weights is None:
            return out
        # A sparse matrix product by scattering: each vertex adds its share to the one coarse vertex of its group.
        # By index_add and not by a sparse matrix, which the format of exported graphs does not have.
        shares = out * self.weights[:, None, None]
        return shares.new_zeros(self.sizes[1], *out.shape[1:]).index_add(0, self.rows, shares)


@mesh_encoder.register("spiral")
class SpiralMeshEncoder(MeshEncoder):
    """Spiral convolutions with vertex down-sampling and leaky ReLU, then one linear map of all vertices' features.

    Each step is [spiral convolution → down-sampling → leaky ReLU], without normalisation (Chai et al., style-content
    disentanglement).

    Args:
        channels: channels of a vertex after each step.
        factor: vertices before a down-sampling to one after it.
        spiral_length: vertices of a spiral, its centre included.
        dilation: distance along the spiral between two of them.
        pooling: whether down-sampling takes one vertex of each group, which leaves a few vertices of the motion unseen,
            or the mean of the group, which sees all of them and takes five to ten times as long.
    """

    steps: Sequence[SpiralDown]
    map: nn.Linear

    def __init__(
        self,
        *,
        dim: Width,
        n_vertices: Vertices,
        dims: Dims,
        channels: Annotated[tuple[int, ...], Range(1, 4096, items=(0, 16))] = (16, 32, 32),
        factor: Annotated[int, Range(1, 1000)] = 4,
        spiral_length: Annotated[int, Range(1, 1000)] = 12,
        dilation: Annotated[int, Range(1, 1000)] = 1,
        pooling: Literal["select", "mean"] = "select",
    ) -> None:
        super().__init__()
        if dims != 3:
            raise FaceDiffError(
                "mesh_encoder=spiral follows the surface of a mesh, which channels of a parametric space do not have; "
                "choose mesh_encoder=linear or mesh_encoder=components"
            )
        self.n_vertices = n_vertices
        self.factor = factor
        self.spiral_length = spiral_length
        self.dilation = dilation
        self.pooling = pooling
        self._attached = False
        steps = []
        width, vertices = 3, n_vertices
        for wider in channels:
            # Rounded up, as the hierarchy does: its sizes must be known here, before there is any mesh.
            fewer = -(-vertices // factor)
            steps.append(SpiralDown(vertices, fewer, spiral_length, width, wider, mean=pooling == "mean"))
            width, vertices = wider, fewer
        self.steps = nn.ModuleList(steps)  # type: ignore[assignment] # behaves as a sequence of what it was given
        self.map = nn.Linear(vertices * width, dim)

    @property
    def attached(self) -> bool:
        """Whether the tables of spirals are there; before, they are zero."""
        if not self._attached:  # cached once it is true, since reading the table waits for the device
            self._attached = not self.steps or bool(self.steps[0].table.any())
        return self._attached

    @property
    def mesh_options(self) -> dict[str, Any]:
        """As many down-samplings as there are steps."""
        return {
            "levels": len(self.steps),
            "factor": self.factor,
            "spiral_length": self.spiral_length,
            "dilation": self.dilation,
            "pooling": self.pooling,
        }

    def attach(self, topology: Any) -> None:  # noqa: ANN401 - a component does not import the topology's types
        """Take over the down-samplings, and the spirals of the vertices that each of them takes."""
        for step, level in zip(self.steps, topology.levels, strict=False):
            spirals = torch.as_tensor(level.spirals, dtype=torch.int64)
            step.table.copy_(spirals[torch.as_tensor(level.down.columns)])
            if step.rows is not None and step.weights is not None:
                step.rows.copy_(torch.as_tensor(level.down.rows))
                step.weights.copy_(torch.as_tensor(level.down.weights))
        # True from here on, also while averaged weights are in place: a copy made earlier has tables of zeros.
        self._attached = True

    def forward(self, motion: Motion) -> Frames:
        """The feature of each frame."""
        if not self.attached:
            raise FaceDiffError("mesh encoder: the mesh is not known yet; attach a hierarchy, or load trained weights")
        x = motion.flatten(0, 1).permute(1, 2, 0).contiguous()
        for step in self.steps:
            x = F.leaky_relu(step(x), SLOPE)
        return self.map(x.flatten(0, 1).T).view(*motion.shape[:2], -1)
