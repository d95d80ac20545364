"""Unit Gaussian noise of the size of vertex motion."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

PART = 2**21
"""How many numbers one stream draws on a processor."""


def unit_noise(shape: Sequence[int], device: torch.device, generator: torch.Generator | None = None) -> Tensor:
    """Noise, drawn by all threads of a processor.

    PyTorch draws on a processor with one thread, which with 70 000 coordinates a frame is a good part of a training
    step. Here many streams, seeded by ``generator``, are drawn side by side. How many threads there are
    does not change the numbers.

    Args:
        shape: the shape of the noise.
        device: where to draw.
        generator: source of the draws; torch's global one if None.
    """
    if device.type != "cpu":
        return torch.randn(*shape, device=device, generator=generator)
    noise = torch.empty(*shape)
    parts = torch.split(noise.view(-1), PART)
    seeds = torch.randint(2**63 - 1, (len(parts),), generator=generator).tolist()

    mode = torch.is_inference_mode_enabled()  # a thread does not know its caller's

    def draw(part: Tensor, seed: int) -> None:
        with torch.inference_mode(mode):
            part.normal_(generator=torch.Generator().manual_seed(seed))

    with ThreadPoolExecutor(torch.get_num_threads()) as threads:
        list(threads.map(draw, parts, seeds))
    return noise
