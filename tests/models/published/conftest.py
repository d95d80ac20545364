"""A tiny model of each published method; a new one is tested by being registered."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from facediff import registry
from facediff.models import AnimationModel
from facediff.models.layers import Heads, Layers, Width
from facediff.models.published.importing import save_model
from facediff.utils.hints import options_of
from tests.fakes.tiny import RATE, SEEN, VERTICES

MEL = partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1, dropout=0.0)
SIZES = {"n_vertices": VERTICES, "identities": SEEN, "frame_rate": float(RATE)}

TEXT: dict[str, Any] = {
    "model_type": "wav2vec2",
    "hidden_size": 8,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "intermediate_size": 8,
    "conv_dim": [4] * 7,
    "num_conv_pos_embeddings": 4,
    "num_conv_pos_embedding_groups": 2,
    "vocab_size": 6,
}
"""A tiny speech recogniser of random weights."""

SMALL: list[tuple[str, object, int]] = [("dim", Width, 16), ("layers", Layers, 1), ("heads", Heads, 2)]
"""Sizes of tiny networks by the ends of their options' names and their types."""

EXTRA: dict[str, dict[str, Any]] = {
    "CodeTalker": {"tokens": 2, "token_dim": None, "codes": 8},
    "EmoTalk": {"emotion_config": TEXT, "emotion_dim": 4, "level_dim": 2, "person_dim": 2},
    "FaceDiffuser": {"diffusion_steps": 8},
    # So that the lip reader's terms count in whatever is tested.
    "SelfTalk": {"text_config": TEXT, "consistency_weight": 1.0, "ctc_weight": 1.0},
    "DiffSpeaker": {"sampling_steps": 8, "smooth": True},
    "Voca": {"components": 8, "channels": (8, 8)},
    "DiffPoseTalk": {"num_layers": 2, "window_frames": 12, "context": 3, "diffusion_steps": 4, "dropout": 0.0},
    "ARTalk": {"scales": (1, 3, 12), "code_dim": 4},
    "UniTalker": {"components": 0},
}
"""Options that follow from no name and type."""


def tiny(name: str) -> dict[str, Any]:
    """Options by which a published method is small: every width, number of layers and number of heads."""
    options: dict[str, Any] = {"audio_encoder": MEL, "audio_dim": 16}
    for option, parameter in options_of(registry.model.get(name)).items():
        for end, hint, size in SMALL:
            if option.endswith(end) and parameter.annotation in (hint, hint | None):
                options[option] = size
    return options | EXTRA.get(name, {})


METHODS: dict[str, dict[str, Any]] = {
    entry.name: tiny(entry.name)
    for entry in registry.model
    if entry.implementation.__module__.startswith("facediff.models.published.")
}
"""Options by which each published method is small."""

MakeMethod = Callable[..., AnimationModel]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Every method, so that a new one is tested by existing; of what takes seconds for each, two in the quick suite."""
    if "method" in metafunc.fixturenames:
        quick = QUICK if metafunc.definition.get_closest_marker("two_methods") else METHODS
        metafunc.parametrize(
            "method", [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in METHODS]
        )


QUICK = ("DiffSpeaker", "FaceFormer")


@pytest.fixture(scope="session")
def prior_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of CodeTalker's prior, on which its predictor is trained."""
    from tests.models.published.test_laws import with_assets

    torch.manual_seed(7)
    options = {**SIZES, **METHODS["CodeTalker"], "stage": "prior"}
    path = tmp_path_factory.mktemp("prior") / "prior.ckpt"
    save_model(with_assets(registry.model.get("CodeTalker")(**options)), path)
    return path


@pytest.fixture
def make_method(prior_file: Path) -> MakeMethod:
    """A small model by name, with reproducible weights; what starts at zero is random too."""

    def make(name: str, seed: int = 0, **options: Any) -> AnimationModel:  # noqa: ANN401
        torch.manual_seed(seed)
        if name == "CodeTalker" and options.get("stage") != "prior":
            options = {"prior": str(prior_file), **options}
        model: AnimationModel = registry.model.get(name)(**{**SIZES, **METHODS[name], **options})
        for parameter in model.parameters():
            if parameter.requires_grad and not parameter.any():
                torch.nn.init.normal_(parameter, std=0.1)
        return model

    return make
