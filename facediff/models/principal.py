"""Principal components of the training motion, as a part of a model that is known before the corpus is."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.errors import FaceDiffError

SMALLEST = 1e-4
"""Components below this share of the first one's deviation are treated as if they had it."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Offsets from the template (…, V, dims) to components (…, K).

    Attributes:
        into: the linear map, (dims · V, K).
        offset: what is subtracted, (K,).
    """

    into: Float[Tensor, "all components"]
    offset: Float[Tensor, " components"]

    def __call__(self, motion: Float[Tensor, "*frames points dims"]) -> Float[Tensor, "*frames components"]:
        """The components of each frame."""
        return motion.flatten(-2) @ self.into - self.offset


class PrincipalComponents(nn.Module):
    """Motion as numbers of unit variance that are uncorrelated over the training frames, largest movement first.

    A model gives every one of its modules of this class the training motion's statistics when its first training
    begins, and keeps them in its checkpoints. Shapes follow from the sizes alone, since weight averaging copies modules
    before a corpus is known.

    Args:
        n_vertices: points V.
        dims: numbers of a point.
        count: components K; motion outside them is lost.

    Attributes:
        mean: mean of all coordinates, (n,) with n = dims · V, scaled.
        basis: unit components of weighted motion, (K, n); zero where the corpus has fewer.
        weights: what each coordinate is multiplied by before the components are taken, (n,); of channels a matrix
            (n, n), since what two of them move together is more or less than the sum of both.
        unweighted: the inverse of such a matrix; None where weights are numbers.
        deviations: the components' standard deviations, (K,).
    """

    mean: Tensor
    basis: Tensor
    weights: Tensor
    unweighted: Tensor | None
    deviations: Tensor

    def __init__(self, n_vertices: int, dims: int, count: int) -> None:
        super().__init__()
        self.dims = dims
        self.count = count
        size = dims * n_vertices
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("basis", torch.zeros(count, size))
        self.register_buffer("weights", torch.eye(size) if dims == 1 else torch.ones(size))
        self.register_buffer("unweighted", torch.eye(size) if dims == 1 else None)
        self.register_buffer("deviations", torch.ones(count))

    def attach(
        self, mean: Float[Tensor, " all"], shapes: Float[Tensor, "components all"], weights: Float[Tensor, "*all"]
    ) -> None:
        """Take over the training motion's statistics.

        Args:
            mean: mean of all coordinates, scaled.
            shapes: principal components of weighted motion, each as long as its standard deviation, largest first;
                those beyond ``count`` are left out.
            weights: what each coordinate was multiplied by, or the matrix that all were.

        Raises:
            FaceDiffError: if the training motion never changes.
        """
        shapes = shapes[: self.count]
        deviations = torch.linalg.vector_norm(shapes, dim=1)
        if not len(deviations) or not float(deviations[0]) > 0:
            raise FaceDiffError(
                "the training motion never changes, so it has no principal components, which motion_space=components "
                "and mesh_encoder=components need; check the corpus with `facediff data check`"
            )
        # Copied into the buffers and not assigned: the optimiser, weight averages and compiled graphs hold these very
        # tensors.
        self.mean.copy_(mean)
        self.weights.copy_(weights)
        if self.unweighted is not None:
            self.unweighted.copy_(torch.linalg.inv(weights.double()))
        self.basis.zero_()[: len(shapes)] = shapes / deviations[:, None]
        # Projection divides by the deviations. A component that hardly varies, or that the corpus does not have, would
        # turn rounding errors into coordinates of unit size.
        smallest = SMALLEST * float(deviations[0])
        self.deviations.fill_(smallest)[: len(shapes)] = deviations.clamp_min(smallest)

    def project(
        self, motion: Float[Tensor, "batch frames points dims"] | Float[Tensor, "batch frames all_components"]
    ) -> Float[Tensor, "batch frames components"]:
        """Components of scaled offsets from the template, each of unit variance over the training frames.

        Training motion may come as components already, of a projection of this or of more components.
        """
        if motion.dim() == 3:
            return motion[..., : self.count]
        with torch.autocast(motion.device.type, enabled=False):
            # Not in mixed precision: a sum over 70 000 products in 16 bits would be off by more than the small
            # components' size. Mean and weights are folded into the map: at 6 000 vertices centring a copy of the
            # motion takes longer than the product.
            return self._projection()(motion)

    def projection(self, scale: float) -> Projection:
        """The same for unscaled offsets, by itself and on the processor, for the processes that read clips."""
        own = self._projection()
        return Projection((own.into * scale).cpu(), own.offset.cpu())

    def _projection(self) -> Projection:
        weighted = self.basis * self.weights if self.unweighted is None else self.basis @ self.weights
        into = weighted.T / self.deviations
        return Projection(into, self.mean @ into)

    def expand(self, components: Float[Tensor, "batch frames components"]) -> Float[Tensor, "batch frames points dims"]:
        """The scaled offsets with these components; all other components are those of the mean."""
        with torch.autocast(components.device.type, enabled=False):
            back = components.to(self.basis.dtype) * self.deviations
            # The basis is orthonormal in weighted coordinates, so its transpose is its inverse there; then the weights
            # are undone.
            shaped = back @ self.basis
            shaped = shaped / self.weights if self.unweighted is None else shaped @ self.unweighted.T
            motion = shaped + self.mean
            return motion.view(*motion.shape[:2], -1, self.dims)
