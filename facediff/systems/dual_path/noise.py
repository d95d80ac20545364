"""Noise that depends on a clip's name and a seed, not on the clips beside it nor on how long speech is cut."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.systems.windows import Window


class ClipNoise:
    """Unit Gaussian noise for clips that are made at once, zero on their padding; each has a stream of its own.

    Args:
        names: of the clips.
        lengths: their frames.
        seeds: one for each.
        device: where the noise is drawn.
    """

    def __init__(
        self, names: Sequence[str], lengths: Sequence[int], seeds: Sequence[int], device: torch.device
    ) -> None:
        self.lengths = list(lengths)
        self.streams = [
            torch.Generator(device).manual_seed(zlib.crc32(name.encode()) + seed)
            for name, seed in zip(names, seeds, strict=True)
        ]

    def __call__(self, like: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """The next noise of the shape of ``like``."""
        noise = torch.zeros_like(like)
        for i, (stream, frames) in enumerate(zip(self.streams, self.lengths, strict=True)):
            noise[i, :frames] = torch.randn(
                (frames, like.shape[2]), device=like.device, dtype=like.dtype, generator=stream
            )
        return noise


class WindowNoise:
    """Unit Gaussian noise for a window of long speech: in the frames it shares with the one before, that one's noise.

    Args:
        name: of the clip.
        window: which window.
        seeds: one for each take.
        device: where the noise is drawn.
    """

    def __init__(self, name: str, window: Window, seeds: Sequence[int], device: torch.device) -> None:
        self.window = window
        self.streams = [[self._stream(name, seed, window.index, device) for seed in seeds]]
        if window.shared:
            self.streams.insert(0, [self._stream(name, seed, window.index - 1, device) for seed in seeds])

    def __call__(self, like: Float[Tensor, "takes frames width"]) -> Float[Tensor, "takes frames width"]:
        """The next noise of the shape of ``like``."""
        window = self.window
        fresh = self._draw(self.streams[-1], window.fresh, like)[:, : window.frames - window.shared]
        if not window.shared:
            return fresh
        return torch.cat([self._draw(self.streams[0], window.fresh_before, like)[:, -window.shared :], fresh], 1)

    @staticmethod
    def _stream(name: str, seed: int, index: int, device: torch.device) -> torch.Generator:
        return torch.Generator(device).manual_seed(zlib.crc32(f"{name}/{index}".encode()) + seed)

    @staticmethod
    def _draw(streams: Sequence[torch.Generator], frames: int, like: Tensor) -> Tensor:
        # All of a full window's, also for the last one: where speech ends does not change the noise of its frames.
        shape = (frames, like.shape[2])
        return torch.stack([torch.randn(shape, device=like.device, dtype=like.dtype, generator=s) for s in streams])
