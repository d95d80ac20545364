"""Training with compiled parts is training without, and leaves no trace in checkpoints."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


PROGRAM = """
import json, sys
from functools import partial
import lightning.pytorch as pl
import torch
from facediff import registry
from facediff.callbacks import CompiledTraining
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import SEEN, VERTICES, Tiny

torch.set_num_threads(1)
calls, late = [], []

class Last(pl.Callback):
    # As a preview at the end of training; it is before the other callback in the list.
    def on_train_end(self, trainer, model):
        late.append([name for name, part in model.named_modules() if part._compiled_call_impl is not None])

def backend(graph, _):
    calls.append(len(list(graph.graph.nodes)))
    return graph.forward

def train(*callbacks):
    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=VERTICES, identities=SEEN, frame_rate=25.0, dim=16, diffusion_steps=40,
        audio_encoder=partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1, dropout=0.0),
        style_encoder=partial(registry.style_encoder.tcn_gru_transformer, num_layers=1, dropout=0.0),
        fusion=partial(registry.fusion.cross_attention, dropout=0.0),
        decoder=partial(registry.decoder.style_transformer, num_layers=1, dropout=0.0),
        sampler=partial(registry.sampler.ddim, steps=2),
    )
    trainer = pl.Trainer(accelerator="cpu", devices=1, max_epochs=2, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, callbacks=list(callbacks), log_every_n_steps=1)
    trainer.fit(model, datamodule=Tiny(root=sys.argv[1], max_frames_per_batch=60))
    left = [name for name, part in model.named_modules() if part._compiled_call_impl is not None]
    weights = {name: value.double().sum().item() for name, value in model.state_dict().items()}
    return float(trainer.callback_metrics["train/loss"]), weights, left

plain = train()
assert not calls
found = train(Last(), CompiledTraining(backend=backend))
print(json.dumps([plain, found, calls, late]))
"""


@pytest.mark.slow
def test_compiled_training_gives_the_same_losses_weights_and_names(tiny_root: Path) -> None:
    # In a process of its own, without the checks of shapes, which cannot be traced.
    command = [sys.executable, "-c", PROGRAM, tiny_root]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    plain, found, calls, late = json.loads(done.stdout.splitlines()[-1])
    assert max(calls) > 20  # the decoder was compiled
    assert len(calls) <= 5  # once for all lengths
    assert found[0] == pytest.approx(plain[0], rel=1e-4)
    assert list(found[1]) == list(plain[1])
    assert found[1] == pytest.approx(plain[1], rel=1e-3, abs=1e-2)
    assert found[2] == []
    assert late == [[]]
