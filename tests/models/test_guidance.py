"""Guidance on speech, identity and style: its formula in every space, and what is hidden in training for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.dual_path.conditioning import Hidden
from facediff.models.folding import FoldedSpace, VertexSpace
from facediff.speech.windows import WindowPlan
from tests.fakes.tiny import Tiny

Ready = Callable[..., DualPathDiffusion]
DROPOUT = {"speech_dropout": 0.2, "identity_dropout": 0.3, "style_dropout": 0.25}
EVERYTHING = ("speech", "identity", "style")


@pytest.fixture
def ready(ready: Ready) -> Ready:
    def make(**options: object) -> DualPathDiffusion:
        model = ready(**{**DROPOUT, "sampler": partial(registry.sampler.ddim, steps=2), **options})
        for learnt in (model.network.no_speech, model.network.no_style):
            if learnt is not None:
                nn.init.normal_(learnt)
        model.windows = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)
        return model

    return make


def hiding(model: DualPathDiffusion, batch: Batch, *names: str) -> Hidden:
    masks = {name: torch.full((len(batch),), name in names) for name in EVERYTHING}
    return Hidden(**masks)


def motion_without(model: DualPathDiffusion, batch: Batch, noisy: Tensor, step: int, *names: str) -> Tensor:
    """G of the formula: the prediction from noisy motion with some conditions hidden."""
    style = model.style_of(batch)
    conditions = model.network.conditions(batch, batch.identity, style, hiding(model, batch, *names))
    return model.network(noisy, torch.full((len(batch),), step), conditions)


@pytest.mark.parametrize(
    ("scales", "shares"),
    [
        ({}, {(): 1.0}),
        ({"style": 1.5}, {(): 1.5, ("style",): -0.5}),
        ({"style": 0.0}, {("style",): 1.0}),
        ({"speech": 0.0, "identity": 0.0, "style": 0.0}, {EVERYTHING: 1.0}),
        ({"speech": 1.5, "identity": 1.5, "style": 1.5}, {(): 1.5, EVERYTHING: -0.5}),
        ({"speech": 1.2, "style": 1.5}, {(): 1.5, ("style",): -0.5, ("identity", "style"): 0.2, EVERYTHING: -0.2}),
    ],
)
def test_guidance_combines_few_predictions(
    ready: Ready, scales: dict[str, float], shares: dict[tuple[str, ...], float]
) -> None:
    model = ready()
    model.choose_guidance(scales)
    found = model.views()
    assert found == pytest.approx(shares)
    assert sum(found.values()) == pytest.approx(1)


@pytest.mark.parametrize("space", [VertexSpace, FoldedSpace])
def test_guided_prediction_is_the_incremental_formula(ready: Ready, batch: Batch, space: type) -> None:
    """G(∅) + w_a [G(a) − G(∅)] + w_i [G(a, i) − G(a)] + w_s [G(a, i, s) − G(a, i)], on vertices."""
    model = ready(sampling_space="vertices" if space is VertexSpace else "folded")
    w_a, w_i, w_s = 1.7, 0.6, 2.5
    noisy = torch.randn(*batch.motion.shape[:2], model.network.coordinates)
    step = 20
    with torch.no_grad():
        nothing, speech, person, everything = (
            motion_without(model, batch, noisy, step, *hidden)
            for hidden in (EVERYTHING, ("identity", "style"), ("style",), ())
        )
        expected = nothing + w_a * (speech - nothing) + w_i * (person - speech) + w_s * (everything - person)
        model.choose_guidance({"speech": w_a, "identity": w_i, "style": w_s})
        made = model.denoiser(model.conditions(batch, guided=True), lambda features: features)
        assert type(made.space) is space
        state = noisy if space is VertexSpace else noisy @ model.network.embed.weight.T
        found = made.motion(made.denoise(state, step))
    assert (speech - nothing)[batch.mask].std() > 1e-3
    assert (everything - person)[batch.mask].std() > 1e-3
    torch.testing.assert_close(found[batch.mask], expected[batch.mask], rtol=0, atol=1e-4)


def test_guidance_on_preconditioned_components_is_the_formula(ready: Ready, tiny: Tiny, batch: Batch) -> None:
    model = ready(motion_space=partial(registry.motion_space.components, count=5))
    space = model.motion_space
    mean, shapes = tiny.principal_motion(5, torch.ones(72))
    space.components.attach(mean * model.scale, shapes * model.scale, torch.ones(72))
    space.fit(model.process.signal)
    nn.init.normal_(model.network.unembed.weight)
    noisy, found = torch.randn(*batch.motion.shape[:2], 5), {}
    with torch.no_grad():
        for scale in (0.0, 1.0, 1.6):
            model.choose_guidance({"style": scale})
            made = model.denoiser(model.conditions(batch, guided=True), lambda features: features)
            found[scale] = made.denoise(noisy, 30)[batch.mask]
    assert (found[1.0] - found[0.0]).std() > 1e-3
    torch.testing.assert_close(found[1.6], found[0.0] + 1.6 * (found[1.0] - found[0.0]), rtol=0, atol=1e-4)


def test_guided_clips_samples_and_streams_agree(ready: Ready, tiny: Tiny, batch: Batch) -> None:
    model = ready(style_guidance=1.8, speech_guidance=1.3)
    alone = model.generate(collate([tiny.dataset("train")[0]]), seed=2)[0]
    torch.testing.assert_close(model.generate(batch, seed=2)[0, : len(alone)], alone, rtol=0, atol=1e-5)
    clip = collate([tiny.dataset("train")[7]])
    several = model.generate_samples(clip, [2, 9])
    for seed, sample in zip((2, 9), several, strict=True):
        torch.testing.assert_close(sample, model.generate(clip, seed=seed)[0], rtol=0, atol=1e-5)
    said = 0.1 * torch.randn(50_000, generator=torch.Generator().manual_seed(0))
    whole = model.animate_samples(said, identity="A", seeds=[2, 9], expressivity=0.7)
    stream = model.stream(identity="A", seeds=[2, 9], expressivity=0.7)
    parts = torch.cat([stream.feed(said), stream.finish()], 1) + model.assets.templates["A"]
    for sample, part in zip(whole, parts, strict=True):
        assert torch.equal(sample.vertices, part)


def test_what_is_hidden_is_not_looked_at(ready: Ready, batch: Batch) -> None:
    model = ready()
    style = model.style_of(batch)
    other = replace(batch, audio=batch.audio.flip(0), identity=batch.identity.flip(0))

    def conditions(of: Batch, style: Tensor, *names: str) -> tuple[Tensor, Tensor]:
        made = model.network.conditions(of, of.identity, style, hiding(model, of, *names))
        return made.audio, made.style

    for name, changed_style in (("speech", style), ("identity", style), ("style", style.flip(0) + 1)):
        changed = replace(batch, audio=other.audio) if name == "speech" else batch
        changed = replace(batch, identity=other.identity) if name == "identity" else changed
        assert any(
            not torch.equal(a, b)
            for a, b in zip(conditions(batch, style), conditions(changed, changed_style), strict=True)
        )
        for a, b in zip(conditions(batch, style, name), conditions(changed, changed_style, name), strict=True):
            torch.testing.assert_close(a, b)


def test_shares_of_hidden_conditions_are_as_chosen(ready: Ready) -> None:
    """Hidden speech takes everything along that may be hidden; identity and style are hidden independently."""
    model = ready()
    torch.manual_seed(0)
    count = 40_000
    speech, identity, style = (each.float() for each in model.hide(count))
    assert not (speech * (1 - identity)).any()
    assert not (speech * (1 - style)).any()
    tolerance = 4 * 0.5 / count**0.5
    assert float(speech.mean()) == pytest.approx(0.2, abs=tolerance)
    heard = speech == 0
    assert float(identity[heard].mean()) == pytest.approx(0.3, abs=2 * tolerance)
    assert float(style[heard].mean()) == pytest.approx(0.25, abs=2 * tolerance)
    assert float((identity * style)[heard].mean()) == pytest.approx(0.3 * 0.25, abs=2 * tolerance)
    assert ready(identity_dropout=0, style_dropout=0).hide(3)[1:] == (None, None)


def test_a_hidden_identity_is_a_strangers(ready: Ready, batch: Batch) -> None:
    model = ready(speech_dropout=0, style_dropout=0)
    model.training = True  # and not its parts, whose dropout would differ
    strangers = replace(batch, identity=torch.full_like(batch.identity, -1))

    def condition(share: float, clips: Batch) -> torch.Tensor:
        model.options.identity_dropout = share
        return model.conditions(clips).style

    torch.testing.assert_close(condition(1.0, batch), condition(0.0, strangers))
    assert not torch.equal(condition(0.0, batch), condition(0.0, strangers))


def test_learnt_stand_ins_get_a_gradient_in_every_step(ready: Ready, batch: Batch) -> None:
    model = ready().train()
    for share in (0.0, 1.0):
        model.options.speech_dropout = model.options.style_dropout = model.options.identity_dropout = max(share, 1e-12)
        model.zero_grad()
        model.losses(batch)["loss"].backward()
        for learnt in (model.network.no_speech, model.network.no_style):
            assert learnt.grad is not None
            assert bool(learnt.grad.any()) == (share == 1.0)


def test_where_no_style_is_given_motion_is_that_of_a_hidden_style(ready: Ready, batch: Batch, tiny: Tiny) -> None:
    """For identities of the training; others have their reference, as all have without ``style_dropout``."""
    model = ready()
    heard = model.default_style("A")
    given = model.conditions(replace(batch, style=heard.vector.expand(len(batch), -1)))
    hidden = model.network.conditions(batch, batch.identity, model.style_of(batch), hiding(model, batch, "style"))
    torch.testing.assert_close(given.style, hidden.style)
    assert not torch.equal(given.style, model.conditions(batch).style)
    stranger = next(name for name in model.assets.references if name not in model.assets.identities)
    assert model.default_style(stranger) is model.assets.references[stranger]
    assert ready(style_dropout=0).default_style("A").clip == tiny.assets().references["A"].clip


def test_guidance_of_the_constructor_needs_the_dropout(make_model: Callable[..., DualPathDiffusion]) -> None:
    with pytest.raises(FaceDiffError, match=r"style=1\.5 needs a model that knows motion without it"):
        make_model(style_guidance=1.5)
    assert make_model(identity_guidance=1.5).guidance["identity"] == 1.5
    assert not make_model(identity_guidance=1.5, identity_dropout=0.2).network.no_style
