"""The encoder of the bundled model in PyTorch, against its graph in ONNX Runtime."""

from __future__ import annotations

import numpy as np
import onnxruntime
import torch

from facediff.models.audio_encoders import MelEncoder
from facediff.models.bundled_encoder import GRAPH, BundledEncoder
from facediff.utils.hub import BUNDLED


def test_it_is_the_bundled_models() -> None:
    encoder = BundledEncoder(dim=96).eval()
    audio = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 32_000)).astype(np.float32))
    lengths, frames = torch.tensor([32_000]), torch.tensor([50])
    with torch.no_grad():
        features = MelEncoder.forward(encoder, audio, lengths, frames)
    inputs = {
        "audio": audio.numpy(),
        "mean": audio.mean(1).numpy(),
        "deviation": (audio.var(1, unbiased=False) + 1e-7).sqrt().numpy(),
        "samples": np.array([32_000]),
        "mask": np.ones((1, 50), bool),
    }
    (expected,) = onnxruntime.InferenceSession(str(BUNDLED / GRAPH)).run(["features"], inputs)
    np.testing.assert_allclose(features.numpy(), expected, atol=2e-5)


def test_only_the_convolutions_are_trained() -> None:
    frozen, tuned = BundledEncoder(dim=64), BundledEncoder(dim=64, frozen=False)
    trained = [name for name, weight in frozen.named_parameters() if weight.requires_grad]
    assert trained
    assert all(name.startswith(("trained.", "widen.")) for name in trained)
    assert all(weight.requires_grad for weight in tuned.parameters())
