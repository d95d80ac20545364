"""What lets the dynamic style hold the person: terms of the loss, and a learnt feature of hidden identities."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.data import Batch, collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.adaptation import with_extra_identities
from facediff.models.losses import style_identity_loss
from tests.fakes.tiny import SEEN, Tiny

Ready = Callable[..., DualPathDiffusion]


@pytest.fixture
def batch(tiny: Tiny) -> Batch:
    """Two clips of A and two of B."""
    dataset = tiny.dataset("train")
    return collate([dataset[place] for place in (0, 2, 5, 7)])


def losses(model: DualPathDiffusion, batch: Batch) -> dict[str, torch.Tensor]:
    return model.losses(batch, torch.Generator().manual_seed(0))


def test_style_identity_loss_is_cross_entropy_of_known_speakers() -> None:
    logits = np.random.default_rng(0).standard_normal((4, 3))
    chances = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    expected = -np.log([chances[0, 2], chances[2, 0], chances[3, 1]]).mean()
    found = style_identity_loss(torch.from_numpy(logits).float(), torch.tensor([2, -1, 0, 1]))
    assert float(found) == pytest.approx(expected, rel=1e-5)
    assert float(style_identity_loss(torch.ones(2, 3), torch.tensor([-1, -1]))) == 0


@pytest.mark.parametrize("space", [registry.motion_space.vertices, partial(registry.motion_space.components, count=4)])
def test_style_terms_are_added_with_their_weights(ready: Ready, batch: Batch, space: object) -> None:
    plain = ready(motion_space=space)
    model = ready(motion_space=space, style_identity_weight=0.3)
    assert set(model.load_state_dict(plain.state_dict(), strict=False).missing_keys) == {
        "style_identity.weight",
        "style_identity.bias",
    }
    before, found = losses(plain, batch), losses(model, batch)
    style = model.encode_style(batch.reference, batch.reference_mask)
    identity = style_identity_loss(model.style_identity(style), batch.identity)
    torch.testing.assert_close(found["style_identity"], identity)
    torch.testing.assert_close(found["loss"], before["loss"] + 0.3 * identity)
    assert set(found) == {*before, "style_identity"}


def test_style_terms_reach_the_style_encoder_though_the_style_is_hidden(ready: Ready, batch: Batch) -> None:
    model = ready(style_identity_weight=1.0, style_dropout=1.0, identity_dropout=0.0).train()
    found = losses(model, batch)
    assert not any(p.grad is not None for p in model.network.style_encoder.parameters())
    found["loss"].backward()
    assert any(p.grad is not None and bool(p.grad.any()) for p in model.network.style_encoder.parameters())


def test_the_classifier_is_personal_and_grows_with_a_new_speaker(ready: Ready) -> None:
    model = ready(style_identity_weight=1.0)
    assert model.style_identity in model.personal_modules()
    grown = with_extra_identities(model, ["C", *SEEN])
    weight = model.style_identity.weight
    torch.testing.assert_close(grown.style_identity.weight, torch.cat([weight.mean(0, keepdim=True), weight]))


def test_style_terms_need_a_style(make_model: Callable[..., DualPathDiffusion]) -> None:
    with pytest.raises(FaceDiffError, match="style_identity_weight"):
        make_model(style_encoder=registry.style_encoder.none, style_identity_weight=1.0)
