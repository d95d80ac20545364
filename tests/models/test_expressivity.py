"""From the mean prediction to a sample: linear on every vertex, in every space, for clips, windows and streams."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import DualPathDiffusion
from facediff.models.folding import FoldedSpace, VertexSpace
from facediff.speech.windows import WindowPlan
from tests.fakes.tiny import VERTICES, Tiny

Ready = Callable[..., DualPathDiffusion]
SPACES = ("folded", "vertices", "components")
PLAN = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)
COMPONENTS = 6


@pytest.fixture
def ready(ready: Ready, tiny: Tiny) -> Ready:
    """A model whose predictions depend on the noise."""

    def make(space: str = "folded", **options: object) -> DualPathDiffusion:
        if space == "components":
            options["motion_space"] = partial(registry.motion_space.components, count=COMPONENTS)
        else:
            options["sampling_space"] = space
        model = ready(**options)
        torch.manual_seed(1)
        if space == "components":
            mean, shapes = tiny.principal_motion(COMPONENTS, torch.ones(3 * VERTICES))
            model.motion_space.components.attach(mean * model.scale, shapes * model.scale, torch.ones(3 * VERTICES))
            model.motion_space.fit(model.process.signal)
        nn.init.normal_(model.network.embed.bias)
        nn.init.normal_(model.network.unembed.weight, std=0.1)
        model.windows = PLAN
        return model

    return make


def speech(seconds: float) -> Tensor:
    return 0.1 * torch.randn(int(seconds * 16000), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("space", SPACES)
def test_expressivity_is_linear_and_zero_has_no_spread(ready: Ready, batch: Batch, space: str) -> None:
    model = ready(space)
    plain = [model.generate(batch, seed=seed) for seed in (1, 2)]
    means = [model.generate(batch, seed=seed, expressivity=0.0) for seed in (1, 2)]
    assert torch.equal(*means)
    spread = (plain[0] - plain[1])[batch.mask].std()
    assert spread > 0.02 * plain[0][batch.mask].std()
    assert torch.equal(model.generate(batch, seed=1, expressivity=1.0), plain[0])
    for expressivity in (0.4, 2.0):
        expected = means[0] + expressivity * (plain[0] - means[0])
        found = model.generate(batch, seed=1, expressivity=expressivity)
        torch.testing.assert_close(found[batch.mask], expected[batch.mask], rtol=0, atol=1e-6)
    assert torch.equal(model.generate(batch, seed=1), plain[0]), "a call's own expressivity ends with the call"


def test_mean_is_the_same_for_a_clip_alone_and_in_a_batch(ready: Ready, tiny: Tiny, batch: Batch) -> None:
    model = ready()
    alone = model.generate(collate([tiny.dataset("train")[0]]), expressivity=0.0)[0]
    torch.testing.assert_close(model.generate(batch, expressivity=0.0)[0, : len(alone)], alone, rtol=0, atol=1e-6)


def test_mean_is_the_average_prediction_from_noise_and_its_negative(
    ready: Ready, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On vertices by hand, and folded with the same noise."""
    start = torch.randn(*batch.motion.shape[:2], 3 * VERTICES, generator=torch.Generator().manual_seed(3))
    model = ready("vertices").double()
    batch.audio, start = batch.audio.double(), start.double()
    batch.reference = batch.reference.double()
    last = torch.full((2,), model.process.steps - 1)
    with torch.no_grad():
        ends = [model.network(sign * start, last, model.conditions(batch)) for sign in (1, -1)]
    expected = (sum(ends) / 2 / model.scale).view_as(batch.motion)
    monkeypatch.setattr(VertexSpace, "noise", lambda space, unit: start)
    monkeypatch.setattr(FoldedSpace, "noise", lambda space, unit: start @ space._embed.weight.T)
    for space in ("vertices", "folded"):
        model.options.sampling_space = space
        found = model.generate(batch, expressivity=0.0)
        torch.testing.assert_close(found[batch.mask], expected[batch.mask], rtol=0, atol=1e-9)
    samples = []
    for space in ("vertices", "folded"):
        model.options.sampling_space = space
        samples.append(model.generate(batch, expressivity=0.3)[batch.mask])
    torch.testing.assert_close(samples[0], samples[1], rtol=0, atol=1e-9)


def test_mean_of_gaussian_motion_is_exact_and_that_of_its_samples(ready: Ready, tiny: Tiny) -> None:
    """With a silent network, sampling in components is that of the corpus's Gaussian."""
    model = ready("components", sampler=partial(registry.sampler.ddim, steps=20))
    nn.init.zeros_(model.network.unembed.weight)
    nn.init.zeros_(model.network.unembed.bias)
    clip = collate([tiny.dataset("val")[0]])
    truth = (model.motion_space.components.mean / model.scale).view(VERTICES, 3)
    found = model.generate(clip, expressivity=0.0)[0]
    torch.testing.assert_close(found, truth.expand_as(found), rtol=0, atol=1e-7)
    samples = model.generate_samples(clip, range(60)).flatten(0, 1)
    error = samples.std(0) / len(samples) ** 0.5
    assert ((samples.mean(0) - truth).abs() < 5 * error + 1e-7).all()


@pytest.mark.parametrize("space", SPACES)
def test_windows_and_streams_are_linear_too(ready: Ready, space: str) -> None:
    model, said = ready(space), speech(3.5)
    made = {e: model.animate_samples(said, identity="A", seeds=[4, 5], expressivity=e) for e in (0.0, 0.5, 1.0)}
    assert torch.equal(made[0.0][0].vertices, made[0.0][1].vertices)
    assert torch.equal(made[1.0][1].vertices, model.animate(said, identity="A", seed=5).vertices)
    for sample, mean, whole in zip(made[0.5], made[0.0], made[1.0], strict=True):
        expected = (mean.vertices + whole.vertices) / 2
        torch.testing.assert_close(sample.vertices, expected, rtol=0, atol=1e-6)
    stream = model.stream(identity="A", seeds=[5], expressivity=0.5)
    model.choose_expressivity(0.1)  # a stream keeps its own
    parts = [stream.feed(said[:20_000])[0], stream.feed(said[20_000:])[0], stream.finish()[0]]
    template = model.assets.templates["A"]
    assert torch.equal(torch.cat(parts) + template, made[0.5][1].vertices)
    assert model.expressivity == 0.1


def test_every_vertex_may_have_its_own_expressivity(ready: Ready, batch: Batch) -> None:
    model = ready()
    mean, whole = (model.generate(batch, seed=1, expressivity=e) for e in (0.0, 1.0))
    shares = torch.linspace(0, 2, VERTICES)
    found = model.generate(batch, seed=1, expressivity=shares)
    expected = mean + shares[:, None] * (whole - mean)
    torch.testing.assert_close(found[batch.mask], expected[batch.mask], rtol=0, atol=1e-6)


def test_what_is_chosen_for_a_while_is_forgotten(ready: Ready) -> None:
    """Earlier choices can be held again, and whatever is chosen meanwhile ends with that."""
    model = ready()
    plain = model.choices()
    model.choose_expressivity(0.3)
    kept = model.choices()
    model.choose_expressivity(0.7)
    sampler, windows = model.sampler, model.windows
    with model.choosing(kept):
        assert model.expressivity == 0.3
        model.choose_sampler("ddpm", 3)
        model.windows = WindowPlan(seconds=2.0)
        assert model.sampler is not sampler
    assert model.expressivity == 0.7
    assert model.sampler is sampler
    assert model.windows is windows
    with model.choosing():
        assert model.expressivity == 0.7
        model.choose_expressivity(0.1)
    assert model.expressivity == 0.7
    with model.choosing(plain):
        assert model.expressivity == 1.0
    assert model.expressivity == 0.7
