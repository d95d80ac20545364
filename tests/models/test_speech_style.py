"""What speech says of the style: the regression against NumPy, its bounds, and what a model makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.data import Batch
from facediff.models import DualPathDiffusion
from facediff.models.adaptation import with_extra_identities
from facediff.models.dual_path.graphs import StepGraph
from facediff.models.dual_path.speech_style import MEMORY, REACH, RIDGE, SpeechStyle
from facediff.speech.windows import WindowPlan
from tests.fakes.tiny import Tiny

DIM, STYLE, FRAMES = 3, 2, 40


def clips(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features whose loudest channel tells the style, of two identities with styles of their own."""
    random = torch.Generator().manual_seed(seed)
    mood = torch.randn(count, generator=random)
    identity = torch.arange(count) % 2
    features = torch.randn(count, FRAMES, DIM, generator=random) + mood[:, None, None] * torch.tensor([2.0, 0, 0])
    usual = torch.tensor([[5.0, -1.0], [-3.0, 4.0]])
    style = usual[identity] + mood[:, None] * torch.tensor([0.7, -0.2])
    return features, torch.ones(count, FRAMES, dtype=torch.bool), style, identity


@pytest.fixture
def fitted() -> SpeechStyle:
    module = SpeechStyle(DIM, STYLE, 3)
    features, mask, style, identity = clips(400)
    for start in range(0, 400, 8):
        part = slice(start, start + 8)
        module.update(features[part], mask[part], style[part], identity[part])
    return module


def test_map_is_the_weighted_ridge_regression(fitted: SpeechStyle) -> None:
    features, _, style, identity = (value.numpy().astype(float) for value in clips(400))
    numbers = np.concatenate([features.mean(1), np.sqrt(features.var(1) + 1e-4)], 1)
    weight = np.repeat(MEMORY ** np.arange(49, -1, -1), 8)
    usual, seen, deviations = np.zeros((2, STYLE)), np.zeros(2), []
    for start in range(0, 400, 8):
        for clip in range(start, start + 8):
            speaker = int(identity[clip])
            seen[speaker] += 1
            usual[speaker] += (style[clip] - usual[speaker]) * max(1 / seen[speaker], 1 - MEMORY**8)
        deviations += [style[clip] - usual[int(identity[clip])] for clip in range(start, start + 8)]
    mean = np.average(numbers, 0, weight)
    spread = np.sqrt(np.average((numbers - mean) ** 2, 0, weight))
    standard = (numbers - mean) / spread
    gram = (standard * weight[:, None]).T @ standard / weight.sum() + RIDGE * np.eye(2 * DIM)
    expected = np.linalg.solve(gram, (standard * weight[:, None]).T @ np.array(deviations) / weight.sum())
    probe, mask, _, _ = clips(30, seed=1)
    at = np.concatenate([probe.numpy().mean(1), np.sqrt(probe.numpy().var(1) + 1e-4)], 1)
    usual_size = np.abs((at - mean) / spread).max(1) < 2  # within the bounds, which are tested below
    np.testing.assert_allclose(
        fitted(probe, mask).numpy()[usual_size], (((at - mean) / spread) @ expected)[usual_size], rtol=2e-3, atol=2e-4
    )
    assert usual_size.sum() > 10


def test_planted_mood_is_read_from_speech_that_was_never_heard(fitted: SpeechStyle) -> None:
    features, mask, style, identity = clips(200, seed=2)
    usual = torch.stack([fitted.usual(int(speaker)) for speaker in identity])
    left = (style - usual - fitted(features, mask)).square().mean()
    assert left < 0.1 * (style - usual).square().mean()
    assert fitted.usual(2) is None  # no clip of the third identity


def test_padding_changes_nothing(fitted: SpeechStyle) -> None:
    features, mask, _, _ = clips(2, seed=3)
    padded = torch.cat([features, torch.full_like(features, 7.0)], 1)
    torch.testing.assert_close(fitted(padded, torch.cat([mask, ~mask], 1)), fitted(features, mask))


def test_strange_speech_asks_for_no_more_than_training_speech_did(fitted: SpeechStyle) -> None:
    usual = fitted(*clips(400)[:2]).square().sum(1).mean().sqrt()
    change = fitted(torch.full((1, FRAMES, DIM), 1e4), torch.ones(1, FRAMES, dtype=torch.bool)).norm()
    assert change <= 1.1 * REACH * usual


def test_statistics_count_up_to_three_deviations(fitted: SpeechStyle) -> None:
    """By themselves, so that one strange number, such as a room's, does not decide the direction."""
    features, mask, _, _ = clips(1, seed=5)
    mean, deviation, *_ = fitted._fit()
    for statistic in (1, 2):  # those that hardly tell the style, so that its longest change is not reached
        asked = []
        for far in (2.9, 3.0, 9.0):
            moved = features.clone()
            moved[..., statistic] += mean[statistic] + far * deviation[statistic] - moved[..., statistic].mean()
            asked.append(fitted(moved, mask))
        torch.testing.assert_close(asked[1], asked[2], rtol=1e-4, atol=1e-6)
        assert not torch.allclose(asked[0], asked[1], rtol=1e-4, atol=1e-6)


def test_hidden_identities_are_left_out(fitted: SpeechStyle) -> None:
    before = {name: value.clone() for name, value in fitted.named_buffers()}
    features, mask, style, _ = clips(4, seed=4)
    fitted.update(features, mask, style, torch.full((4,), -1))
    torch.testing.assert_close(fitted.styles, before["styles"])
    torch.testing.assert_close(fitted.counts, before["counts"])


def test_the_usual_style_of_a_further_identity_is_of_its_own_clips(
    make_model: Callable[..., DualPathDiffusion], tiny: Tiny
) -> None:
    model = make_model(style_from_speech=True)
    model.adopt(tiny.assets().with_motion_scale(1.0))
    model.network.speech_style.counts.fill_(1e6)
    grown = with_extra_identities(model, ["C", *model.identities])
    assert isinstance(grown, DualPathDiffusion)
    speech = grown.network.speech_style
    assert speech.usual(0) is None
    style = torch.randn(1, speech.styles.shape[1])
    speech.update(torch.randn(1, FRAMES, 16), torch.ones(1, FRAMES, dtype=torch.bool), style, torch.tensor([0]))
    torch.testing.assert_close(speech.usual(0), style[0])


@pytest.fixture
def model(ready: Callable[..., DualPathDiffusion], batch: Batch) -> DualPathDiffusion:
    """A model that has trained, without an optimiser, on a few batches."""
    options = {"style_from_speech": True, "identity_dropout": 0.0, "sampler": partial(registry.sampler.ddim, steps=2)}
    model = ready(**options).train()
    for _ in range(3):
        model.losses(batch)
    return model.eval()


def test_training_is_that_of_a_model_without_it(
    make_model: Callable[..., DualPathDiffusion], model: DualPathDiffusion, batch: Batch
) -> None:
    other = make_model(identity_dropout=0.0)
    other.adopt(model.assets)
    losses = []
    for each in (model, other):
        torch.manual_seed(1)
        losses.append(each.train().losses(batch, torch.Generator().manual_seed(0))["loss"])
    torch.testing.assert_close(losses[0], losses[1], rtol=0, atol=0)


def test_default_style_depends_on_the_speech_and_a_given_one_does_not(model: DualPathDiffusion, batch: Batch) -> None:
    asked = model.default_style("A").vector.expand(len(batch), -1)
    given = torch.cat([asked[:, :-1], torch.zeros(len(batch), 1)], 1)

    def tokens(style: torch.Tensor, audio: torch.Tensor) -> torch.Tensor:
        return model.conditions(replace(batch, audio=audio, style=style)).style

    with torch.no_grad():
        torch.testing.assert_close(tokens(given, batch.audio), tokens(given, batch.audio.flip(1)))
        assert not torch.allclose(tokens(asked, batch.audio), tokens(asked, batch.audio.flip(1)))


def test_each_clip_is_asked_by_its_own_share_and_of_the_animated_frames_alone(
    model: DualPathDiffusion, batch: Batch
) -> None:
    """A stream encodes speech before a window that it does not animate: other speech there changes no style."""
    network, size = model.network, 640
    style = model.default_style("A").vector.expand(len(batch), -1).clone()
    style[:, -1] = torch.tensor([0.0, 0.5])
    frames = int(batch.frame_lengths.min())
    audio = torch.randn(len(batch), frames * size, generator=torch.Generator().manual_seed(5))
    clips = replace(batch.select([0, 1]), audio=audio, audio_lengths=torch.full((2,), frames * size), style=style)
    clips = replace(clips, motion=batch.motion[:, :frames], frame_lengths=torch.full((2,), frames))
    with torch.no_grad():
        features = network.audio_encoder(clips.audio, clips.audio_lengths, clips.frame_lengths)
        for animated in (slice(None), slice(4, frames)):
            asked = features[:, animated]
            change = network.speech_style(asked, torch.ones(asked.shape[:2], dtype=torch.bool))
            found = model.conditions(clips, animated=animated).dynamic
            torch.testing.assert_close(found, style[:, :-1] + style[:, -1:] * change)
        assert torch.equal(found[0], style[0, :-1])
        assert not torch.allclose(found[1], style[1, :-1])


def test_style_of_another_identity_starts_from_its_reference(model: DualPathDiffusion) -> None:
    stranger = next(name for name in model.assets.references if name not in model.assets.identities)
    style, reference = model.default_style(stranger), model.assets.references[stranger]
    assert style.vector[-1] == 1
    encoded = model.encode_style(reference.motion.float()[None], torch.ones(1, len(reference.motion), dtype=torch.bool))
    torch.testing.assert_close(style.vector[:-1], encoded[0, :-1])
    assert encoded[0, -1] == 0


def test_step_of_the_graph_hears_the_same(model: DualPathDiffusion, batch: Batch) -> None:
    style = model.default_style("A").vector.expand(len(batch), -1)
    with torch.no_grad():
        conditions = model.conditions(replace(batch, style=style))
        state = torch.randn(*conditions.mask.shape, 16)
        arguments = (conditions.audio, conditions.mask, batch.identity, style, state, torch.full((2,), 3))
        predicted, _ = StepGraph(model)(*arguments, torch.zeros_like(state), torch.ones(conditions.mask.shape))
        expected = model.denoiser(conditions, lambda now: now).denoise(state, torch.full((2,), 3))
    torch.testing.assert_close(predicted, expected)


def test_fitting_again_takes_each_clips_own_style_once(model: DualPathDiffusion, tiny: Tiny) -> None:
    changed = model.fit_to_features(tiny)
    dataset = tiny.dataset("train")
    assert {name: bool(value.any()) for name, value in changed.items()}["network.speech_style.squares"]
    assert float(changed["network.speech_style.squares"][-1, -1]) == len(dataset)
    own = [sample for sample in dataset if sample.identity == 0]
    vectors = [model.encode_style(s.motion[None], torch.ones(1, len(s.motion), dtype=torch.bool))[0, :-1] for s in own]
    torch.testing.assert_close(changed["network.speech_style.styles"][0], torch.stack(vectors).mean(0))
    assert model.fit_to_features(tiny).keys() <= model.state_dict().keys()


def test_stream_equals_the_file(model: DualPathDiffusion) -> None:
    model.windows = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)
    speech = 0.1 * torch.randn(50_000, generator=torch.Generator().manual_seed(0))
    stream = model.stream(identity="A", seeds=[2])
    parts = torch.cat([stream.feed(speech), stream.finish()], 1) + model.assets.templates["A"]
    assert torch.equal(model.animate(speech, identity="A", seed=2).vertices, parts[0])
