"""Every number that a paper prints about its training: constructors' defaults and the configs of both methods.

The dual-path paper: section 2.1 (data), 2.2 (setting), 1.2 and 1.3 (encoders), eq. 15 to 18 (losses).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import getitem
from typing import Any

import pytest

from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset
from facediff.metrics import ShannonIndex
from facediff.models import DualPathDiffusion
from facediff.models.audio_encoders import HubertEncoder
from facediff.models.speaker_encoders import TcnGruTransformer
from facediff.utils.hints import defaults
from tests.fakes.parsing import printed_config

CORPORA: dict[str, type[SpeechMotionDataModule]] = {"biwi": Biwi, "vocaset": Vocaset, "mead3d": Mead3D}

MODEL = "model.init_args"
IN_CONFIGS: dict[str, Any] = {
    # What the paper states.
    "trainer.max_epochs": 50,
    "data.init_args.batch_size": 1,
    "data.init_args.max_frames_per_batch": None,
    f"{MODEL}.learning_rate": 1e-4,
    f"{MODEL}.weight_decay": 0.05,
    f"{MODEL}.diffusion_steps": 1000,
    f"{MODEL}.noise_schedule": "squaredcos_cap_v2",
    f"{MODEL}.velocity_weight": 0.003,
    f"{MODEL}.acceleration_weight": 0.003,
    f"{MODEL}.face_weight": 0.0005,
    f"{MODEL}.audio_encoder.class_path": "facediff.models.audio_encoders.HubertEncoder",
    f"{MODEL}.audio_encoder.init_args.source": "facebook/hubert-base-ls960",
    f"{MODEL}.style_encoder.class_path": "facediff.models.speaker_encoders.TcnGruTransformer",
    f"{MODEL}.style_encoder.init_args.dilations": [1, 2, 4, 8, 16],
    f"{MODEL}.style_encoder.init_args.num_layers": 2,
    f"{MODEL}.identity_encoder.class_path": "facediff.models.speaker_encoders.HierarchicalIdentity",
    f"{MODEL}.mesh_encoder.class_path": "facediff.models.mesh_encoders.LinearMeshEncoder",
    f"{MODEL}.fusion.class_path": "facediff.models.fusions.BidirectionalCrossAttention",
    f"{MODEL}.decoder.class_path": "facediff.models.decoders.StyleTransformer",
    f"{MODEL}.sampler.class_path": "facediff.models.samplers.DdpmSampler",
    f"{MODEL}.sampler.init_args.steps": 1000,
    # What it does not mention, so that there is none of it.
    "trainer.precision": "32-true",
    "trainer.gradient_clip_val": None,
    "trainer.accumulate_grad_batches": 1,
    f"{MODEL}.lr_schedule": "constant",
    f"{MODEL}.warmup_steps": 0,
    f"{MODEL}.motion_scale": "none",
    f"{MODEL}.motion_space.class_path": "facediff.models.motion_space.VertexMotion",
    f"{MODEL}.noise_scale": 1.0,
    f"{MODEL}.noise_draws": 1,
    f"{MODEL}.style_tokens": "single",
    f"{MODEL}.identity_dropout": 0.0,
    f"{MODEL}.style_dropout": 0.0,
    f"{MODEL}.invented_speakers": 0.0,
    f"{MODEL}.expressivity": 1.0,
    f"{MODEL}.style_identity_weight": 0.0,
    f"{MODEL}.fusion.init_args.rotary": False,
    f"{MODEL}.decoder.init_args.final_norm": False,
    # Where it is silent: as in the code that it builds on (FaceDiffuser), or whole clips.
    f"{MODEL}.audio_encoder.init_args.frozen_layers": 2,
    f"{MODEL}.protocol": "paper",
    "data.init_args.window": None,
    "data.init_args.reference": "same_subject",
}


STYLE_CONTENT: dict[str, Any] = {
    # Data: FLAME at 30 frames a second, in metres, without eyeballs; 20 frames and those that the kernels need; pairs.
    "data.class_path": "facediff.data.Vocaset",
    "data.init_args.face": "FLAME_masks.pkl:face-left_eyeball-right_eyeball",
    "data.init_args.window": 20,
    "data.init_args.batch_size": 4,
    "data.init_args.max_frames_per_batch": None,
    f"{MODEL}.vertices": "face",
    f"{MODEL}.motion_scale": "none",
    f"{MODEL}.window_context": True,
    f"{MODEL}.aligned_pairs": True,
    f"{MODEL}.aligned_windows": True,
    # Speech: a recogniser's logits, 50 a second; 32 of them around each frame.
    f"{MODEL}.audio_encoder.class_path": "facediff.models.audio_encoders.CtcEncoder",
    f"{MODEL}.speech_rate": 50.0,
    f"{MODEL}.window_seconds": 0.64,
    f"{MODEL}.dim": 64,
    f"{MODEL}.speech_heads": 4,
    f"{MODEL}.speech_layers": 3,
    # Mesh encoders, content, style.
    f"{MODEL}.mesh_encoder.class_path": "facediff.models.mesh_encoders.SpiralMeshEncoder",
    f"{MODEL}.mesh_encoder.init_args.channels": [16, 32, 32],
    f"{MODEL}.mesh_encoder.init_args.factor": 4,
    f"{MODEL}.mesh_encoder.init_args.spiral_length": 12,
    f"{MODEL}.mesh_encoder.init_args.dilation": 1,
    f"{MODEL}.content_dim": 64,
    f"{MODEL}.content_scale": "free",
    f"{MODEL}.style_encoder.class_path": "facediff.models.speaker_encoders.LstmStyle",
    f"{MODEL}.style_encoder.init_args.style_dim": 32,
    f"{MODEL}.style_encoder.init_args.num_layers": 1,
    f"{MODEL}.style_encoder.init_args.pooling": "last",
    f"{MODEL}.style_source": "person",
    # Decoder.
    f"{MODEL}.decoder_channels": [64, 128, 256],
    f"{MODEL}.decoder_kernels": [5, 3, 3],
    f"{MODEL}.decoder_hidden": [256, 256, 128],
    f"{MODEL}.basis_size": 50,
    # Objective.
    f"{MODEL}.reconstruction_weight": 1.0,
    f"{MODEL}.swap_weight": 3.0,
    f"{MODEL}.cycle_weight": 1.0,
    f"{MODEL}.speech_weight": 2.0,
    f"{MODEL}.recording_content_weight": 5.0,
    f"{MODEL}.identity_style_weight": 1.0,
    f"{MODEL}.speech_content_weight": 5.0,
    f"{MODEL}.position_weight": 1.0,
    f"{MODEL}.velocity_weight": 5.0,
    f"{MODEL}.lip_gap_weight": 1.0,
    f"{MODEL}.swap_region": "lower_face",
    # What is not published, so that there is none of it.
    f"{MODEL}.swap_dynamics_weight": 0.0,
    f"{MODEL}.content_pull": "squared",
    f"{MODEL}.style_pull": "squared",
    f"{MODEL}.speech_style": "own",
    "trainer.gradient_clip_val": None,
    "trainer.accumulate_grad_batches": 1,
    "trainer.precision": "32-true",
    # Adam: AdamW without decay.
    "trainer.max_epochs": 200,
    f"{MODEL}.weight_decay": 0.0,
    f"{MODEL}.learning_rate": 1e-4,
    f"{MODEL}.lr_schedule": "exponential",
    f"{MODEL}.lr_decay": 0.9,
    f"{MODEL}.lr_decay_epoch": 30,
    f"{MODEL}.warmup_steps": 0,
}
"""Chai et al., "Personalized Audio-Driven 3D Facial Animation via Style-Content Disentanglement", IEEE TVCG 2024."""

CONFIGS = {**{f"{corpus}_paper": IN_CONFIGS for corpus in CORPORA}, "vocaset_style_content_paper": STYLE_CONTENT}


@pytest.mark.parametrize("name", CONFIGS)
def test_published_configs_have_every_published_number(name: str) -> None:
    config = printed_config("--config", f"configs/experiment/{name}.yaml")
    found = {path: reduce(getitem, path.split("."), config) for path in CONFIGS[name]}
    assert {path: value for path, value in found.items() if value != CONFIGS[name][path]} == {}
    corpus = name.partition("_")[0]
    assert config["data"]["class_path"].rpartition(".")[2] == CORPORA[corpus].__name__
    assert config["data"]["init_args"].get("split") == ("both" if corpus == "mead3d" else None)
    callbacks = [callback["class_path"].rpartition(".")[2] for callback in config["trainer"]["callbacks"]]
    assert not [callback for callback in callbacks if "Averaging" in callback or "Ema" in callback]
    assert ("SpeechFeatureCache" in callbacks) == (CONFIGS[name] is STYLE_CONTENT)


DEFAULTS: list[tuple[Callable[..., Any], str, Any]] = [
    (DualPathDiffusion, "learning_rate", 1e-4),
    (DualPathDiffusion, "weight_decay", 0.05),
    (DualPathDiffusion, "lr_schedule", "constant"),
    (DualPathDiffusion, "diffusion_steps", 1000),
    (DualPathDiffusion, "noise_schedule", "squaredcos_cap_v2"),
    (DualPathDiffusion, "velocity_weight", 0.003),
    (DualPathDiffusion, "acceleration_weight", 0.003),
    (DualPathDiffusion, "face_weight", 0.0005),
    (DualPathDiffusion, "protocol", "paper"),
    (TcnGruTransformer, "dilations", (1, 2, 4, 8, 16)),
    (TcnGruTransformer, "num_layers", 2),
    (HubertEncoder, "frozen_layers", 2),
    (ShannonIndex, "clusters", 40),
    (HubertEncoder, "source", "facebook/hubert-base-ls960"),
    (Biwi, "batch_size", 1),
    (Vocaset, "batch_size", 1),
    (Mead3D, "batch_size", 1),
]


@pytest.mark.parametrize(("owner", "option", "published"), DEFAULTS)
def test_defaults_of_constructors_are_the_published_numbers(
    owner: Callable[..., Any], option: str, published: object
) -> None:
    assert defaults(owner)[option] == published


@pytest.mark.parametrize(
    ("corpus", "frame_rate", "vertices", "speakers", "clips"),
    [
        ("biwi", 25.0, 23370, 6, {"train": 192, "val": 24, "test_a": 24, "test_b": 32}),
        ("vocaset", 30.0, 5023, 8, {"train": 320, "val": 40, "test_b": 40}),
        ("mead3d", 25.0, 5023, 32, {}),
    ],
)
def test_facts_of_the_corpora(
    corpus: str, frame_rate: float, vertices: int, speakers: int, clips: dict[str, int]
) -> None:
    data = CORPORA[corpus]
    assert (data.frame_rate, data.n_vertices, len(data.identities)) == (frame_rate, vertices, speakers)
    assert {split: len(names) for split, names in data.expected_clips().items()} == clips
    assert Vocaset.stored_frame_rate == 60.0
