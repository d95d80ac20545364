"""The paper's configs train and validate, on corpora and a HuBERT in miniature: what the trainer and the model get."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from facediff.callbacks import EmaWithWarmup
from facediff.cli.lightning import run_cli
from facediff.data.vocaset import TRAIN
from facediff.data.vocaset import VALIDATION as HELD_OUT
from facediff.models import DualPathDiffusion
from tests.fakes.mini import write

CORPORA: dict[str, tuple[str, list[str], set[str]]] = {
    "biwi": ("MiniBiwi", ["F2_e01", "F2_e02", "F2_e33"], {"F2"}),
    "vocaset": (
        "MiniVocaset",
        [f"{TRAIN[0]}_sentence01", f"{TRAIN[0]}_sentence02", f"{HELD_OUT[0]}_sentence01", f"{HELD_OUT[0]}_sentence21"],
        {TRAIN[0], HELD_OUT[0]},
    ),
    "mead3d": (
        "MiniMead",
        ["M003_001_0_0", "M003_002_0_0", "M003_033_0_0", "M003_034_0_0"],
        {"M003"},
    ),
}


@pytest.mark.parametrize(
    "corpus", [name if name == "biwi" else pytest.param(name, marks=pytest.mark.slow) for name in CORPORA]
)
def test_paper_configs_train_and_validate(
    corpus: str, hubert_source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, clips, speakers = CORPORA[corpus]
    root = write(tmp_path / corpus, clips, speakers, frames=8)
    small = ["--model.dim=16", "--model.diffusion_steps=20", "--model.sampler.steps=20", "--data.num_workers=0"]
    words = ["--config", f"configs/experiment/{corpus}_paper.yaml", f"--data=tests.fakes.mini.{kind}"]
    words += [f"--data.root={root}", f"--model.audio_encoder.source={hubert_source}", "--trainer.accelerator=cpu"]
    words += ["--trainer.fast_dev_run=1", "--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
    monkeypatch.chdir(Path(__file__).parents[2])
    made = run_cli("fit", [*words, *small])
    trainer, model, data = made.trainer, made.model, made.datamodule

    assert isinstance(model, DualPathDiffusion)
    assert data.frame_rate == (30.0 if corpus == "vocaset" else 25.0)
    assert [batch.motion.shape[0] for batch in data.train_dataloader()] == [1, 1]  # single clips, never padded
    assert (trainer.precision, trainer.gradient_clip_val) == ("32-true", None)
    assert not any(isinstance(callback, EmaWithWarmup) for callback in trainer.callbacks)
    (group,) = trainer.optimizers[0].param_groups
    assert (type(trainer.optimizers[0]), group["lr"], group["weight_decay"]) == (torch.optim.AdamW, 1e-4, 0.05)
    assert not trainer.lr_scheduler_configs
    assert {"val/mve", "val/lve", "val/fdd", "val/loss"} <= trainer.callback_metrics.keys()
    # MVE and LVE to the letter of the text: the largest error of a frame is at least the mean one.
    text = [float(v) for k, v in trainer.callback_metrics.items() if k.startswith("val/mean_vertex_error")]
    assert text[0] > float(trainer.callback_metrics["val/mve"])

    network = model.network
    assert model.scale == 1.0
    assert len(network.style_tokens.projections) == 1
    assert isinstance(network.decoder.norm, nn.Identity)
    assert network.fusion.motion_from_audio.rotary is None
    assert len(model.sampler.timesteps) == model.process.steps
    assert data.find_split(data.corpus.clips[clips[-1]]) == "val"
