"""Onsets by their documented definition, and what a head that nods with them has beyond `further_cases`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from facediff.metrics import head_beat_alignment, onsets

RATE, FPS = 16_000, 25


def clicks(times: list[float], seconds: float = 4.0) -> torch.Tensor:
    """Bursts of noise of 50 ms on a quiet ground."""
    random = torch.Generator().manual_seed(0)
    sound = 1e-4 * torch.randn(round(seconds * RATE), generator=random)
    for time in times:
        start = round(time * RATE)
        sound[start : start + 800] += torch.randn(800, generator=random)
    return sound


@pytest.mark.parametrize("rate", [16_000, 22_050])
def test_onsets_are_the_documented_peaks_of_spectral_flux(rate: int) -> None:
    """Windows of 32 ms every 10 ms, log(1 + 100 |X|); largest within 30 ms, 0.07 above the mean of 100 ms around."""
    rng = np.random.default_rng(0)
    sound = rng.standard_normal(12 * rate) * np.repeat(10.0 ** rng.uniform(-3, 0, 300), rate // 25)[: 12 * rate]
    size, hop = round(0.032 * rate), round(0.01 * rate)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)
    padded = np.pad(sound / np.abs(sound).max(), size // 2)
    frames = np.lib.stride_tricks.sliding_window_view(padded, size)[::hop]
    loud = np.log(1 + 100 * np.abs(np.fft.rfft(frames * window)) / window.sum())
    flux = np.append(0, np.maximum(np.diff(loud, axis=0), 0).mean(1))
    flux /= flux.max()
    expected = [
        n * hop / rate
        for n, rise in enumerate(flux)
        if rise == flux[max(0, n - 3) : n + 4].max() and rise > flux[max(0, n - 10) : n + 11].mean() + 0.07
    ]
    assert len(expected) > 50
    assert onsets(torch.from_numpy(sound), rate).tolist() == pytest.approx(expected, abs=1e-9)


def test_a_still_head_and_silence() -> None:
    still, head = torch.zeros(100, 1, 1), torch.randn(100, 1, 1, generator=torch.Generator().manual_seed(0))
    assert head_beat_alignment(still, head, waveform=clicks([0.6, 1.4]), frames_per_second=FPS).item() == 0
    assert not len(onsets(torch.zeros(RATE), RATE))
    assert not len(onsets(torch.zeros(0), RATE))
    with pytest.raises(ValueError, match="onset"):
        head_beat_alignment(head, head, waveform=torch.zeros(64_000), frames_per_second=FPS)
    with pytest.raises(ValueError, match="frames_per_second"):
        head_beat_alignment(head, head, waveform=torch.zeros(64_000))


def test_speed_need_not_be_smoothed_and_sound_has_16_khz_unless_it_is_said() -> None:
    head, sound = torch.randn(100, 1, 1, generator=torch.Generator().manual_seed(1)), clicks([0.6, 2.1])
    options = {"waveform": sound, "frames_per_second": FPS, "smoothing": 0.0}
    # Onset by onset the nearest minimum of the speed, which is that between two frames.
    speed = head.flatten().diff().abs().tolist()
    rests = [i + 0.5 for i in range(1, len(speed) - 1) if speed[i] < speed[i - 1] and speed[i] <= speed[i + 1]]
    beats = [min(abs(rest - time * FPS) for rest in rests) for time in onsets(sound, RATE).tolist()]
    expected = sum(math.exp(-(away**2) / 18) for away in beats) / len(beats)
    assert head_beat_alignment(head, head, **options).item() == pytest.approx(expected, abs=1e-6)
    assert head_beat_alignment(head, head, **options) == head_beat_alignment(head, head, sample_rate=RATE, **options)
    assert head_beat_alignment(head, head, **options) != head_beat_alignment(head, head, sample_rate=15_000, **options)
