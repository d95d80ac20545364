"""The sizes and settings of the authors' networks are those that an option has which nobody names.

What a checkpoint's tensors say, importing takes from them; heads, temperatures and scales are in no tensor, and the
bundled configs leave most options out.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from facediff import registry
from facediff.models.audio_encoders import MelEncoder
from facediff.utils.hints import defaults

STYLE_ENCODER = {"style_dim": 128, "style_layers": 4, "style_heads": 4}
PUBLISHED: dict[str, dict[str, Any]] = {
    "FaceFormer": {"num_layers": 1, "num_heads": 4},
    "CodeTalker": {
        "num_heads": 4,
        "prior_dim": 1024,
        "prior_layers": 6,
        "prior_heads": 8,
        "prior_feed_forward_dim": 1536,
        "codes": 256,
        "leak": 0.2,
    },
    "FaceDiffuser": {"num_layers": 2, "dropout": 0.3},
    "DiffSpeaker": {"num_layers": 1, "num_heads": 4},
    "SelfTalk": {"num_layers": 1, "num_heads": 4, "lip_layers": 6, "lip_feed_forward_dim": 2048},
    "TalkingStyle": {"num_layers": 6, "num_heads": 4},
    "Voca": {"dim": 128, "components": 50, "channels": (32, 32, 64, 64)},
    "EmoTalk": {"dim": 832, "emotion_dim": 256, "level_dim": 32, "person_dim": 32, "num_layers": 1, "num_heads": 4}
    | {"levels": 2, "level": 1},
    "LamAudio2Expression": {"dim": 512, "identity_dim": 64, "num_heads": 8},
    "UniTalker": {"dim": 256, "style_dim": 64, "num_heads": 4, "dropout": 0.1},
    "DiffPoseTalk": STYLE_ENCODER
    | {"dim": 512, "num_layers": 8, "num_heads": 8, "window_frames": 100, "context": 10, "diffusion_steps": 500}
    | {"conditions": ("audio", "style"), "guidance": "incremental", "audio_scale": 1.15, "style_scale": 3.0},
    "ARTalk": STYLE_ENCODER
    | {"dim": 768, "num_layers": 12, "num_heads": 12, "scales": (1, 5, 25, 50, 100), "code_dim": 32}
    | {"codec_dim": 512, "codec_layers": 8, "codec_heads": 8, "style_scale": 1.1}
    | {"smooth": True, "still_jaw": True},
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_options_that_are_not_named_are_as_published(name: str) -> None:
    own = defaults(registry.model.get(name))
    assert {option: own[option] for option in PUBLISHED[name]} == PUBLISHED[name]


LAYERS = "network.decoder.layers"


@pytest.mark.parametrize(
    ("name", "weight", "biwi", "vocaset"),
    [
        ("FaceFormer", f"{LAYERS}.0.first.weight", (256, 128), (128, 64)),
        ("TalkingStyle", f"{LAYERS}.5.first.weight", (256, 128), (128, 64)),
        ("CodeTalker", f"{LAYERS}.5.first.weight", (2048, 1024), (2048, 1024)),
        ("CodeTalker", f"{LAYERS}.6.first.weight", (2048, 1024), None),
        ("CodeTalker", f"{LAYERS}.11.first.weight", (2048, 1024), None),
        ("CodeTalker", f"{LAYERS}.12.first.weight", None, None),
        ("CodeTalker", "prior.codebook", (256, 128), (256, 64)),
        ("FaceDiffuser", "network.gru.weight_ih_l0", (3 * 512, 3 * 512), (3 * 256, 3 * 256)),
        ("FaceDiffuser", "network.step.weight", (512, 500), (256, 1000)),
        ("DiffSpeaker", "network.motion_in.weight", (1024, 12), (512, 12)),
        ("SelfTalk", f"{LAYERS}.0.linear1.weight", (2048, 1024), (1024, 512)),
    ],
)
def test_sizes_follow_the_data_set(
    name: str, weight: str, biwi: tuple[int, ...] | None, vocaset: tuple[int, ...] | None
) -> None:
    """The frame rate tells which of the two it is."""
    options: dict[str, Any] = {"n_vertices": 4, "identities": ["A"], "audio_encoder": MelEncoder, "audio_dim": 8}
    options |= {"lip_reader": "none"} if name == "SelfTalk" else {}
    for rate, shape in ((25.0, biwi), (30.0, vocaset)):
        with torch.device("meta"):
            weights = registry.model.get(name)(frame_rate=rate, **options).state_dict()
        assert (tuple(weights[weight].shape) if weight in weights else None) == shape
