"""TalkingStyle against its formulas: inference, style, loss, and what its importer says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.data import collate
from facediff.models import TalkingStyle
from tests.fakes import published
from tests.fakes.published import IDENTITIES, VERTICES
from tests.models.published.author import face, imported, sample_of, speech_of


# As published in floating point: 205 steps are 122 frames, not 123.
@pytest.mark.parametrize(("dataset", "steps"), [("vocaset", 41), ("vocaset", 205), ("biwi", 41), ("biwi", 58)])
def test_it_gives_what_the_formulas_give(dataset: str, steps: int, tmp_path: Path) -> None:
    state = published.talkingstyle_state(dataset)
    model = imported(state, tmp_path, dataset)
    assert isinstance(model, TalkingStyle)
    assert len(model.network.decoder.layers) == 3
    speech = speech_of(steps)
    for number, name in enumerate(IDENTITIES[: 1 if steps > 50 else 3]):
        made = model.animate(speech, identity="A", condition=name).vertices.flatten(1)
        expected = published.talkingstyle_offsets(state, speech, dataset, number) + face("A")
        torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("mouth", ["flattened", "vertices"])
@pytest.mark.parametrize(("dataset", "frames"), [("vocaset", 25), ("biwi", 18)])
def test_the_loss(dataset: str, frames: int, mouth: str, tmp_path: Path) -> None:
    """0.4 of all coordinates and 0.6 of the mouth's, whose vertex numbers count coordinates as published."""
    state = published.talkingstyle_state(dataset)
    model = imported(state, tmp_path, dataset, mouth_loss=mouth)
    lips = torch.tensor([7, 2, 11])
    model.assets.regions["lips"] = lips
    truth = 0.1 * torch.randn(frames, VERTICES, 3, generator=torch.Generator().manual_seed(1))
    speech = speech_of(40)
    loss = model.losses(collate([sample_of(speech, truth, identity=1)]))
    made = published.talkingstyle_offsets(state, speech, dataset, 1, frames).numpy()
    error = (made - truth.flatten(1).numpy()) ** 2
    columns = lips.numpy() if mouth == "flattened" else np.concatenate([3 * lips.numpy() + axis for axis in range(3)])
    expected = 0.4 * error.mean() + 0.6 * error[:, columns].mean()
    assert loss["loss"].item() == pytest.approx(expected, rel=1e-4)


def test_teacher_forcing_in_one_pass(tmp_path: Path) -> None:
    """Each token is the true motion of the frame before; the first is that of a face at rest, with the map's bias."""
    state = published.talkingstyle_state("vocaset")
    model = imported(state, tmp_path, "vocaset", teacher_forcing=True)
    truth = 0.1 * torch.randn(24, VERTICES, 3, generator=torch.Generator().manual_seed(1))
    loss = model.losses(collate([sample_of(speech_of(40), truth, identity=0)]))["reconstruction"]
    features = published.features_of(published.standardised(speech_of(40), 1e-7), state, "audio_encoder.")
    features, _ = published.resampled(features, "vocaset", 24)
    memory = published.linear(published.hidden_of(features, state, "audio_encoder."), state, "audio_feature_map")
    before = torch.cat([torch.zeros(1, 3 * VERTICES), truth.flatten(1)[:-1]])
    tokens = published.linear(before, state, "vertice_encoder") + published.talkingstyle_style(state, 0)
    made = published.decoded(tokens + state["PPE.pe"][0, :24], memory, state, "transformer_decoder.", "vocaset")
    expected = (published.linear(made, state, "vertice_decoder") - truth.flatten(1)).square().mean()
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=1e-6)
