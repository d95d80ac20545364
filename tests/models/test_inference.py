"""Long speech window by window against a loop in NumPy, with a model that says what it heard; and its noise."""

from __future__ import annotations

import zlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from facediff.data import Batch, Sample, collate
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.inference import ClipNoise, Inference, SpeechStream, WindowNoise
from facediff.speech.windows import FramePlan, MotionWindow, WindowPlan

PLAN = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)  # 30, 10, 12 and 5 frames
FRAMES, SHARED = 30, 10
CPU = torch.device("cpu")
Array = np.ndarray


class Ear(AudioEncoder):
    """Hears nothing by itself; it knows how loud a stream is."""

    def forward(self, audio: Tensor, audio_lengths: Tensor, frame_lengths: Tensor) -> Tensor:
        raise NotImplementedError


class Echo(Inference, torch.nn.Module):
    """The motion of a frame is the mean of its standardised speech, and where in the heard speech it lies."""

    frame_rate = 25.0
    windows = PLAN
    device = CPU
    speech_encoder = Ear()
    assets: Any = SimpleNamespace()

    def encode_style(self, reference: Tensor, mask: Tensor) -> Tensor:
        return reference.new_zeros(len(reference), 2)

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: object = None) -> Tensor:
        frames = batch.motion.shape[1]
        assert batch.frame_lengths.tolist() == [frames]
        assert batch.audio_lengths.tolist() == [batch.audio.shape[1]]
        heard = self.speech_encoder.standardise(batch.audio, batch.audio_lengths)[0]
        values = heard.view(frames, 640).mean(1) + 0.1 * torch.arange(frames) + 0.003 * frames
        return values.view(1, frames, 1, 1).expand(1, frames, 2, 3)


def clip() -> Batch:
    face = torch.zeros(2, 3)
    sample = Sample(torch.zeros(640), torch.zeros(1, 2, 3), face, 0, torch.zeros(3, 2, 3), "a", "A", "", "a")
    return collate([sample])


def expected(speech: Array, total: int, plan: FramePlan) -> Array:
    """The motion of :class:`Echo` by hand: what each window hears, and the blend of the frames that may change."""
    out: list[float] = []
    held: Array | None = None
    while True:
        new = len(out)  # given out so far, where the window's own frames begin
        left = total - new
        if held is not None and left <= plan.overlap:
            return np.concatenate([out, held[:left]])
        count = min(left, plan.frames)
        start = max(0, new - plan.past)
        context = min(plan.before, start)
        known = (
            speech[: min(total, new + plan.frames + plan.after) * 640] if left > plan.frames else speech[: total * 640]
        )
        scaled = (known - known.mean()) / max(known.std(), 0.003)
        values = scaled[(start - context) * 640 :].reshape(-1, 640).mean(1)
        values = (values + 0.1 * np.arange(len(values)) + 0.003 * len(values))[context + new - start :][:count]
        if held is not None:
            share = np.arange(plan.overlap) / max(1, plan.overlap)
            share = 3 * share**2 - 2 * share**3
            values[: plan.overlap] = (1 - share) * held + share * values[: plan.overlap]
        if left <= plan.frames:
            return np.concatenate([out, values])
        out += values[: plan.hop].tolist()
        held = values[plan.hop :]


@pytest.mark.parametrize("frames", [3, 29, 30, 31, 35, 49, 50, 51, 60, 61, 83, 120])
@pytest.mark.parametrize("loudness", [0.2, 0.0005], ids=["speech", "pause"])
def test_long_speech_is_the_loop_over_windows(frames: int, loudness: float) -> None:
    random = np.random.default_rng(frames)
    # Not cut at a frame's end, of another mean, and louder towards the end.
    speech = loudness * (0.5 + random.standard_normal(frames * 640 + 200) * np.linspace(0.5, 2, frames * 640 + 200))
    stream, place, parts = SpeechStream(Echo(), clip(), seeds=[0, 1]), 0, []
    for size in (100, 19_000, 641, 7_000, 10**6):
        parts.append(stream.feed(torch.from_numpy(speech[place : place + size]).float()))
        place += size
    made = torch.cat([*parts, stream.finish()], 1)
    assert made.shape == (2, frames, 2, 3)
    assert stream.frames == frames
    wanted = np.broadcast_to(expected(speech, frames, PLAN.in_frames(25.0))[None, :, None, None], made.shape)
    np.testing.assert_allclose(made.numpy(), wanted, rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize(("samples", "seconds"), [(30 * 640, 2), (32_000, 2), (32_001, 3), (640, 1)])
def test_long_speech_is_heard_by_the_second(samples: int, seconds: int) -> None:
    """A recording is fed as from a microphone, second by second, which is what progress counts."""
    speech, counted, heard = torch.randn(samples), [], []
    stream = SpeechStream(Echo(), clip())
    feed = stream.feed
    stream.feed = lambda some: (heard.append(len(some)), feed(some))[1]  # type: ignore[method-assign, func-returns-value]

    def progress(places: Any) -> Any:  # noqa: ANN401
        counted.extend(places)
        return places

    made = torch.cat(list(stream.parts(speech, progress=progress)), 1)
    assert made.shape[1] == round(samples / 640)
    assert counted == list(range(seconds))
    assert heard == [min(16_000, samples - 16_000 * second) for second in range(seconds)]


def test_clip_noise_is_unit_gaussian_by_name_and_seed() -> None:
    like = torch.empty(3, 200, 50)
    noise = ClipNoise(["a", "b", "a"], [200, 150, 200], [0, 0, 1], CPU)
    first, second = noise(like), noise(like)
    for made in (first, second):
        assert float(made[1, 150:].abs().max()) == 0
        flat = torch.stack([made[0, :150], made[1, :150], made[2, :150]]).flatten(1).double()
        assert float(flat.mean(1).abs().max()) < 5 / 7500**0.5
        assert float((torch.cov(flat) - torch.eye(3)).abs().max()) < 5 * (2 / 7500) ** 0.5
    assert not torch.equal(first, second)
    # A clip's noise is the same alone, and the same on every machine of this kind.
    assert torch.equal(ClipNoise(["b"], [150], [0], CPU)(torch.empty(1, 150, 50))[0], first[1, :150])
    stream = torch.Generator().manual_seed(zlib.crc32(b"a") + 1)
    assert torch.equal(torch.randn(200, 50, generator=stream), first[2])


def test_window_noise_continues_that_of_the_window_before() -> None:
    plan, like = PLAN.in_frames(25.0), torch.empty(2, FRAMES, 400)
    made = []
    for index in range(4):
        noise = WindowNoise("a", MotionWindow(plan, index, FRAMES), [5, 6], CPU)
        made.append([noise(like) for _ in range(3)])
    for old, new in zip(made, made[1:], strict=False):
        for step in range(3):
            assert torch.equal(old[step][:, -SHARED:], new[step][:, :SHARED])
    # Frames of the speech, steps and seeds are independent, and of unit variance.
    for step in range(3):
        whole = torch.cat([made[0][step], *(window[step][:, SHARED:] for window in made[1:])], 1)
        assert whole.shape == (2, 90, 400)
        flat = torch.cat([*whole, *made[0][(step + 1) % 3]]).double()
        assert float((flat @ flat.T / 400 - torch.eye(len(flat))).abs().max()) < 6.5 * (2 / 400) ** 0.5
    # Where the speech ends does not matter to what comes before.
    for index in (0, 2):
        short = WindowNoise("a", MotionWindow(plan, index, 17), [5, 6], CPU)(torch.empty(2, 17, 400))
        assert torch.equal(short, made[index][0][:, :17])
    assert not torch.equal(WindowNoise("b", MotionWindow(plan, 0, FRAMES), [5, 6], CPU)(like), made[0][0])
