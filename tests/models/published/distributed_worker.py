"""One of two processes that train a tiny model of each published method together, over gloo.

Called with: rank, a free port, the corpus's folder, CodeTalker's prior, the output file, and the methods. A corpus that
has channels is trained on in channels and 16 bits.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import warnings
from functools import partial
from pathlib import Path

import torch
from lightning.pytorch import Trainer

from facediff import registry
from facediff.models.speech_networks import Wav2Vec2Encoder
from tests.fakes.channels import TinyChannels
from tests.fakes.tiny import Tiny
from tests.models.published.conftest import METHODS, SIZES, TEXT

SPEECH = partial(Wav2Vec2Encoder, config={**TEXT, "num_hidden_layers": 3}, spec_augment=True, layer_drop=0.5)
"""With the layers that are skipped, and the masks, at random in each process."""


def digest(model: torch.nn.Module) -> str:
    """Of all weights."""
    weights = hashlib.sha256()
    for value in model.state_dict().values():
        weights.update(value.detach().double().numpy().tobytes())
    return weights.hexdigest()


def main() -> None:
    """Train, and write what each model was and became."""
    rank, port, root, prior, out, *methods = sys.argv[1:]
    os.environ |= {"LOCAL_RANK": rank, "NODE_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    os.environ |= {"WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    warnings.simplefilter("ignore")
    found = {}
    for method in methods:
        torch.manual_seed(0)
        options = {**SIZES, **METHODS[method], "audio_encoder": SPEECH, "audio_dim": None}
        channels = (Path(root) / "values_npy").is_dir()
        data = (TinyChannels if channels else Tiny)(root=root, batch_size=2)
        if channels:
            options |= {"n_vertices": data.n_vertices, "space": data.space}
        if method == "CodeTalker":
            options["prior"] = prior
        model = registry.model.get(method)(**options)
        torch.manual_seed(int(rank))  # what is random in training differs
        trainer = Trainer(
            accelerator="cpu",
            devices=2,
            strategy="ddp",
            precision="bf16-mixed" if channels else "32-true",
            max_epochs=1,
            limit_train_batches=2,
            limit_val_batches=1,
            num_sanity_val_steps=0,
            logger=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
        )
        before = digest(model)
        trainer.fit(model, datamodule=data)
        finite = all(bool(value.isfinite().all()) for value in model.parameters())
        found[method] = {"before": before, "after": digest(model), "steps": trainer.global_step, "finite": finite}
    Path(out).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
