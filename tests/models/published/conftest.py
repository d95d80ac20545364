"""A tiny model of each published method; a method more is one entry more, and is tested by it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from facediff import registry
from facediff.models import AnimationModel
from facediff.models.published.importing import save_model
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

METHODS: dict[str, dict[str, Any]] = {
    "FaceFormer": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16},
    "CodeTalker": {
        **{"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "num_layers": 1, "prior_dim": 16, "prior_layers": 1},
        **{"prior_heads": 2, "prior_feed_forward_dim": 24, "tokens": 2, "codes": 8},
    },
    "EmoTalk": {
        **{"audio_encoder": MEL, "emotion_config": TEXT, "audio_dim": 16, "dim": 16},
        **{"emotion_dim": 4, "level_dim": 2, "person_dim": 2},
    },
    "FaceDiffuser": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "diffusion_steps": 8},
    "SelfTalk": {
        "audio_encoder": MEL,
        "audio_dim": 16,
        "dim": 16,
        "text_config": TEXT,
        "lip_layers": 1,
        "lip_feed_forward_dim": 16,
        # So that the lip reader's terms count in whatever is tested.
        "consistency_weight": 1.0,
        "ctc_weight": 1.0,
    },
    "TalkingStyle": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "num_layers": 1},
    "DiffSpeaker": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "sampling_steps": 8, "smooth": True},
    "Voca": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "components": 8, "channels": (8, 8)},
    "LamAudio2Expression": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "identity_dim": 4},
    "DiffPoseTalk": {
        **{"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "num_layers": 2, "num_heads": 2, "style_dim": 8},
        **{
            "style_layers": 1,
            "style_heads": 2,
            "window_frames": 12,
            "context": 3,
            "diffusion_steps": 4,
            "dropout": 0.0,
        },
    },
    "ARTalk": {
        **{"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "num_layers": 1, "num_heads": 2, "scales": (1, 3, 12)},
        **{"code_dim": 4, "codec_dim": 8, "codec_layers": 1, "codec_heads": 2, "style_dim": 8, "style_layers": 1},
        **{"style_heads": 2},
    },
    "UniTalker": {"audio_encoder": MEL, "audio_dim": 16, "dim": 16, "style_dim": 4, "components": 0},
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
