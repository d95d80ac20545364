"""The recogniser as an audio encoder: the pretrained network's own logits, frozen, and what a wrong source says."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.hyperparameters import describe
from facediff.models.audio_encoders import CtcEncoder

LENGTHS = torch.tensor([16_000, 9_600])
"""One second, and 0.6 s: 50 and 30 steps."""


def speech() -> torch.Tensor:
    waves = torch.randn(2, 16_000, generator=torch.Generator().manual_seed(0))
    waves[1, 9_600:] = 0
    return waves


@pytest.fixture
def encoder(ctc_source: Path) -> CtcEncoder:
    torch.manual_seed(0)
    return CtcEncoder(dim=8, source=str(ctc_source))


def test_its_steps_are_the_recognisers_logits(ctc_source: Path, encoder: CtcEncoder) -> None:
    """29 logits, 50 times a second, of speech standardised as the recogniser's own processor does it."""
    from transformers import Wav2Vec2FeatureExtractor, Wav2Vec2ForCTC

    whole = Wav2Vec2ForCTC.from_pretrained(ctc_source).eval()
    process = Wav2Vec2FeatureExtractor(do_normalize=True)
    logits, steps = encoder.frozen_features(speech(), LENGTHS)
    assert steps.tolist() == [50, 30]
    assert logits.shape == (2, 50, 29)
    for row, length, count in zip(range(2), LENGTHS.tolist(), steps.tolist(), strict=True):
        wave = process(speech()[row, :length].numpy(), sampling_rate=16_000).input_values[0]
        padded = torch.from_numpy(np.pad(wave, 40)).float()[None]  # one step for every 320 samples
        with torch.no_grad():
            expected = whole(padded).logits[0]
        torch.testing.assert_close(logits[row, :count], expected, rtol=1e-4, atol=1e-4)


def test_at_fifty_frames_a_second_nothing_is_interpolated(encoder: CtcEncoder) -> None:
    logits, steps = encoder.frozen_features(speech(), LENGTHS)
    made = encoder(speech(), LENGTHS, steps)
    torch.testing.assert_close(made[0], encoder.out(logits[0]))
    torch.testing.assert_close(made[1, :30], encoder.out(logits[1, :30]))
    assert not made[1, 30:].any()
    torch.testing.assert_close(encoder(speech(), LENGTHS, steps, logits, steps), made)


def test_the_recogniser_is_frozen_and_calm(encoder: CtcEncoder) -> None:
    before = {name: value.clone() for name, value in encoder.recogniser.state_dict().items()}
    encoder.train()
    assert not encoder.recogniser.training
    first = encoder(speech(), LENGTHS, torch.tensor([30, 18]))
    assert torch.equal(first, encoder(speech(), LENGTHS, torch.tensor([30, 18])))
    first.square().sum().backward()
    assert [name for name, value in encoder.named_parameters() if value.grad is not None] == ["out.weight", "out.bias"]
    after = encoder.recogniser.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())


def test_a_checkpoint_needs_no_source(encoder: CtcEncoder, ctc_source: Path) -> None:
    options = describe(partial(registry.audio_encoder.ctc, source=str(ctc_source)), encoder)["init_args"]
    again = CtcEncoder(dim=8, **{**options, "source": "/nowhere"})
    again.load_state_dict(encoder.state_dict())
    frames = torch.tensor([25, 15])
    assert torch.equal(again(speech(), LENGTHS, frames), encoder(speech(), LENGTHS, frames))
    assert again.frozen_key() == encoder.frozen_key()


@pytest.mark.parametrize("what", ["no head", "another type", "no folder", "no config"])
def test_a_wrong_source_is_refused(what: str, hubert_source: Path, ctc_source: Path, tmp_path: Path) -> None:
    """A network without a CTC head would give the logits of a random one."""
    folder = hubert_source if what == "no head" else tmp_path / "copy"
    if what in ("another type", "no config"):
        shutil.copytree(ctc_source, folder)
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, "model_type": "bert"}))
        if what == "no config":
            (folder / "config.json").unlink()
    with pytest.raises(FaceDiffError, match=r"audio_encoder\.source") as caught:
        CtcEncoder(dim=8, source=str(folder))
    assert str(folder) in str(caught.value)


def test_a_checkpoints_configuration_runs_no_code(encoder: CtcEncoder) -> None:
    config = {**encoder.recogniser.config.to_dict(), "auto_map": {"AutoModelForCTC": "evil--x.Y"}, "model_type": "gpt2"}
    with pytest.raises(FaceDiffError, match=r"audio_encoder\.source"):
        CtcEncoder(dim=8, config=config)
