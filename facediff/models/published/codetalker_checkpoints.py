"""CodeTalker's checkpoints as its authors distribute them: two files, one for each stage.

The file of the second stage lacks the prior, since their training takes it out of what it saves.
"""

from __future__ import annotations

from typing import Any

import torch

from facediff.errors import FaceDiffError
from facediff.models.published.autoregressive import decoder_sizes, read_period
from facediff.models.published.codetalker import CodeTalker
from facediff.models.published.faceformer import LAYER_NAMES
from facediff.models.published.recognition import AuthorsWeights, CheckpointFacts, Recogniser, register

HALF_NAMES = (
    ("squasher.0.0", "smooth"),
    ("expander.0.0", "smooth"),
    ("encoder_linear_embedding.net", "embed"),
    ("decoder_linear_embedding.net", "embed"),
)
"""What the maps of a half are called by the authors, and here."""

BLOCK_NAMES = (
    {"fn.norm": "attention_norm", "fn.fn.to_qkv": "project", "fn.fn.to_out": "out"},
    {"fn.norm": "hidden_norm", "fn.fn.l1": "first", "fn.fn.l2": "second"},
)
"""The same for attention and feed-forward layers, which take turns in the authors' numbering."""


def convert_prior(weights: AuthorsWeights, prefix: str = "") -> dict[str, Any]:
    """The first stage's tensors under the names of this file, and its options."""
    codes, token_dim = weights.shape(f"{prefix}quantize.embedding.weight")
    dim, _ = weights.shape(f"{prefix}encoder.vertice_mapping.0.weight")
    hidden, _ = weights.shape(f"{prefix}encoder.encoder_transformer.net.1.fn.fn.l1.weight")
    kernel = weights.shape(f"{prefix}encoder.squasher.0.0.weight", 3)[2]
    maps = f"{prefix}encoder.encoder_linear_embedding_post.net.weight" in weights
    width = weights.shape(f"{prefix}encoder.encoder_linear_embedding_post.net.weight")[0] if maps else dim
    if width % token_dim:
        raise FaceDiffError(
            f"{weights.source}: its frames have {width} channels and its codes {token_dim}, which does not go into "
            f"them; it is a variant of CodeTalker"
        )
    for half in ("encoder", "decoder"):
        check_positions(weights, f"{prefix}{half}.{half}_pos_embedding.pe")
        own = f"{prefix}{half}."
        for name in weights.names(f"{own}{half}_transformer.net."):
            place, _, rest = name.removeprefix(f"{own}{half}_transformer.net.").partition(".")
            part, _, kind = rest.rpartition(".")
            # The authors number attention (even) and feed-forward layers (odd) in one list.
            number = int(place) if place.isdecimal() else -1
            if part not in BLOCK_NAMES[number % 2] or number < 0:
                raise FaceDiffError(
                    f"{weights.source}: holds the tensor {name}, which CodeTalker has no place for; it is a variant of "
                    f"the method"
                )
            weights.move(name, f"prior.{half}.blocks.{number // 2}.{BLOCK_NAMES[number % 2][part]}.{kind}")
        for old, new in HALF_NAMES:
            weights.move_all(f"{own}{old}.", f"prior.{half}.{new}.")
    weights.move_all(f"{prefix}encoder.vertice_mapping.0.", "prior.motion_in.")
    weights.move_all(f"{prefix}encoder.encoder_linear_embedding_post.net.", "prior.to_tokens.")
    weights.move_all(f"{prefix}decoder.decoder_linear_embedding_pre.net.", "prior.from_tokens.")
    weights.move_all(f"{prefix}decoder.vertice_map_reverse.", "prior.motion_out.")
    weights.move(f"{prefix}quantize.embedding.weight", "prior.codebook")
    blocks = [name for name in weights.renamed if name.startswith("prior.encoder.blocks.")]
    return {
        "prior_dim": dim,
        "prior_layers": 1 + max(int(name.split(".")[3]) for name in blocks),
        "prior_feed_forward_dim": hidden,
        "kernel": kernel,
        "tokens": width // token_dim,
        "token_dim": token_dim,
        "codes": codes,
        "token_maps": maps,
        "out_bias": "prior.motion_out.bias" in weights.renamed,
    }


def check_positions(weights: AuthorsWeights, name: str) -> None:
    """Leave out a table of positions, of which the published code uses the first row, once it is seen to be one.

    Raises:
        FaceDiffError: if it is anything else.
    """
    if name not in weights:
        return
    *_, width = weights.shape(name, 3)
    table, expected = weights.get(name).flatten(0, 1).float(), torch.zeros(width)
    expected[1::2] = 1.0
    if not torch.allclose(table[0], expected, rtol=0, atol=1e-5):
        raise FaceDiffError(
            f"{weights.source}: its table of positions {name} is not what the published formula gives; the checkpoint "
            f"is of a variant of the method"
        )
    weights.ignore(name, "the table of positions is computed by its formula")


def convert(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """CodeTalker's tensors of both stages, and its options."""
    stage_one = [name for prefix in ("encoder.", "decoder.", "quantize.") for name in weights.names(prefix)]
    inside = bool(weights.names("autoencoder."))
    if inside:
        for name in stage_one:
            weights.ignore(name, "the file of the second stage holds a prior of its own")
    elif "quantize.embedding.weight" not in weights:
        raise FaceDiffError(
            f"{weights.source}: is CodeTalker's second stage without the first, whose prior it needs; give both files, "
            f"such as vocaset_stage1.pth.tar and vocaset_stage2.pth.tar"
        )
    options = convert_prior(weights, "autoencoder." if inside else "")
    dim, _ = weights.shape("audio_feature_map.weight")
    period = read_period(weights, "PPE.pe", facts)
    encoder = weights.backbone("audio_encoder.", kind="wav2vec2", facts=facts, **CodeTalker.encoder_settings())
    for old, new in (("audio_feature_map", "audio_map"), ("vertice_map", "motion_in"), ("feat_map", "out")):
        weights.move_all(f"{old}.", f"network.{new}.")
    weights.move("learnable_style_emb.weight", "network.style.weight")
    weights.move_all("transformer_decoder.layers.", "network.decoder.layers.", LAYER_NAMES)
    sizes = decoder_sizes(weights, "transformer_decoder.", dim)
    return {**options, "audio_encoder": encoder, **sizes, "period": period}


def convert_stage_one(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """A prior alone, on which a predictor can be trained."""
    return {"stage": "prior", **convert_prior(weights)}


LICENCE: dict[str, Any] = {
    "licence": "unknown: no statement on the weights, whose code is under MIT and whose data is for research",
    "licence_source": "github.com/Doubiiu/CodeTalker",
}

register(
    Recogniser(
        method="CodeTalker",
        marks=("learnable_style_emb.weight", "feat_map.weight", "vertice_map.weight"),
        unless=(),
        convert=convert,
        vertices=lambda weights: weights.shape("vertice_map.weight")[1] // 3,
        count=lambda weights: weights.shape("learnable_style_emb.weight")[0],
        **LICENCE,
    )
)
register(
    Recogniser(
        method="CodeTalker",
        marks=("quantize.embedding.weight", "encoder.vertice_mapping.0.weight", "decoder.vertice_map_reverse.weight"),
        unless=("learnable_style_emb.", "feat_map.", "vertice_map."),
        convert=convert_stage_one,
        vertices=lambda weights: weights.shape("decoder.vertice_map_reverse.weight")[0] // 3,
        count=lambda weights: 0,
        **LICENCE,
    )
)
