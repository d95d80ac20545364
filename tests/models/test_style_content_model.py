"""Style-content disentanglement: its parts against references, its losses against oracles, its training."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import EMAWeightAveraging
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import Style, load_model
from facediff.models.losses import style_contrast
from facediff.models.style_content.losses import (
    Alignments,
    dynamics_distance,
    pair_up,
)
from facediff.models.style_content.network import StyleContentDecoder
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.style_content import make
from tests.fakes.tiny import VERTICES, Tiny

MakeTrainer = Callable[..., Trainer]


def masks(*lengths: int) -> Tensor:
    return torch.arange(max(lengths))[None] < torch.tensor(lengths)[:, None]


class TestDecoder:
    def make(self) -> StyleContentDecoder:
        torch.manual_seed(0)
        return StyleContentDecoder(
            n_vertices=7,
            dims=3,
            content_dim=5,
            style_dim=3,
            channels=(6, 8, 8),
            kernels=(5, 3, 3),
            hidden=(9, 9),
            basis_size=4,
        )

    def test_a_naive_rendition_gives_the_same(self) -> None:
        decoder = self.make().double()
        assert decoder.past_frames == 8
        content, style = torch.randn(1, 12, 5, dtype=torch.float64), torch.randn(1, 3, dtype=torch.float64)
        x = content[0].numpy()
        for conv, kernel in zip(decoder.convolutions, (5, 3, 3), strict=True):
            weight, bias = conv.weight.detach().numpy(), conv.bias.detach().numpy()
            beside = np.concatenate([x, np.repeat(style.numpy(), len(x), 0)], 1)
            padded = np.concatenate([np.zeros((kernel - 1, beside.shape[1])), beside])
            y = np.stack([np.einsum("oik,ki->o", weight, padded[t : t + kernel]) + bias for t in range(len(x))])
            x = np.where(y > 0, y, 0.2 * y)
        for layer in decoder.connected:
            if isinstance(layer, nn.Linear):
                x = x @ layer.weight.detach().numpy().T + layer.bias.detach().numpy()
            else:
                x = np.where(x > 0, x, 0.2 * x)
        x = x @ decoder.basis.weight.detach().numpy().T + decoder.basis.bias.detach().numpy()
        # The last map is always in float32.
        got = decoder.float()(content.float(), style.float(), masks(12))[0].detach().numpy()
        np.testing.assert_allclose(got, x, rtol=1e-4, atol=1e-5)

    def test_a_basis_from_principal_components_spans_them(self) -> None:
        decoder = self.make()
        mean, shapes = torch.randn(21), torch.randn(2, 21)
        decoder.start_from(mean, shapes)
        torch.testing.assert_close(decoder.basis(torch.tensor([2.0, -1.0, 0.0, 0.0])), mean + 2 * shapes[0] - shapes[1])


class TestObjectives:
    @pytest.mark.parametrize("size", [1.0, 0.03])
    def test_dynamics_compare_spreads(self, size: float) -> None:
        """Against NumPy's own standard deviations; the order of frames does not count."""
        motion, truth = size * torch.randn(3, 40, 6, 3), size * torch.randn(3, 40, 6, 3)
        mask, truth_mask = masks(40, 30, 20), masks(40, 25, 35)
        chosen, vertices = torch.tensor([True, False, True]), torch.tensor([1, 4])
        spreads = []
        for each, lengths in ((motion, (40, 20)), (truth, (40, 35))):
            squared = (each.double().numpy() ** 2).sum(-1)[:, :, [1, 4]]
            spreads.append(
                np.stack([squared[clip, :frames].std(0) for clip, frames in zip((0, 2), lengths, strict=True)])
            )
        want = ((spreads[0] - spreads[1]) ** 2).mean() / (spreads[1].mean() ** 2 + 1e-6)
        got = dynamics_distance(motion, truth, mask, truth_mask, chosen, vertices)
        assert float(got) == pytest.approx(want, rel=1e-4)
        other = motion[:, torch.randperm(40)]
        everything = masks(40, 40, 40)
        same = dynamics_distance(motion, other, everything, everything, chosen, vertices)
        assert float(same) == pytest.approx(0, abs=1e-9)
        assert float(dynamics_distance(motion, truth, mask, truth_mask, chosen & False, vertices)) == 0


def pairs(data: Tiny, *names: str) -> Batch:
    """The training clips of these names, in this order."""
    dataset = data.dataset("train")
    order = [clip.name for clip in dataset.clips]
    return collate([dataset[order.index(name)] for name in names])


def test_style_contrast_by_hand() -> None:
    """Whoever has several styles, two or more; one person has a single one and is only told from."""
    styles, subjects = torch.randn(7, 3, dtype=torch.float64), ["A", "A", "B", "B", "C", "A", "B"]
    directions = (styles / styles.norm(dim=1, keepdim=True)).numpy()
    for temperature in (0.1, 0.3):
        each = []
        for i in (0, 1, 2, 3, 5, 6):
            others = [k for k in range(7) if k != i]
            logits = np.array([directions[i] @ directions[k] / temperature for k in others])
            chances = logits - np.log(np.exp(logits).sum())
            each.append(-np.mean([chances[n] for n, k in enumerate(others) if subjects[k] == subjects[i]]))
        assert float(style_contrast(styles, subjects, temperature)) == pytest.approx(np.mean(each), rel=1e-5)
    assert torch.equal(style_contrast(styles, subjects), style_contrast(styles, subjects, 0.1))
    leaf = styles.clone().requires_grad_()
    style_contrast(leaf, subjects).backward()
    assert leaf.grad is not None
    assert torch.isfinite(leaf.grad).all()
    assert leaf.grad.any()
    assert float(style_contrast(styles[:2], ["A", "A"])) == 0, "one person cannot be told from anybody"
    assert float(style_contrast(styles[:2], ["A", "B"])) == 0


class TestLosses:
    def test_neighbours_who_say_the_same_are_aligned(self, tiny: Tiny) -> None:
        batch = pairs(tiny, "A_e01", "B_e01", "A_e02", "B_e03", "A_e04")
        pairing = pair_up(batch, Alignments(25.0))
        assert pairing.partner.tolist() == [1, 0, 3, 2, 4]
        assert pairing.aligned.any(1).tolist() == [True, True, False, False, False]
        assert pairing.unaligned.tolist() == [False, False, True, True, False]
        # A and B move by one formula, B twice as far: in A's timing B's motion is twice A's.
        mine, other = batch.motion[0, :, 0, 1], pairing.of_partner(batch.motion)[0, :, 0, 1]
        inside = pairing.aligned[0]
        np.testing.assert_allclose(other[inside], 2 * mine[inside], atol=0.006)
        assert not pair_up(batch, None).aligned.any()
        alone = pair_up(pairs(tiny, "A_e01", "A_e02"), Alignments(25.0))
        assert alone.partner.tolist() == [0, 1], "two sentences of one person: nothing to swap"

    def test_pairs_need_not_be_aligned(self, tiny: Tiny) -> None:
        found = []
        for aligned in (True, False):
            model = make(aligned_pairs=aligned)
            model.adopt(tiny.assets().with_motion_scale(100.0))
            model.attach_mesh()
            model.alignment_allowed = lambda: True  # type: ignore[method-assign]
            found.append(model.losses(pairs(tiny, "A_e01", "B_e01"))["recording_content"].item())
        assert found[0] > 0 == found[1]

    def test_every_parameter_gets_a_gradient(self, tiny: Tiny) -> None:
        for options in ({}, {"mesh_encoder": registry.mesh_encoder.linear}):
            model = make(**options)
            model.adopt(tiny.assets().with_motion_scale(100.0))
            model.attach_mesh()
            model.losses(pairs(tiny, "A_e01", "B_e01"))["loss"].backward()
            assert [name for name, p in model.named_parameters() if p.grad is None] == []

    def test_the_loss_does_not_look_at_padding(self, tiny: Tiny) -> None:
        model = make()
        model.adopt(tiny.assets().with_motion_scale(100.0))
        model.attach_mesh()
        batch = pairs(tiny, "A_e01", "B_e02")
        garbage = torch.randn_like(batch.motion) * ~batch.mask[..., None, None]
        longer = replace(batch, motion=batch.motion + garbage)
        assert not torch.equal(longer.motion, batch.motion)
        with torch.no_grad():
            one, two = model.losses(batch), model.losses(longer)
        for name in one:
            torch.testing.assert_close(one[name], two[name], rtol=1e-4, atol=1e-5, msg=name)


@pytest.fixture(scope="module")
def trained(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint after a few steps with weight averaging."""
    folder = tmp_path_factory.mktemp("style_content")
    averaging = EMAWeightAveraging(decay=0.9, use_buffers=False)
    trainer = quiet_trainer(folder, max_epochs=4, callbacks=[averaging])
    trainer.fit(make(learning_rate=1e-3), datamodule=Tiny(root=str(tiny_root), batch_size=4))
    trainer.save_checkpoint(folder / "trained.ckpt")
    return folder / "trained.ckpt"


class TestTrained:
    def test_the_mesh_is_in_the_checkpoint(self, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A machine without the simplifier animates."""
        monkeypatch.setitem(sys.modules, "fast_simplification", None)
        model = load_model(trained)
        assert model.network.content_encoder.attached
        made = model.animate(torch.randn(16_000), identity="A")
        assert made.vertices.shape == (25, VERTICES, 3)
        assert torch.isfinite(made.vertices).all()

    def test_it_is_a_function_of_speech_and_style(self, trained: Path) -> None:
        model = load_model(trained)
        speech = torch.randn(16_000)
        one = model.animate(speech, identity="A", seed=0).vertices
        assert torch.equal(one, model.animate(speech, identity="A", seed=7).vertices), "nothing is drawn"
        assert not torch.equal(one, model.animate(torch.randn(16_000), identity="A").vertices)
        other = Style(
            "other", model.encode_style(torch.randn(1, 9, VERTICES, 3), torch.ones(1, 9, dtype=torch.bool))[0]
        )
        assert not torch.equal(one, model.animate(speech, identity="A", style=other).vertices)

    def test_a_style_vector_does_what_its_reference_does(self, trained: Path) -> None:
        model = load_model(trained)
        reference = model.default_style("B")
        motion = reference.motion.float()[None]
        vector = model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool))[0]
        speech = torch.randn(16_000)
        one = model.animate(speech, identity="A", style=reference).vertices
        torch.testing.assert_close(one, model.animate(speech, identity="A", style=Style("B", vector)).vertices)
