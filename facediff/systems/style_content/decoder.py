"""The decoder that motion and speech share: content and style to motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

SLOPE = 0.2
"""Of the leaky ReLU after each layer."""


class MotionDecoder(nn.Module):
    """Causal convolutions over time with the style put beside the features before each, then fully connected layers.

    The sequence is padded with zeros at its front, so that its length is kept and no future frame is seen. The last of
    the fully connected layers is a trainable linear basis of the vertices.

    Args:
        n_vertices: vertices V.
        content_dim: channels of the content.
        style_dim: channels of the style vector.
        channels: of the convolutions.
        kernels: taps of the convolutions.
        hidden: channels of the fully connected layers before the coefficients.
        basis_size: coefficients, i.e. shapes of the basis.
    """

    def __init__(
        self,
        *,
        n_vertices: int,
        content_dim: int,
        style_dim: int,
        channels: Sequence[int] = (64, 128, 256),
        kernels: Sequence[int] = (5, 3, 3),
        hidden: Sequence[int] = (256, 256, 128),
        basis_size: int = 50,
    ) -> None:
        super().__init__()
        if len(channels) != len(kernels):
            raise ValueError(f"{len(channels)} channels but {len(kernels)} kernels: give one of each per convolution")
        widths = [content_dim, *channels]
        self.kernels = list(kernels)
        self.convolutions = nn.ModuleList(
            nn.Conv1d(width + style_dim, out, kernel)
            for width, out, kernel in zip(widths[:-1], channels, kernels, strict=True)
        )
        steps = [widths[-1], *hidden]
        self.connected = nn.Sequential(
            *(
                layer
                for width, out in zip(steps[:-1], hidden, strict=True)
                for layer in (nn.Linear(width, out), nn.LeakyReLU(SLOPE))
            ),
            nn.Linear(steps[-1], basis_size),
        )
        self.basis = nn.Linear(basis_size, 3 * n_vertices)

    @property
    def past_frames(self) -> int:
        """Frames before a frame that its motion depends on."""
        return sum(kernel - 1 for kernel in self.kernels)

    def start_from(self, mean: Float[Tensor, " coordinates"], shapes: Float[Tensor, "shapes coordinates"]) -> None:
        """Let the basis start from principal components, each scaled by its standard deviation.

        Where there are fewer of them than the basis has, the rest stay as they are but small.
        """
        with torch.no_grad():
            self.basis.weight.mul_(0.01)
            self.basis.weight[:, : len(shapes)] = shapes[: self.basis.in_features].T
            self.basis.bias.copy_(mean)

    def forward(
        self,
        content: Float[Tensor, "batch frames content_dim"],
        style: Float[Tensor, "batch style_dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Motion, flattened to 3V coordinates; what stands on padding frames has no meaning and no effect."""
        x = content
        beside = style[:, None].expand(-1, content.shape[1], -1)
        valid = mask[..., None].to(content.dtype)
        for conv, kernel in zip(self.convolutions, self.kernels, strict=True):
            columns = (torch.cat([x, beside], dim=-1) * valid).transpose(1, 2)
            columns = nn.functional.pad(columns, (kernel - 1, 0))
            x = nn.functional.leaky_relu(conv(columns).transpose(1, 2), SLOPE)
        coefficients = self.connected(x)
        # In mixed precision the last map stays in float32: differences over time of half-precision motion are noise.
        with torch.autocast(x.device.type, enabled=False):
            return self.basis(coefficients.float())
