"""Speech of any length: windows that are blended in every step, the same for a file and for a microphone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from facediff import registry
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, StyleContentDisentanglement
from facediff.models.inference import SpeechStream, WindowOverlap
from facediff.speech.audio import samples_for
from facediff.speech.windows import SpeechLevel, WindowPlan
from tests.fakes.tiny import SEEN, VERTICES, Tiny

PLAN = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)  # 30, 10, 12 and 5 frames
Ready = Callable[..., AnimationModel]


@pytest.fixture
def ready(ready: Ready, tiny: Tiny) -> Ready:
    def make(name: str = "dual_path", **options: object) -> AnimationModel:
        torch.manual_seed(0)
        if name == "dual_path":
            model = ready(**options)
            torch.nn.init.normal_(model.network.embed.bias)
        else:
            model = StyleContentDisentanglement(
                n_vertices=VERTICES,
                identities=SEEN,
                frame_rate=25.0,
                dim=8,
                content_dim=8,
                audio_encoder=partial(registry.audio_encoder.mel, hidden_dim=8, num_layers=1),
                mesh_encoder=registry.mesh_encoder.linear,
                basis_size=4,
            )
            model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
        if "motion_space" in options:
            model.measure(tiny)
        model.windows = PLAN
        return model.eval()

    return make


def speech(seconds: float, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    loudness = torch.rand(int(seconds * 4) + 2, generator=generator).repeat_interleave(4000)[: int(seconds * 16000)]
    return 0.2 * loudness * torch.randn(int(seconds * 16000), generator=generator)


def pieces(whole: Tensor, seed: int) -> Iterator[Tensor]:
    rng = np.random.default_rng(seed)
    place = 0
    while place < len(whole):
        size = int(rng.integers(1, 30_000)) if seed else 160
        yield whole[place : place + size]
        place += size


SAMPLERS = {
    "ddim": {"steps": 3},
    "ddpm": {"steps": 5},
    "dpm_solver": {"steps": 4},
}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *(("dual_path", {"sampler": partial(getattr(registry.sampler, s), **o)}) for s, o in SAMPLERS.items()),
        ("dual_path", {"sampling_space": "vertices"}),
        ("dual_path", {"style_encoder": registry.style_encoder.none}),
        ("dual_path", {"motion_space": partial(registry.motion_space.components, count=6, prior_frames=7)}),
        ("style_content", {}),
    ],
)
def test_stream_gives_what_the_file_gives(ready: Ready, name: str, options: dict[str, object]) -> None:
    model, whole = ready(name, **options), speech(5.3)
    offline = torch.cat(list(model.stream(identity="A", seeds=[3]).parts(whole)), 1)
    assert offline.shape == (1, round(5.3 * 25), VERTICES, 3)
    assert torch.isfinite(offline).all()
    for seed in (0, 1):
        stream = model.stream(identity="A", seeds=[3])
        parts = [stream.feed(piece) for piece in pieces(whole, seed)]
        assert torch.equal(torch.cat([*parts, stream.finish()], 1), offline)
    vertices = model.animate(whole, identity="A", seed=3).vertices
    assert torch.equal(vertices, offline[0] + model.assets.templates["A"])


def test_stream_gives_a_frame_when_it_is_certain_and_no_later_than_promised(ready: Ready) -> None:
    model, whole = ready(), speech(6)
    stream, given = model.stream(identity="A"), 0
    for sample in range(0, len(whole), 160):
        given += stream.feed(whole[sample : sample + 160]).shape[1]
        heard = (sample + 160) / 16000
        assert given / 25 >= heard - PLAN.look_ahead - 0.011
        assert given == stream.frames
    # What comes later changes nothing of what was given.
    other = model.stream(identity="A")
    again = other.feed(torch.cat([whole, speech(3, seed=9)]))
    first = model.stream(identity="A").feed(whole)
    assert torch.equal(again[:, : first.shape[1]], first)


@pytest.mark.parametrize("frames", [1, 3, 29, 30, 31, 35, 36, 40, 49, 50, 51, 55, 59, 60, 61, 70, 71])
def test_stream_gives_every_frame_whatever_the_length(ready: Ready, frames: int) -> None:
    """Around the ends of windows (every 20 frames), of their overlaps and of what is heard after them."""
    model = ready()
    stream = model.stream(identity="A")
    parts = [stream.feed(speech(samples_for(frames, 25) / 16000)), stream.finish()]
    motion = torch.cat(parts, 1)
    assert motion.shape[1] == frames
    assert torch.isfinite(motion).all()
    assert stream.frames == frames
    for more in (lambda: stream.feed(torch.zeros(5)), stream.finish):
        with pytest.raises(FaceDiffError, match="finished"):
            more()


def test_generate_takes_short_clips_in_one_pass_and_long_ones_by_windows(ready: Ready, tiny: Tiny) -> None:
    model = ready()
    samples = [tiny.dataset("train")[0], tiny.dataset("train")[3]]
    long = samples[1]
    frames = 80
    long = replace(
        long,
        motion=torch.zeros(frames, VERTICES, 3),
        audio=speech(samples_for(frames, 25) / 16000),
    )
    batch = collate([samples[0], long])
    made = model.generate(batch, seed=4)
    alone = model.generate(collate([samples[0]]), seed=4)
    torch.testing.assert_close(made[:1, : alone.shape[1]], alone, rtol=0, atol=1e-5)
    assert not made[0, alone.shape[1] :].any()
    assert torch.equal(alone, model.generate_clips(collate([samples[0]]), seed=4))
    clip = collate([long])
    parts = list(SpeechStream(model, clip, seeds=[4]).parts(clip.audio[0]))
    assert torch.equal(made[1], torch.cat(parts, 1)[0])
    assert not torch.allclose(made[1], model.generate_clips(clip, seed=4)[0], atol=1e-3)


def test_window_overlap_starts_with_the_old_windows_frame_in_every_step(ready: Ready) -> None:
    """Then the new window starts from the very motion that the old one has, and the boundary cannot be seen."""
    model = ready(sampler=partial(registry.sampler.ddpm, steps=6))
    made = []
    generate_clips = model.generate_window

    def watched(*given: object) -> object:
        motion, tail = generate_clips(*given)  # type: ignore[arg-type]
        made.append(motion)
        return motion, tail

    model.generate_window = watched  # type: ignore[method-assign,assignment]
    list(model.stream(identity="A").parts(speech(4)))
    assert len(made) > 3
    size = made[0].std()
    for old, new in zip(made, made[1:], strict=False):
        torch.testing.assert_close(new[:, 0], old[:, 20], rtol=0, atol=1e-5)
        # And the last one is almost its own.
        assert (new[:, 9] - old[:, 29]).abs().mean() > 0.01 * size


def test_window_overlap_blends_each_step_with_its_own() -> None:
    before = [torch.randn(2, 4, 3) for _ in range(2)]
    overlap_blend = WindowOverlap(before, kept=slice(5, 7))
    for step in range(2):
        now = torch.randn(2, 7, 3)
        blended = overlap_blend(now)
        share = np.array([0, 5 / 32, 0.5, 27 / 32])[None, :, None]  # smoothstep of 0, ¼, ½, ¾
        expected = (1 - share) * before[step].numpy() + share * now[:, :4].numpy()
        np.testing.assert_allclose(blended[:, :4].numpy(), expected, atol=1e-6)
        assert torch.equal(blended[:, 4:], now[:, 4:])
        assert torch.equal(overlap_blend.features[step], blended[:, -2:])


def test_samples_are_what_their_seeds_give_and_the_speech_is_encoded_once(ready: Ready) -> None:
    model = ready(sampler=partial(registry.sampler.ddpm, steps=5))
    heard = []
    encoder = model.speech_encoder
    encoder.register_forward_hook(lambda *_: heard.append(1))
    for seconds in (1.5, 4.0):
        heard.clear()
        samples = model.animate_samples(speech(seconds), identity="B", seeds=[7, 8, 9])
        once = len(heard)
        single = [model.animate(speech(seconds), identity="B", seed=seed) for seed in (7, 8, 9)]
        assert len(heard) == 4 * once
        for sample, alone in zip(samples, single, strict=True):
            torch.testing.assert_close(sample.vertices, alone.vertices, rtol=0, atol=1e-5)
        assert (samples[0].vertices - samples[1].vertices).abs().max() > 1e-4


def test_level_is_that_of_all_that_was_heard() -> None:
    level, whole = SpeechLevel(), speech(2).double() + 0.1
    for piece in pieces(whole, 5):
        level.add(piece)
    assert level.count == len(whole)
    np.testing.assert_allclose(level.mean, whole.numpy().mean(), rtol=1e-9)
    np.testing.assert_allclose(level.deviation, whole.numpy().std(), rtol=1e-9)


def test_audio_encoder_hears_a_piece_as_loud_as_in_the_whole(ready: Ready) -> None:
    encoder = ready().speech_encoder
    whole = speech(3)
    length = torch.tensor([16000])
    mean, deviation = float(whole.mean()), float(whole.std(unbiased=False))
    with encoder.at_level(mean, deviation):
        piece = encoder.standardise(whole[None, :16000], length)
        louder = encoder(3 * whole[None, :16000], length, torch.tensor([25]))
    torch.testing.assert_close(piece[0], ((whole - mean) / deviation)[:16000])
    with encoder.at_level(3 * mean, 3 * deviation):
        nine = encoder(9 * whole[None, :16000], length, torch.tensor([25]))
    torch.testing.assert_close(nine, louder, rtol=1e-3, atol=1e-3)
    assert encoder._level is None
