"""Every published number of the second method: constructors' defaults and the config that trains as published.

Chai et al., "Personalized Audio-Driven 3D Facial Animation via Style-Content Disentanglement", IEEE TVCG 2024.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import pytest
import yaml

from facediff.cli.app import main

MODEL, DATA = "model.init_args", "data.init_args"
CONFIG: dict[str, Any] = {
    # Data: FLAME at 30 frames a second, in metres, without eyeballs; 20 frames and those that the kernels need; pairs.
    "data.class_path": "facediff.data.Vocaset",
    f"{DATA}.face": "FLAME_masks.pkl:face-left_eyeball-right_eyeball",
    f"{DATA}.window": 20,
    f"{DATA}.batch_size": 4,
    f"{DATA}.max_frames_per_batch": None,
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


def test_the_published_config_has_every_number() -> None:
    printed = io.StringIO()
    words = ["fit", "--config", "configs/experiment/vocaset_style_content_paper.yaml", "--print_config"]
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
        main(words)
    composed = yaml.safe_load(printed.getvalue())
    found = {}
    for path in CONFIG:
        value: Any = composed
        for key in path.split("."):
            value = value[key]
        found[path] = value
    assert {path: value for path, value in found.items() if value != CONFIG[path]} == {}
    callbacks = [callback["class_path"].rpartition(".")[2] for callback in composed["trainer"]["callbacks"]]
    assert "SpeechFeatureCache" in callbacks
    assert not [name for name in callbacks if "Averaging" in name or "Ema" in name]
