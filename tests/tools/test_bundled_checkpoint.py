"""The bundled model read back: what a folder's graphs hold becomes the weights that they were made of."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.dual_path.network import StepEmbedding
from facediff.pipelines.export_model import export_model
from tests.fakes.tiny import Tiny
from tests.runtime.test_runtime import ready
from tools import bundled_checkpoint

RECIPE: dict[str, Any] = {
    **{"dim": 128, "style_tokens": "levels", "style_from_speech": True, "style_identity_weight": 0.003},
    "audio_encoder": partial(registry.audio_encoder.mel, num_layers=1),
    "identity_encoder": registry.identity_encoder.hierarchical,
    "motion_space": partial(registry.motion_space.components, count=6, prior_frames=7),
    "mesh_encoder": partial(registry.mesh_encoder.components, count=6),
    "style_encoder": partial(registry.style_encoder.tcn_gru_transformer, dilations=(1,), num_layers=1, statistics=True),
    "decoder": partial(registry.decoder.style_transformer, num_layers=1),
}
"""The bundled model's parts and widths, with one layer of each: graphs hold smaller ones in other forms."""


def model_of(seed: int, root: Path) -> DualPathDiffusion:
    model = ready(root, **RECIPE)
    assert isinstance(model, DualPathDiffusion)
    model.measure(Tiny(root=str(root)))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in model.parameters():
            weight.add_(0.1 * torch.randn(weight.shape, generator=generator))
    return model


def test_a_network_of_step_embeddings_is_found_by_its_table() -> None:
    torch.manual_seed(0)
    network, other, steps = StepEmbedding(8), StepEmbedding(8), torch.arange(100)
    with torch.no_grad():
        table = network(steps)
        weights = bundled_checkpoint.fitted(other, table)
        other.load_state_dict({name.removeprefix("network.step_embedding."): w for name, w in weights.items()})
        assert float((other(steps) - table).square().mean().sqrt() / table.std()) < 0.01


def test_gates_in_the_order_of_onnx() -> None:
    # ONNX: update (z), reset (r), hidden (h); PyTorch: reset, update, new.
    assert bundled_checkpoint.gates(torch.tensor([1.0, 1, 2, 2, 3, 3])).tolist() == [2, 2, 1, 1, 3, 3]


@pytest.mark.slow
def test_a_folder_gives_back_the_weights(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of two identities, what they add is a small table in the graph.
    monkeypatch.setattr(bundled_checkpoint, "WITHOUT", (*bundled_checkpoint.WITHOUT, "network.identity_encoder."))
    trained, template = (model_of(seed, tiny_root) for seed in (1, 2))
    wanted = {name: value.clone() for name, value in trained.state_dict().items()}
    export_model(trained, tmp_path / "folder", precision="float16")
    found = bundled_checkpoint.weights_of(template, tmp_path / "folder")
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        if not name.startswith((*bundled_checkpoint.WITHOUT, "network.step_embedding.")):
            np.testing.assert_allclose(found[name], value, rtol=1e-3, atol=1e-6, err_msg=name)
    file = tmp_path / "folder" / "speech.onnx"
    document = onnx.load(file)
    document.graph.initializer.append(numpy_helper.from_array(np.ones(3, np.float32), "more"))
    onnx.save(document, file)
    with pytest.raises(FaceDiffError, match="another model"):
        bundled_checkpoint.weights_of(template, tmp_path / "folder")
