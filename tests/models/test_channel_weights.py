"""Channels in losses, and models on motion in channels: training, scores of decoded vertices, checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer

from facediff import registry
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, DualPathDiffusion, load_model
from facediff.models.channel_weights import channel_weights
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.fakes.tiny import SEEN, VERTICES
from tests.models.published.conftest import METHODS

Make = Callable[..., DualPathDiffusion]
SIZES: dict[str, Any] = {"n_vertices": 6, "space": CHANNELS}


@pytest.fixture(scope="module")
def channels(tmp_path_factory: pytest.TempPathFactory) -> TinyChannels:
    return TinyChannels(root=str(write_channels(tmp_path_factory.mktemp("corpus") / "channels")), batch_size=4)


def test_the_rig_makes_the_vertices_of_the_channels(channels: TinyChannels) -> None:
    assets = channels.assets()
    clip = channels.clips("test_a")[0]
    motion = channels.corpus.read_motion(clip)
    assert motion.shape[1:] == (6, 1)
    torch.testing.assert_close(
        assets.to_scored(motion, clip.identity), channels.mesh_corpus.read_motion(clip), atol=1e-6, rtol=0
    )
    assert (assets.n_vertices, assets.mesh.n_vertices) == (6, VERTICES)
    assert assets.regions["lips"].tolist() == [0, 2]
    assert assets.mesh.regions["lips"].tolist() == list(range(12))


def statistics(channels: TinyChannels) -> tuple[torch.Tensor, torch.Tensor]:
    _, shapes = channels.principal_motion(6)
    covariance = shapes.T @ shapes
    return covariance.diag(), covariance


def test_weighed_channels_are_the_vertex_loss_without_vertices(channels: TinyChannels) -> None:
    assets, (variances, covariance) = channels.assets(), statistics(channels)
    points = torch.rand(VERTICES, 3, generator=torch.Generator().manual_seed(0)) + 0.5
    weights = channel_weights(assets, variances, covariance, points, "rig").double()
    errors = torch.randn(50, 6, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    errors[:, 3:] = 0  # the rig of a face does not know how the head turns
    of_channels = (errors[..., 0] @ weights.T).square().sum(1)
    of_vertices = (assets.to_scored(errors, "A") * points).square().flatten(1).sum(1)
    ratio = of_channels / of_vertices
    torch.testing.assert_close(ratio / ratio.mean(), torch.ones(50, dtype=torch.float64), atol=1e-6, rtol=0)


@pytest.mark.parametrize("by", ["rig", "deviation"])
def test_channel_weights_keep_the_size_of_motion_and_lose_no_channel(channels: TinyChannels, by: Any) -> None:  # noqa: ANN401
    variances, covariance = statistics(channels)
    points = torch.ones(VERTICES if by == "rig" else 6, 3 if by == "rig" else 1)
    weights = channel_weights(channels.assets(), variances, covariance, points, by)
    torch.testing.assert_close((weights @ covariance @ weights.T).trace(), variances.sum())
    counted = (weights @ covariance @ weights.T).diag()
    assert (counted[3:] > 0.01 * counted.sum()).all()  # the head
    assert torch.isfinite(torch.linalg.inv(weights)).all()


def test_the_head_counts_as_much_as_the_mean_channel_of_the_face(channels: TinyChannels) -> None:
    variances, covariance = statistics(channels)
    weights = channel_weights(channels.assets(), variances, covariance, torch.ones(VERTICES, 3), "rig")
    counted = (weights @ covariance @ weights.T).diag()
    torch.testing.assert_close(counted[3:], counted[:3].mean().expand(3))


@pytest.mark.parametrize("space", ["vertices", "components"])
def test_the_dual_path_trains_tests_and_loads_in_channels(
    channels: TinyChannels, make_model: Make, make_trainer: Callable[..., Trainer], space: str, tmp_path: Path
) -> None:
    whole = space == "vertices"
    motion_space = registry.motion_space.vertices if whole else partial(registry.motion_space.components, count=6)
    encoder = registry.mesh_encoder.linear if whole else partial(registry.mesh_encoder.components, count=6)
    model = make_model(**SIZES, motion_space=motion_space, mesh_encoder=encoder)
    trainer = make_trainer(max_epochs=2)
    trainer.fit(model, channels)
    assert model.geometry is not None
    assert not torch.equal(model.geometry, torch.eye(6))
    (scores, *_) = trainer.test(model, channels, verbose=False)
    assert {"test_a/lve", "test_a/param_lve", "test_a/param_mve", "test_a/param_fdd"} <= scores.keys()
    # What is scored as vertices is what the rig makes of the channels.
    still = channels.assets().to_scored(torch.zeros(1, 6, 1), "A")
    assert scores["test_a/still/mve"] > 0
    assert not still.any()
    trainer.save_checkpoint(tmp_path / "model.ckpt")
    loaded = load_model(tmp_path / "model.ckpt")
    batch = collate([channels.dataset("test_a")[0]])
    assert torch.equal(loaded.generate(batch, seed=0), model.eval().generate(batch, seed=0))
    assert loaded.space == CHANNELS
    assert loaded.generate(batch, seed=0).shape == batch.motion.shape


@pytest.mark.parametrize("name", [*METHODS, "StyleContentDisentanglement"])
def test_every_method_generates_channels(name: str, channels: TinyChannels) -> None:
    options = METHODS.get(name, {"mesh_encoder": registry.mesh_encoder.linear, "basis_size": 4})
    if name == "CodeTalker":
        options = {**options, "stage": "prior"}
    model: AnimationModel = registry.model.get(name)(**SIZES, identities=SEEN, frame_rate=25.0, **options)
    model.adopt(channels.assets().with_motion_scale(1.0))
    batch = collate([channels.dataset("val")[0]])
    loss = model.losses(batch, torch.Generator().manual_seed(0))["loss"]
    loss.backward()  # type: ignore[no-untyped-call]
    assert torch.isfinite(loss)
    if model.animates:
        assert model.eval().generate(batch, seed=0).shape == batch.motion.shape


def test_a_model_of_another_space_is_refused(make_model: Make, channels: TinyChannels) -> None:
    with pytest.raises(FaceDiffError, match="space"):
        make_model(n_vertices=6).adopt(channels.assets())
    with pytest.raises(FaceDiffError, match="6 channels"):
        make_model(n_vertices=24, space=CHANNELS)
