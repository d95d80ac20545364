"""The published methods in parameters, trained on them: what they learn of speech, and resumed runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from facediff import registry
from facediff.models import AnimationModel
from tests.callbacks.test_checkpoints import Stop, fit, last
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.models.published.conftest import METHODS

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:Checkpoint directory", "ignore:.*ThroughputMonitor")]

IN_PARAMETERS = ("ARTalk", "DiffPoseTalk", "LamAudio2Expression", "UniTalker")
SIZES: dict[str, Any] = {
    "n_vertices": len(CHANNELS.channels),
    "identities": TinyChannels.identities,
    "frame_rate": TinyChannels.frame_rate,
    "space": CHANNELS,
}


@pytest.fixture(scope="module")
def channels_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_channels(tmp_path_factory.mktemp("channels") / "corpus")


def made(name: str, **options: Any) -> AnimationModel:  # noqa: ANN401
    torch.manual_seed(0)
    model: AnimationModel = registry.model.get(name)(**{**SIZES, **METHODS[name], **options})
    return model


@pytest.mark.parametrize("name", IN_PARAMETERS)
def test_speech_is_learnt_and_shuffled_speech_fails(name: str, channels_root: Path) -> None:
    """Loudness drives the jaw: with another clip's speech a trained model is worse, and no better than the mean."""
    data = TinyChannels(root=str(channels_root), batch_size=8)
    data.setup("fit")
    model = made(name, **LEARNING.get(name, {}))
    model.adopt(data.assets())
    model.measure(data)
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=5e-3)
    generator = torch.Generator().manual_seed(0)
    (batch,) = data.train_dataloader()  # all eight clips
    model.train()
    for _ in range(STEPS[name]):
        optimizer.zero_grad()
        model.losses(batch, generator)["loss"].backward()
        optimizer.step()
    model.eval()
    jaw = CHANNELS.index("jawOpen")
    shuffled = batch.select([*range(1, len(batch)), 0])
    frames = int(batch.frame_lengths.min())  # of all clips, so that none is padding with either speech
    own, other = (model.generate(one).detach()[:, :frames, jaw, 0] for one in (batch, with_speech_of(batch, shuffled)))
    truth = batch.motion[:, :frames, jaw, 0]
    mean = truth.mean(1, keepdim=True)
    errors = [float((series - truth).square().mean()) for series in (own, other, mean.expand_as(truth))]
    assert errors[0] < 0.6 * errors[1], errors
    assert errors[0] < 0.8 * errors[2], errors


LEARNING: dict[str, dict[str, Any]] = {
    "DiffPoseTalk": {"dim": 32, "diffusion_steps": 20, "audio_scale": 1.0, "style_scale": 1.0},
}
STEPS = {"ARTalk": 600, "DiffPoseTalk": 400, "LamAudio2Expression": 250, "UniTalker": 250}


def with_speech_of(batch: Any, other: Any) -> Any:  # noqa: ANN401
    from dataclasses import replace

    return replace(batch, audio=other.audio, audio_lengths=other.audio_lengths)


@pytest.mark.parametrize("name", IN_PARAMETERS)
def test_a_stopped_run_continues_exactly(name: str, channels_root: Path, tmp_path: Path) -> None:
    def make(**options: Any) -> Any:  # noqa: ANN401
        return made(name, **options)

    model, curve = fit(tmp_path / "whole", channels_root, make, data_class=TinyChannels)
    with pytest.raises(RuntimeError, match="killed"):
        fit(tmp_path / "stopped", channels_root, make, Stop(4), data_class=TinyChannels)
    start = last(tmp_path / "stopped")
    again, continued = fit(tmp_path / "stopped", channels_root, make, ckpt_path=start, data_class=TinyChannels)
    assert continued == curve
    assert all(torch.equal(mine, again.state_dict()[key]) for key, mine in model.state_dict().items())
