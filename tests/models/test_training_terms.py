"""What a step of training or sampling draws, hides and scales, term by term: algorithm 1 and 2 without the network."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import DualPathDiffusion
from facediff.models.dual_path.conditioning import StyleTokens
from facediff.models.motion_space import ComponentMotion
from tests.fakes.tiny import VERTICES, Tiny

Make = Callable[..., DualPathDiffusion]
SCALE = 37.0


def known(model: DualPathDiffusion, tiny: Tiny) -> DualPathDiffusion:
    """An untrained model that knows a corpus whose motion is multiplied by SCALE."""
    model.adopt(tiny.assets().with_motion_scale(SCALE))
    return model.eval()


@pytest.fixture
def model(make_model: Make, tiny: Tiny) -> DualPathDiffusion:
    return known(make_model(), tiny)


def in_components(make_model: Make, tiny: Tiny, count: int = 6) -> DualPathDiffusion:
    """A model that works in components with sizes of their own, and whose last map is not zero."""
    space = partial(registry.motion_space.components, count=count, whitening=0.5)
    model = known(make_model(motion_space=space), tiny)
    random = torch.Generator().manual_seed(3)
    shapes = torch.linalg.qr(torch.randn(3 * VERTICES, count, generator=random))[0].T
    sizes = torch.tensor([2.0, 1.0, 0.8, 0.5, 0.2, 0.1])[:count, None]
    model.motion_space.components.attach(
        0.1 * torch.randn(3 * VERTICES, generator=random), sizes * shapes, torch.ones(3 * VERTICES)
    )
    model.motion_space.fit(model.process.signal)
    for parameter in model.network.unembed.parameters():
        nn.init.normal_(parameter, generator=random)
    return model


@pytest.fixture
def batch(tiny: Tiny) -> Batch:
    dataset = tiny.dataset("train")
    return collate([dataset[place] for place in range(8)])


def test_losses_draw_a_step_for_each_clip_and_unit_noise(
    model: DualPathDiffusion, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[Tensor, Tensor]] = []
    monkeypatch.setattr(model, "losses_at", lambda _, step, noise: drawn.append((step, noise)) or {})
    random = torch.Generator().manual_seed(0)
    for _ in range(100):
        model.losses(batch, random)
    steps, noise = (torch.stack(parts) for parts in zip(*drawn, strict=True))
    assert noise.shape[1:] == (8, batch.motion.shape[1], 3 * VERTICES)
    counts = torch.bincount(steps.flatten(), minlength=40).double()
    assert len(counts) == 40  # every step of the process, from the first to the last
    assert float((counts - 20).square().sum() / 20) < 39 + 5 * (2 * 39) ** 0.5  # χ² of 39 degrees of freedom
    # One clip's step says nothing of another's.
    assert float((torch.corrcoef(steps.T.double()) - torch.eye(8)).abs().max()) < 4 / 100**0.5
    assert float(noise.double().mean()) == pytest.approx(0, abs=4 / noise.numel() ** 0.5)
    assert float(noise.double().var()) == pytest.approx(1, abs=4 * (2 / noise.numel()) ** 0.5)
    assert not torch.equal(noise[0], noise[1])
    assert not torch.equal(noise[0, 0], noise[0, 1])


def test_the_style_path_sees_scaled_motion(model: DualPathDiffusion, batch: Batch) -> None:
    seen: list[Tensor] = []
    assert model.network.mesh_encoder is not None
    model.network.mesh_encoder.register_forward_hook(lambda _, args, __: seen.append(args[0]))
    style = model.encode_style(batch.reference, batch.reference_mask)
    torch.testing.assert_close(seen[0], SCALE * batch.reference)
    assert style.shape == (8, 16)
    # Training and animation take the same path.
    model.conditions(batch)
    torch.testing.assert_close(seen[1], seen[0])


class StopError(Exception):
    """Ends sampling at its first state."""


@pytest.mark.parametrize("space", ["vertices", "folded", "components"])
def test_sampling_starts_from_unit_noise(make_model: Make, tiny: Tiny, batch: Batch, space: str) -> None:
    """Algorithm 2, line 1, in every space: what the network's first map makes of unit noise has the same covariance."""
    model = in_components(make_model, tiny) if space == "components" else known(make_model(sampling_space=space), tiny)
    states: list[Tensor] = []

    def run(_: object, start: Tensor, *, noise: Callable[[Tensor], Tensor], progress: object) -> Tensor:
        states.extend([start, noise(start)])
        raise StopError

    model.sampler.run = run  # type: ignore[method-assign, assignment]
    for seed in range(8):
        with pytest.raises(StopError):
            model.generate(batch, seed=seed)
    embed = model.network.embed.weight.detach().double()
    for found in (states[::2], states[1::2]):  # the first state, and noise that is added on the way
        flat = torch.cat([state[batch.mask] for state in found]).double()
        expected = embed @ embed.T if space == "folded" else torch.eye(flat.shape[1]).double()
        size = float(expected.diagonal().mean())
        assert float(flat.mean(0).abs().max()) < 5 * (size / len(flat)) ** 0.5
        assert float((flat.T @ flat / len(flat) - expected).abs().max()) < 7 * size / len(flat) ** 0.5
    assert not torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])


def test_losses_in_components_are_their_formulas(make_model: Make, tiny: Tiny, batch: Batch) -> None:
    """From the clips to the four numbers in NumPy; the network alone is called."""
    model = in_components(make_model, tiny)
    space, network = model.motion_space, model.network
    assert isinstance(space, ComponentMotion)
    noise, step = torch.randn(8, batch.motion.shape[1], 6), torch.tensor([0, 39, 5, 10, 15, 20, 25, 30])
    found = model.losses_at(batch, step, noise.clone())
    basis, mean, deviations, sizes = (
        part.double().numpy()
        for part in (space.components.basis, space.components.mean, space.components.deviations, space.sizes)
    )
    np.testing.assert_allclose(sizes, deviations[0] * (deviations / deviations[0]) ** 0.5, rtol=1e-5)
    offsets = SCALE * batch.motion.double().numpy().reshape(8, -1, 3 * VERTICES) - mean
    clean = offsets @ basis.T * (sizes / deviations)
    kept = model.process.signal.double().numpy()[step.numpy()][:, None, None]
    noisy = np.sqrt(kept) * clean + np.sqrt(1 - kept) * noise.double().numpy()
    total = kept * sizes**2 + 1 - kept
    with torch.no_grad():
        features = network(torch.from_numpy(noisy / np.sqrt(total)).float(), step, model.conditions(batch))
    left = sizes**2 * (1 - kept) / total
    predicted = np.sqrt(kept) * sizes**2 / total * noisy + np.sqrt(left) * features.double().numpy()
    counted = (deviations / sizes) ** 2
    weight = counted / (counted * left).sum(-1, keepdims=True)
    terms = {}
    for order, name in enumerate(("reconstruction", "velocity", "acceleration")):
        errors = [
            (np.diff((predicted - clean)[i, :frames], order, axis=0) ** 2 * weight[i]).sum(-1)
            for i, frames in enumerate(batch.frame_lengths.tolist())
        ]
        terms[name] = np.concatenate(errors).mean()
        assert float(found[name].detach()) == pytest.approx(terms[name], rel=1e-3)
    loss = sum(model.options.loss_weights[name] * value for name, value in terms.items())
    assert float(found["loss"].detach()) == pytest.approx(loss, rel=1e-3)


@pytest.mark.parametrize("form", ["levels", "single"])
def test_style_tokens_are_projections_of_their_parts(form: str) -> None:
    """F_s = Concat(F_id, F_dyn) (eq. 14): in parts of their own widths, or as a whole."""
    torch.manual_seed(0)
    tokens = StyleTokens((3, 5, 2), 4, form).double()  # type: ignore[arg-type]
    style = torch.randn(6, 10).double()
    parts = np.split(style.numpy(), [3, 8], axis=1) if form == "levels" else [style.numpy()]
    expected = [
        part @ projection.weight.detach().numpy().T + projection.bias.detach().numpy()
        for part, projection in zip(parts, tokens.projections, strict=True)
    ]
    np.testing.assert_allclose(tokens(style).detach().numpy(), np.stack(expected, 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", ["levels", "single"])
def test_style_tokens_without_a_condition_are_one_learnt_token(form: str) -> None:
    tokens = StyleTokens((), 4, form)  # type: ignore[arg-type]
    assert tokens.null is not None
    assert not tokens.null.any()  # it begins as nothing
    nn.init.normal_(tokens.null)
    made = tokens(torch.zeros(3, 0))
    assert made.shape == (3, 1, 4)
    assert torch.equal(made, tokens.null.expand(3, 1, 4))


def test_conditions_are_of_eq_14_and_keep_to_their_clips(model: DualPathDiffusion, batch: Batch) -> None:
    conditions, network = model.conditions(batch), model.network
    identity = network.identity_encoder(batch.identity)
    dynamic = model.encode_style(batch.reference, batch.reference_mask)
    torch.testing.assert_close(conditions.style, network.style_tokens(torch.cat([identity, dynamic], -1)))
    assert torch.equal(conditions.mask, batch.mask)
    torch.testing.assert_close(
        conditions.audio, network.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths)
    )
    part = conditions.frames(torch.arange(2, 5))
    assert torch.equal(part.audio, conditions.audio[:, 2:5])
    assert torch.equal(part.mask, conditions.mask[:, 2:5])
    assert torch.equal(part.style, conditions.style)


def test_without_a_seed_it_is_zero(model: DualPathDiffusion, batch: Batch) -> None:
    nn.init.normal_(model.network.unembed.weight)
    nn.init.normal_(model.network.embed.weight)
    speech = torch.randn(9600, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for one, other in (
            (model.generate(batch), [model.generate(batch, seed=seed) for seed in (0, 1)]),
            (model.generate_clips(batch), [model.generate_clips(batch, seed=seed) for seed in (0, 1)]),
            (
                model.animate(speech, identity="A").vertices,
                [model.animate(speech, identity="A", seed=seed).vertices for seed in (0, 1)],
            ),
        ):
            assert torch.equal(one, other[0])
            assert not torch.allclose(one, other[1])
    assert model.stream(identity="A").seeds == [0]
