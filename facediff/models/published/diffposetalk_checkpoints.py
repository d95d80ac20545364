"""DiffPoseTalk's released files: the denoiser's checkpoint, the style encoder's, and the statistics of motion."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from facediff.errors import OptionError
from facediff.models.published.clip_style import convert_style
from facediff.models.published.diffposetalk import DiffPoseTalk
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.parametric import statistics_of
from facediff.models.published.recognition import AuthorsWeights, CheckpointFacts, FaceFacts, Recogniser, register
from facediff.spaces.layouts import layout
from facediff.utils.arrays import open_array, read_arrays

RENAMES = (
    ("PE", "positions"),
    ("person_proj.", "person_in."),
    ("diff_step_map.", "step_map."),
    ("feature_proj.", "motion_in."),
    ("transformer.", "transformer."),
    ("motion_dec.", "motion_out."),
)


def convert(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """DiffPoseTalk's tensors under the names of this file, and its options."""
    said = weights.arguments("start_motion_feat")
    _, context, channels = weights.shape("start_motion_feat", 3)
    _, positions, dim = weights.shape("denoising_net.PE", 3)
    _, person_dim = weights.shape("denoising_net.person_proj.weight")
    _, frame_dim = weights.shape("denoising_net.feature_proj.weight")
    style_dim = weights.shape("null_style_feat", 3)[2]
    if str(said.get("target", "sample")) != "sample":
        raise OptionError.naming(f"{weights.source}: it predicts {said['target']}; expected a model of clean motion")
    kind: Literal["wav2vec2", "hubert"] = "wav2vec2" if said.get("audio_model") == "wav2vec2" else "hubert"
    encoder = weights.backbone("audio_encoder.", kind=kind, facts=facts, **DiffPoseTalk.encoder_settings())
    for old, new in RENAMES:
        weights.move_all(f"denoising_net.{old}", f"network.{new}")
    for old, new in (
        ("start_audio_feat", "start_audio"),
        ("start_motion_feat", "start_motion"),
        ("null_audio_feat", "no_audio"),
        ("null_style_feat", "no_style"),
        ("diffusion_sched.alphas", "process.alphas"),
        ("diffusion_sched.alpha_bars", "process.signal"),
        ("diffusion_sched.sigmas_inflex", "process.deviations"),
    ):
        weights.move(old, new)
    weights.move_all("audio_feature_map.", "audio_map.")
    weights.ignore("denoising_net.TE.pe", "sinusoids, which the authors make anew as well")
    weights.ignore("diffusion_sched.betas", "follows from the other variances")
    weights.ignore("diffusion_sched.sigmas_flex", "deviations of a sampler with more noise, which nothing uses")
    mask = "denoising_net.alignment_mask"
    width = int((~weights.get(mask).bool())[1:2].sum()) if mask in weights and weights.shape(mask) else 0
    weights.ignore(mask, "follows from the number of frames")
    for name, value in facts.details.items():
        weights.add(name, value)
    style_said = weights.arguments(next(name for name in weights.tensors if name.endswith("motion_proj.weight")))
    rows = convert_style(weights, "", "style_encoder.")
    options: dict[str, Any] = {
        "audio_encoder": encoder,
        "dim": dim,
        "num_layers": count_layers(weights, "denoising_net.transformer.layers."),
        "feed_forward_dim": weights.shape("denoising_net.transformer.layers.0.linear1.weight")[0],
        "style_dim": style_dim,
        "style_layers": count_layers(weights, "transformer.layers.", "encoder.transformer.layers."),
        "style_rows": rows,
        "window_frames": positions - context - 1,
        "context": context,
        "diffusion_steps": weights.shape("diffusion_sched.alphas", 1)[0] - 1,
        "indicator": frame_dim > channels,
        "memory_width": width,
        "head": channels >= 54,
        "shape_dim": person_dim - style_dim,
    }
    for theirs, ours, where in (
        ("n_heads", "num_heads", said),
        ("n_heads", "style_heads", style_said),
        ("pad_mode", "padding", said),
        ("cfg_mode", "guidance", said),
    ):
        if where.get(theirs) is not None:
            options[ours] = where[theirs]
    guiding = said.get("guiding_conditions")
    if isinstance(guiding, str):
        options["conditions"] = [name for name in ("audio", "style") if name in guiding.split(",")]
    return options


def faces_of(weights: AuthorsWeights, options: ImportOptions) -> FaceFacts:
    """One speaker, or those whose shapes are given, and the statistics by which shapes and motion are standardised.

    Raises:
        FaceDiffError: if a file cannot be read, or does not fit.
    """
    _, person_dim = weights.shape("denoising_net.person_proj.weight")
    count = person_dim - weights.shape("null_style_feat", 3)[2]
    statistics, given = options.statistics, options.templates
    if statistics is None:
        raise OptionError.naming(
            f"{{statistics}}: {weights.source} lacks the statistics of its training motion; give its authors' "
            f"stats_train.npz"
        )
    if not isinstance(statistics, Mapping):
        statistics = read_arrays(Path(statistics), STATISTICS, remedy="expected stats_train.npz of DiffPoseTalk")
    motion, deviation = statistics_of(statistics, ("exp", "pose"))
    mean_shape, shape_deviation = statistics_of(statistics, ("shape",))
    if len(motion) != 56 or len(mean_shape) != count:
        raise OptionError.naming(
            f"{{statistics}}: has {len(motion)} numbers of motion and {len(mean_shape)} of shape; expected 56 (exp 50, "
            f"pose 6) and {count}"
        )
    if given is None:
        shapes = {"speaker": torch.zeros(count)}
    elif isinstance(given, Mapping):
        shapes = {str(name): torch.as_tensor(value).float() for name, value in given.items()}
    else:
        path = Path(given)
        content = open_array(path) if path.suffix == ".npy" else read_arrays(path, ("shape",))["shape"]
        shapes = {path.stem: torch.tensor(np.asarray(content)).float()}
    rows = {name: value[0] if value.dim() == 2 else value for name, value in shapes.items()}
    if not rows or any(row.shape != (count,) for row in rows.values()):
        raise OptionError.naming(f"{{templates}}: expected {count} coefficients of FLAME's shape for every speaker")
    space = layout("flame_diffposetalk")
    rest = torch.zeros(len(space.channels), 1)
    details = {
        "motion_mean": motion,
        "motion_std": deviation,
        "shapes": (torch.stack([*rows.values()]) - mean_shape) / shape_deviation,
    }
    return FaceFacts("HDTF_TFHP", space, 25.0, list(rows), len(rest), dict.fromkeys(rows, rest), details=details)


STATISTICS = tuple(f"{key}_{name}" for key in ("exp", "pose", "shape") for name in ("mean", "std"))


def count_layers(weights: AuthorsWeights, *prefixes: str) -> int:
    """Layers whose tensors' names begin so."""
    return len({name.removeprefix(old).partition(".")[0] for old in prefixes for name in weights.names(old)})


register(
    Recogniser(
        method="DiffPoseTalk",
        marks=("denoising_net.person_proj.weight", "start_motion_feat", "null_style_feat"),
        unless=(),
        convert=convert,
        vertices=lambda _: 56,
        count=lambda _: 0,
        faces=faces_of,
        reads=("templates", "mesh", "statistics"),
        licence="none stated",
        licence_source="github.com/DiffPoseTalk/DiffPoseTalk",
    )
)
