"""Identity and style, hidden now and then in training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from facediff.data import Batch
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny

Ready = Callable[..., DualPathDiffusion]


@pytest.fixture
def ready(ready: Ready) -> Ready:
    def make(**options: object) -> DualPathDiffusion:
        model = ready(**{"identity_dropout": 0.3, "style_dropout": 0.25, **options})
        if model.network.no_style is not None:
            nn.init.normal_(model.network.no_style)
        return model

    return make


def tokens(model: DualPathDiffusion, batch: Batch, style: Tensor, *, hidden: bool) -> Tensor:
    mask = torch.full((len(batch),), hidden)
    return model.network.conditions(batch, batch.identity, style, mask).style


def test_a_hidden_style_is_not_looked_at(ready: Ready, batch: Batch) -> None:
    model = ready()
    style = model.style_of(batch)
    before, after = ([tokens(model, batch, s, hidden=hidden) for s in (style, style + 1)] for hidden in (False, True))
    assert not torch.equal(*before)
    torch.testing.assert_close(*after)


def test_shares_of_hidden_conditions_are_as_chosen(ready: Ready) -> None:
    """Identity and style are hidden independently."""
    torch.manual_seed(0)
    count = 40_000
    identity, style = (each.float() for each in ready().hide(count) if each is not None)
    tolerance = 4 * 0.5 / count**0.5
    assert float(identity.mean()) == pytest.approx(0.3, abs=tolerance)
    assert float(style.mean()) == pytest.approx(0.25, abs=tolerance)
    assert float((identity * style).mean()) == pytest.approx(0.3 * 0.25, abs=tolerance)
    assert ready(identity_dropout=0, style_dropout=0).hide(3) == [None, None]


def test_a_hidden_identity_is_a_strangers(ready: Ready, batch: Batch) -> None:
    model = ready(style_dropout=0)
    model.training = True  # and not its parts, whose dropout would differ
    strangers = replace(batch, identity=torch.full_like(batch.identity, -1))

    def condition(share: float, clips: Batch) -> torch.Tensor:
        model.options.identity_dropout = share
        return model.conditions(clips).style

    torch.testing.assert_close(condition(1.0, batch), condition(0.0, strangers))
    assert not torch.equal(condition(0.0, batch), condition(0.0, strangers))


def test_the_learnt_stand_in_gets_a_gradient_in_every_step(ready: Ready, batch: Batch) -> None:
    model = ready().train()
    for share in (1e-12, 1.0):
        model.options.style_dropout = model.options.identity_dropout = share
        model.zero_grad()
        model.losses(batch)["loss"].backward()
        assert model.network.no_style.grad is not None
        assert bool(model.network.no_style.grad.any()) == (share == 1.0)


def test_where_no_style_is_given_motion_is_that_of_a_hidden_style(ready: Ready, batch: Batch, tiny: Tiny) -> None:
    """For identities of the training; others have their reference, as all have without ``style_dropout``."""
    model = ready()
    style = model.default_style("A").vector.expand(len(batch), -1)
    given = model.conditions(replace(batch, style=style)).style
    torch.testing.assert_close(given, tokens(model, batch, model.style_of(batch), hidden=True))
    assert not torch.equal(given, model.conditions(batch).style)
    stranger = next(name for name in model.assets.references if name not in model.assets.identities)
    assert model.default_style(stranger) is model.assets.references[stranger]
    assert ready(style_dropout=0).default_style("A").clip == tiny.assets().references["A"].clip
