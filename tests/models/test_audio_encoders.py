"""The log-mel encoder: its filters, its independence of loudness, and that sound and frame keep time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from facediff.models.audio_encoders import MelEncoder

RATE = 16_000


@pytest.fixture
def encoder() -> MelEncoder:
    torch.manual_seed(0)
    return MelEncoder(dim=8, hidden_dim=16, num_layers=0).eval()


@pytest.mark.parametrize("frames", [20, 25])
def test_mel_feature_of_a_frame_is_of_its_own_time(encoder: MelEncoder, frames: int) -> None:
    """Where in the sound the gradient of a frame's feature lies, also at another frame rate."""
    torch.manual_seed(1)
    audio = torch.randn(1, RATE, requires_grad=True)
    for frame in (4, 10, 15):
        out = encoder(audio, torch.tensor([RATE]), torch.tensor([frames]))
        (gradient,) = torch.autograd.grad(out[0, frame].square().sum(), audio)
        weight = gradient[0].square()
        centre = float((weight * torch.arange(RATE)).sum() / weight.sum()) / RATE
        assert centre == pytest.approx((frame + 0.5) / frames, abs=0.012)


def test_mel_feature_does_not_depend_on_loudness_and_offset(encoder: MelEncoder) -> None:
    audio, lengths, frames = torch.randn(1, 9600), torch.tensor([9600]), torch.tensor([15])
    expected = encoder(audio, lengths, frames)
    for other in (30 * audio, 0.02 * audio, audio + 2):
        torch.testing.assert_close(encoder(other, lengths, frames), expected, rtol=0, atol=2e-4)


def test_mel_feature_of_silence_and_short_speech_is_finite(encoder: MelEncoder) -> None:
    for samples in (1600, 100, 1):
        out = encoder(torch.zeros(1, samples), torch.tensor([samples]), torch.tensor([3]))
        assert out.shape == (1, 3, 8)
        assert torch.isfinite(out).all()


@pytest.mark.parametrize("samples", [1, 159, 160, 161, 319, 320, 321, 479, 480, 2000])
def test_mel_spectra_are_their_formula_also_of_short_speech(encoder: MelEncoder, samples: int) -> None:
    """Spectrum k is centred on sample 160 k, there are two at least, and padding beyond a clip's own is zero."""
    wave = torch.randn(samples, generator=torch.Generator().manual_seed(samples))
    steps = max(2, samples // 160)
    zeros = np.zeros(256 + 160 * steps + 512)
    zeros[256 : 256 + samples] = wave.double().numpy()
    window = np.pad(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(400) / 400), 56)
    power = np.stack([np.abs(np.fft.rfft(zeros[160 * k : 160 * k + 512] * window)) ** 2 for k in range(steps)])
    expected = (np.log(power @ encoder.filters.double().numpy().T + 1e-5) + 2) / 4
    alone, counted = encoder._log_mel(wave[None], torch.tensor([samples]))
    padded, _ = encoder._log_mel(torch.nn.functional.pad(wave, (0, 999))[None], torch.tensor([samples]))
    assert counted.tolist() == [steps]
    for found in (alone, padded):
        np.testing.assert_allclose(found[0, :steps].numpy(), expected, rtol=1e-4, atol=1e-4)
        assert not found[0, steps:].any()
