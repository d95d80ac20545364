"""A small audio encoder trained from scratch: log-mel spectrogram and convolutions."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.components.audio_encoder.base import SAMPLE_RATE, AudioEncoder
from facediff.components.layers import frame_mask, interpolate_frames
from facediff.registry import audio_encoder


def mel_filters(n_mels: int, n_fft: int, low: float, high: float) -> Float[Tensor, "mels bins"]:
    """Triangular filters equally spaced on the mel scale 2595·log10(1 + f/700) (O'Shaughnessy 1987).

    Each filter is scaled to unit area in Hz, so that a flat spectrum gives a flat result.
    """

    def to_mel(hertz: float) -> float:
        return 2595.0 * math.log10(1.0 + hertz / 700.0)

    mels = torch.linspace(to_mel(low), to_mel(high), n_mels + 2, dtype=torch.float64)
    edges = 700.0 * (10.0 ** (mels / 2595.0) - 1.0)
    bins = torch.arange(n_fft // 2 + 1, dtype=torch.float64) * (SAMPLE_RATE / n_fft)
    rise = (bins[None] - edges[:-2, None]) / (edges[1:-1] - edges[:-2])[:, None]
    fall = (edges[2:, None] - bins[None]) / (edges[2:] - edges[1:-1])[:, None]
    triangles = torch.minimum(rise, fall).clamp_min(0.0)
    return (triangles * (2.0 / (edges[2:] - edges[:-2]))[:, None]).float()


class ConvBlock(nn.Module):
    """Pre-norm residual block: dilated convolution over time, then a position-wise mix."""

    def __init__(self, dim: int, dilation: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.conv = nn.Conv1d(dim, dim, kernel_size=5, dilation=dilation, padding=2 * dilation)
        self.mix = nn.Linear(dim, dim)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``x`` (batch, steps, dim) and ``mask`` (batch, steps, 1), which keeps padding at zero."""
        hidden = self.norm(x) * mask
        hidden = nn.functional.gelu(self.conv(hidden.transpose(1, 2)).transpose(1, 2))
        return (x + self.dropout(self.mix(hidden))) * mask


@audio_encoder.register("mel")
class MelEncoder(AudioEncoder):
    """Log-mel spectrogram and residual dilated convolutions, trained from scratch.

    The default where no pretrained weights are at hand. 100 spectra a second are halved to 50 steps a second by a
    strided convolution and interpolated to the motion's frame rate at the end.

    Args:
        dim: channels of the result; given by the system.
        n_mels: mel bands between 60 Hz and 7 600 Hz.
        hidden_dim: channels of the convolutions.
        num_layers: residual blocks, with dilations 1, 2, 4, 1, 2, 4 …
        dropout: dropout in each block.
    """

    filters: Tensor
    window: Tensor
    n_fft = 512
    hop = 160

    def __init__(
        self, *, dim: int, n_mels: int = 64, hidden_dim: int = 128, num_layers: int = 4, dropout: float = 0.1
    ) -> None:
        super().__init__()
        self.register_buffer("filters", mel_filters(n_mels, self.n_fft, 60.0, 7600.0), persistent=False)
        self.register_buffer("window", torch.hann_window(400), persistent=False)
        self.stem = nn.Conv1d(n_mels, hidden_dim, kernel_size=4, stride=2, padding=1)
        self.blocks = nn.ModuleList(ConvBlock(hidden_dim, 2 ** (i % 3), dropout) for i in range(num_layers))
        self.out = nn.Sequential(nn.LayerNorm(hidden_dim), nn.Linear(hidden_dim, dim))

    def forward(
        self,
        audio: Float[Tensor, "batch samples"],
        audio_lengths: Int[Tensor, " batch"],
        frame_lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Encode; see :class:`AudioEncoder`."""
        spectrum, lengths = self._log_mel(self.standardise(audio, audio_lengths), audio_lengths)
        x = self.stem(spectrum.transpose(1, 2)).transpose(1, 2)
        lengths = (lengths // 2).clamp_min(1)
        mask = frame_mask(lengths, x.shape[1])[..., None].to(x.dtype)
        x = nn.functional.gelu(x) * mask
        for block in self.blocks:
            x = block(x, mask)
        return interpolate_frames(self.out(x), lengths, frame_lengths)

    def _log_mel(self, audio: Tensor, lengths: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised log-mel spectra (batch, steps, mels), zero on padding, and each clip's steps."""
        # Autocast has no complex numbers: the spectrum is always taken in float32.
        with torch.autocast(audio.device.type, enabled=False):
            short = max(0, 2 * self.hop - audio.shape[1])
            padded = nn.functional.pad(audio.float(), (self.n_fft // 2, self.n_fft // 2 + short))
            window = nn.functional.pad(self.window, (56, 56))
            frames = padded.unfold(1, self.n_fft, self.hop) * window
            power = torch.fft.rfft(frames).abs().square()
            spectrum = torch.log(power @ self.filters.T + 1e-5)
        steps = (lengths // self.hop).clamp(min=2)
        mask = frame_mask(steps, spectrum.shape[1])[..., None]
        return (spectrum + 2.0) / 4.0 * mask, steps
