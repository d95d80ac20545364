"""The random numbers of PyTorch's processor, without PyTorch: equal seeds give the motion that the model gives."""

from __future__ import annotations

import zlib
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from facediff.speech.windows import MotionWindow

Noise = npt.NDArray[np.float32]

BLOCK = 16
"""PyTorch makes 16 normal numbers of 16 uniform ones: 8 radii and 8 angles."""


class NormalStream:
    """Unit Gaussian numbers as ``torch.randn`` draws them on a processor.

    Args:
        seed: of ``torch.Generator().manual_seed``.

    Example:
        >>> NormalStream(0).draw((16,))[:2].round(4)
        array([-1.1258, -1.1524], dtype=float32)
    """

    def __init__(self, seed: int) -> None:
        # The same Mersenne twister, seeded by its authors' first rule, as in PyTorch, which takes the lower 32 bits of
        # a larger seed.
        self._bits = np.random.MT19937()
        self._bits._legacy_seeding(seed & 0xFFFFFFFF)

    def draw(self, shape: tuple[int, ...]) -> Noise:
        """The next numbers, 16 at least."""
        count = int(np.prod(shape))
        if count < BLOCK:
            raise ValueError(f"{count} numbers: PyTorch draws fewer than {BLOCK} by another rule")
        normal = np.empty(count, np.float32)
        even_count = count - count % BLOCK
        uniform = self._uniform(count)
        normal[:even_count] = box_muller(uniform[:even_count])
        if even_count < count:
            # A rest is not drawn by itself: the last 16 numbers are drawn again.
            normal[-BLOCK:] = box_muller(self._uniform(BLOCK))
        return normal.reshape(shape)

    def __call__(self, frames: int, width: int) -> Noise:
        """The next noise (1, frames, width) of a clip."""
        return self.draw((frames, width))[None]

    def _uniform(self, count: int) -> Noise:
        raw = self._bits.random_raw(count)
        return (raw & 0xFFFFFF).astype(np.float32) * np.float32(2.0**-24)


def box_muller(uniform: Noise) -> Noise:
    """Normal numbers of uniform ones in [0, 1), by blocks of 16 (Box and Muller 1958)."""
    blocks = uniform.reshape(-1, 2, BLOCK // 2)
    radius = np.sqrt(-2 * np.log(1 - blocks[:, 0]))
    angle = np.float32(2 * np.pi) * blocks[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1).reshape(-1)


def stream_of(name: str, seed: int) -> NormalStream:
    """The stream of random numbers for a name and a seed, as :func:`facediff.models.inference.noise_stream`.

    Its noise of a clip is that of :class:`facediff.models.inference.ClipNoise`.
    """
    return NormalStream(zlib.crc32(name.encode()) + seed)


class NumpyWindowNoise:
    """Unit noise of a window of long speech, as :class:`facediff.models.inference.WindowNoise` draws it."""

    def __init__(self, name: str, window: MotionWindow, seed: int) -> None:
        self.name, self.window, self.seed = name, window, seed
        self._streams: dict[int, NormalStream] = {}
        self._drawn = False

    def __call__(self, frames: int, width: int) -> Noise:
        """The next noise (1, frames, width); ``frames`` of the window."""
        unit = np.concatenate([self._draw(index, width)[new] for index, new in self.window.origins])
        self._drawn = True
        return unit[None]

    def _draw(self, index: int, width: int) -> Noise:
        plan, name = self.window.plan, f"{self.name}/{index}"
        shape = (plan.hop if index else plan.frames, width)
        if not self._drawn:
            return first_draw(name, self.seed, shape)
        if index not in self._streams:
            self._streams[index] = stream_of(name, self.seed)
            self._streams[index].draw(shape)  # the numbers of the first call
        return self._streams[index].draw(shape)


@lru_cache(maxsize=128)
def first_draw(name: str, seed: int, shape: tuple[int, int]) -> Noise:
    """The first numbers of a stream.

    Windows of low latency see the noise of some thirty windows before them again, and most samplers draw only once.
    """
    return stream_of(name, seed).draw(shape)
