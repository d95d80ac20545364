"""Protocols of parameters in `facediff test`: scores of channels and of decoded vertices, and what is missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lightning.pytorch import Trainer

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels

Make = Callable[..., DualPathDiffusion]


@pytest.fixture
def channels(tmp_path: Path) -> TinyChannels:
    return TinyChannels(root=str(write_channels(tmp_path / "channels")), batch_size=4)


def model(make_model: Make, **options: Any) -> DualPathDiffusion:  # noqa: ANN401
    encoder = partial(registry.mesh_encoder.linear)
    return make_model(
        n_vertices=6, space=CHANNELS, mesh_encoder=encoder, motion_scale="none", channel_weights="none", **options
    )


def reported(trainer: Trainer, model: DualPathDiffusion, data: TinyChannels) -> dict[str, float]:
    parts = trainer.test(model, datamodule=data, verbose=False)
    return {name: value for part in parts for name, value in part.items()}


def test_every_metric_of_channels_with_a_partner_and_a_mask(
    make_model: Make, make_trainer: Callable[..., Trainer], channels: TinyChannels
) -> None:
    data = channels
    for folder in ("partner", "speaking"):
        (data.root / folder).mkdir()
    # Everything is stored at twice the frame rate; every second frame is read.
    manifest = data.root / "manifest.json"
    content = json.loads(manifest.read_text()) if manifest.is_file() else {}
    manifest.write_text(json.dumps({**content, "frame_rate": 2 * data.frame_rate}))
    truths = {}
    for path in (data.root / "values_npy").glob("*.npy"):
        truths[path.stem] = np.load(path)
        np.save(path, np.repeat(truths[path.stem], 2, axis=0))
        np.save(data.root / "partner" / path.name, np.repeat(truths[path.stem][::-1], 2, axis=0))
        np.save(data.root / "speaking" / path.name, np.repeat(np.arange(len(truths[path.stem])) % 2 == 0, 2))
    jaw, l_jaw = (f"{prefix}channel_dynamics_deviation:region=jaw" for prefix in ("", "l_"))
    scores = reported(make_trainer(), model(make_model, protocol="dualtalk", metrics=[jaw, l_jaw]), data)
    for name in ("fd", "p_fd", "sid", "rpcc", "sts", "var", "div"):
        for part in ("expression", "jaw", "head"):
            assert np.isfinite(scores[f"test_a/{name}_{part}"]), (name, part)
    clips = [clip.name for clip in data.clips("test_a")]
    # A face that does not move has no deviation: the score is the truth's, 100 times.
    expected = np.mean([100 * truths[clip][:, 0].std() for clip in clips])
    assert scores[f"test_a/still/{jaw}"] == pytest.approx(expected, rel=1e-4)
    expected = np.mean([100 * truths[clip][1::2, 0].std() for clip in clips])
    assert scores[f"test_a/still/{l_jaw}"] == pytest.approx(expected, rel=1e-4)
    assert scores["test_a/still/var_head"] == 0
    squares = np.concatenate([truths[clip] for clip in clips]) ** 2
    assert scores["test_a/still/mve"] == pytest.approx(squares.mean(), rel=1e-4)


def test_millimetres_of_decoded_vertices(
    make_model: Make, make_trainer: Callable[..., Trainer], channels: TinyChannels
) -> None:
    plain = reported(
        make_trainer(), model(make_model, metrics=["lip_vertex_error:root=true,pooling=sequences"]), channels
    )
    scores = reported(make_trainer(), model(make_model, protocol="artalk"), channels)
    metres = {"m": 1.0, "mm": 0.001}[channels.assets().scored.unit]
    lve = plain["test_a/still/lip_vertex_error:root=true,pooling=sequences"]
    assert scores["test_a/still/lve"] == pytest.approx(1000 * metres * lve, rel=1e-6)
    assert scores["test_a/still/mhd"] > 0


def test_what_a_protocol_lacks_is_named(
    make_model: Make, make_trainer: Callable[..., Trainer], channels: TinyChannels
) -> None:
    for protocol, words in (("dualtalk", "partner"), ("unils", "speaking")):
        with pytest.raises(FaceDiffError) as error:
            make_trainer().test(model(make_model, protocol=protocol), datamodule=channels, verbose=False)
        assert str(channels.root / words) in str(error.value)
