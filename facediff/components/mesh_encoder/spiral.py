"""Spiral convolutions over the mesh with vertex down-sampling between them."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from facediff.components.mesh_encoder.base import MeshEncoder, MeshTopology, TopologyLevel, check_vertices
from facediff.registry import mesh_encoder


class SpiralDown(nn.Module):
    """Spiral convolution, then vertex down-sampling.

    Gong et al. 2019, SpiralNet++, eq. 1: a vertex's new feature is a linear map of the features along its spiral, one
    after the other. Down-sampling is linear too, so the convolution is evaluated only at the vertices that it takes.

    Args:
        level: spirals of the mesh and the map to the next level.
        in_channels: channels of a vertex.
        out_channels: channels of a vertex of the next level.
        source: (n_vertices,) where the level's vertices are found in the input; None where the input is just them.
    """

    table: Tensor
    rows: Tensor | None
    weights: Tensor | None

    def __init__(self, level: TopologyLevel, in_channels: int, out_channels: int, source: Tensor | None) -> None:
        super().__init__()
        down = level.down
        if down is None:
            raise ValueError("the topology ends here: it has fewer down-samplings than the encoder has convolutions")
        rows, columns = (torch.as_tensor(part, dtype=torch.int64) for part in (down.rows, down.columns))
        weights = torch.as_tensor(down.weights, dtype=torch.float32)
        table = torch.as_tensor(level.spirals, dtype=torch.int64)[columns]
        self.n_vertices = down.shape[0]
        selection = len(rows) == self.n_vertices and bool((weights == 1).all())
        self.register_buffer("table", table if source is None else source[table])
        self.register_buffer("rows", None if selection else rows)
        self.register_buffer("weights", None if selection else weights)
        self.map = nn.Linear(table.shape[1] * in_channels, out_channels)
        nn.init.xavier_uniform_(self.map.weight)
        nn.init.zeros_(self.map.bias)

    def forward(self, x: Float[Tensor, "frames vertices in_channels"]) -> Float[Tensor, "frames coarse out_channels"]:
        """Features of the next level's vertices."""
        around = x.index_select(1, self.table.flatten()).view(len(x), len(self.table), -1)
        out = self.map(around)
        if self.rows is None or self.weights is None:
            return out
        weighted = out * self.weights[:, None]
        return weighted.new_zeros(len(x), self.n_vertices, out.shape[-1]).index_add(1, self.rows, weighted)


@mesh_encoder.register("spiral")
class SpiralMeshEncoder(MeshEncoder):
    """Spiral convolutions with vertex down-sampling and leaky ReLU, then one linear map of all vertices' features.

    Each step is [spiral convolution → down-sampling → leaky ReLU], without normalisation; the topology must have as
    many down-samplings as there are steps, or more.

    Args:
        dim: channels of a frame's feature; given by the system.
        topology: the mesh; given by the system.
        channels: channels of a vertex after each step.
        negative_slope: slope of the leaky ReLU below zero.
        max_frames: frames to encode at a time in training; what lies between is computed again for the gradient, so
            that memory grows with this number only. None for all at once, which is faster.
    """

    def __init__(
        self,
        *,
        dim: int,
        topology: MeshTopology,
        channels: tuple[int, ...] = (16, 32, 32),
        negative_slope: float = 0.2,
        max_frames: int | None = None,
    ) -> None:
        super().__init__()
        if len(channels) >= len(topology.levels):
            raise ValueError(
                f"{len(channels)} channels need as many down-samplings; the topology has {len(topology.levels) - 1}"
            )
        if max_frames is not None and max_frames < 1:
            raise ValueError(f"max_frames {max_frames}; expected at least 1, or None")
        self.n_vertices = topology.n_vertices
        self.negative_slope = negative_slope
        self.max_frames = max_frames
        chosen = None if topology.vertices is None else torch.as_tensor(topology.vertices, dtype=torch.int64)
        self.steps = nn.ModuleList()
        width = 3
        for level, wider in zip(topology.levels, channels, strict=False):
            self.steps.append(SpiralDown(level, width, wider, None if self.steps else chosen))
            width = wider
        self.map = nn.Linear(topology.levels[len(channels)].n_vertices * width, dim)

    def forward(self, motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames dim"]:
        """The feature of each frame."""
        check_vertices(motion, self.n_vertices)
        frames = motion.flatten(0, 1)
        if self.max_frames is None or len(frames) <= self.max_frames:
            return self.encode(frames).view(*motion.shape[:2], -1)
        parts = [self._part(part) for part in frames.split(self.max_frames)]
        return torch.cat(parts).view(*motion.shape[:2], -1)

    def encode(self, x: Float[Tensor, "frames vertices 3"]) -> Float[Tensor, "frames dim"]:
        """The feature of each frame of one sequence."""
        for step in self.steps:
            x = F.leaky_relu(step(x), self.negative_slope)
        return self.map(x.flatten(1))

    def _part(self, x: Tensor) -> Tensor:
        # Nothing here is random, so there is no generator's state to keep.
        part: Tensor = checkpoint(self.encode, x, use_reentrant=False, preserve_rng_state=False)
        return part
