"""What a run leaves in callbacks, data module and files must not reach the next one, or must reach it whole."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from facediff.callbacks import EmaWithWarmup, LastCheckpoint
from facediff.models import DualPathDiffusion
from tests.fakes import style_content
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`", "ignore:Checkpoint directory")
def test_runs_after_others(make_model: Callable[..., DualPathDiffusion], tiny_root: Path, tmp_path: Path) -> None:
    def weights_of(folder: str, data: Tiny, callbacks: list[Any], path: Path | None = None) -> dict[str, Any]:
        pl.seed_everything(0)
        model, trainer = make_model(), quiet_trainer(tmp_path / folder, callbacks=callbacks, enable_checkpointing=True)
        trainer.fit(model, datamodule=data, ckpt_path=path)
        if data.hparams["lips"] is not None:
            assert model.assets.regions["lips"].tolist() == [1, 2, 3], "options of the data count at a resume"
        return {name: value.tolist() for name, value in model.state_dict().items()}

    def callbacks() -> list[Any]:
        return [LastCheckpoint(every_n_steps=2), EmaWithWarmup(decay=0.5)]

    data, last = Tiny(root=str(tiny_root), batch_size=2, window=8), tmp_path / "fresh" / "checkpoints" / "last.ckpt"
    steps = ModelCheckpoint(tmp_path / "steps", every_n_train_steps=3, save_top_k=-1, filename="{step}")
    fresh = weights_of("fresh", data, [*callbacks(), steps])
    assert fresh == weights_of("middle", data, callbacks(), tmp_path / "steps" / "step=3.ckpt")
    assert fresh == weights_of("finished", data, callbacks(), last), "the average, as after the run"
    (tmp_path / "lips.txt").write_text("1 2 3")
    weights_of("lips", Tiny(root=str(tiny_root), batch_size=2, window=8, lips=str(tmp_path / "lips.txt")), [], last)
    used = callbacks()
    quiet_trainer(tmp_path, callbacks=used, max_epochs=2).fit(
        style_content.make(window_context=True, aligned_windows=True, aligned_pairs=True), datamodule=data
    )
    assert fresh == weights_of("second", data, used)
    data.projection.choose(torch.flatten)
    data.setup("fit")
    assert data.projection.project is None
    for _ in range(2):
        bare = quiet_trainer(tmp_path / "bare", logger=False, callbacks=callbacks(), enable_checkpointing=True)
        bare.fit(make_model(), datamodule=data)
    assert len([*(tmp_path / "bare").rglob("last*.ckpt")]) == 2, "the first run's is not lost"
    used[0].setup(third := quiet_trainer(tmp_path, callbacks=used, enable_checkpointing=True), make_model(), "fit")
    assert used[0].is_due(third), "nothing of this run is saved yet"
