"""Norms against gradients known by hand, descriptions and tables against the run."""

from __future__ import annotations

import csv
import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
import yaml
from lightning.pytorch.loggers import CSVLogger, WandbLogger
from lightning.pytorch.plugins import MixedPrecision
from torch import Tensor, nn
from torch.utils.data import DataLoader

from facediff.callbacks import GradientNorm, RunDescription, ScoreTable
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny, write_tiny
from tests.fakes.wandb_run import OfflineRun

MakeModel = Callable[..., DualPathDiffusion]
MakeTrainer = Callable[..., pl.Trainer]


class Scaled(pl.LightningModule):
    """The loss of x is x · (3 a₁ + 4 a₂ + 12 b), so its gradient is x · (3, 4, 12): norm 13 |x|, of a 5 |x|."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.ModuleDict({"a": nn.Linear(2, 1, bias=False), "b": nn.Linear(1, 1, bias=False)})
        nn.init.zeros_(self.inner["a"].weight)
        nn.init.zeros_(self.inner["b"].weight)

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        x = batch.mean()
        loss = self.inner["a"](torch.tensor([3.0, 4.0]) * x) + self.inner["b"](torch.tensor([12.0]) * x)
        self.log("train/loss", loss)
        return loss.sum()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)

    def size(self) -> float:
        """Length of the way from the start, which was zero."""
        return math.sqrt(sum(float(p.detach().square().sum()) for p in self.parameters()))


def columns(folder: Path, *names: str) -> list[tuple[float, ...]]:
    """Rows of a CSV log that have all these columns."""
    (path,) = folder.rglob("metrics.csv")
    rows = csv.DictReader(path.read_text().splitlines())
    return [tuple(float(row[name]) for name in names) for row in rows if all(row[name] for name in names)]


def test_a_part_called_norm_has_a_column_of_its_own(make_trainer: MakeTrainer, tmp_path: Path) -> None:
    module = Scaled()
    module.inner["norm"] = module.inner.pop("b")
    module.inner["b"] = module.inner["norm"]  # its parameters go by their first name
    trainer = make_trainer(logger=CSVLogger(tmp_path), callbacks=[GradientNorm(components=True)])
    trainer.fit(module, DataLoader(torch.tensor([2.0]), batch_size=1))
    assert columns(tmp_path, "gradient/norm", "gradient/a", "gradient/norm_part") == [(26.0, 10.0, 24.0)]


def train_scaled(make_trainer: MakeTrainer, folder: Path, values: list[float], **options: object) -> Scaled:
    module = Scaled()
    trainer = make_trainer(logger=CSVLogger(folder), callbacks=[GradientNorm(components=True)], **options)
    trainer.fit(module, DataLoader(torch.tensor(values), batch_size=1))
    return module


def test_gradient_norm_is_that_before_clipping(make_trainer: MakeTrainer, tmp_path: Path) -> None:
    module = train_scaled(make_trainer, tmp_path, [1.0, 2.0, 0.5], gradient_clip_val=0.25)
    expected = [(13 * x, 5 * x, 12 * x) for x in (1.0, 2.0, 0.5)]
    found = columns(tmp_path, "gradient/norm", "gradient/a", "gradient/b")
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert module.size() == pytest.approx(3 * 0.25, rel=1e-4)  # clipped nevertheless: three steps of this length


def test_gradient_norm_counts_accumulated_batches_once(make_trainer: MakeTrainer, tmp_path: Path) -> None:
    train_scaled(make_trainer, tmp_path, [1.0, 2.0, 4.0, 6.0], accumulate_grad_batches=2)
    # Lightning averages over the accumulated batches: (1 + 2) / 2 and (4 + 6) / 2. The loss is logged as often.
    assert columns(tmp_path, "gradient/norm") == [(pytest.approx(13 * 1.5),), (pytest.approx(13 * 5.0),)]
    assert len(columns(tmp_path, "train/loss")) == 2


def test_gradient_norm_is_without_the_scale_of_mixed_precision(make_trainer: MakeTrainer, tmp_path: Path) -> None:
    scaler = torch.amp.GradScaler("cpu", init_scale=1024.0)
    train_scaled(make_trainer, tmp_path, [0.5], plugins=[MixedPrecision("16-mixed", "cpu", scaler)])
    assert columns(tmp_path, "gradient/norm") == [(pytest.approx(6.5, rel=1e-3),)]
    assert scaler.get_scale() == 1024.0


@pytest.mark.slow
def test_gradient_norm_of_two_processes_is_that_of_the_mean(make_trainer: MakeTrainer, tmp_path: Path) -> None:
    # The first step sees 1 and 3 on the two processes, the second 2 and 8.
    # A fork of this process would wait for ever for locks that threads of earlier tests may hold.
    options = {"devices": 2, "strategy": "ddp_spawn", "use_distributed_sampler": True}
    module, trainer = Scaled(), make_trainer(logger=CSVLogger(tmp_path), callbacks=[GradientNorm()], **options)
    trainer.fit(module, DataLoader(torch.tensor([1.0, 3.0, 2.0, 8.0]), batch_size=1))
    np.testing.assert_allclose(columns(tmp_path, "gradient/norm"), [(26.0,), (65.0,)], rtol=1e-6)


def fit(model: DualPathDiffusion, make_trainer: MakeTrainer, root: Path, **options: object) -> None:
    pl.seed_everything(1, workers=True, verbose=False)
    make_trainer(max_epochs=2, limit_val_batches=0, **options).fit(model, datamodule=Tiny(root=str(root), batch_size=4))


def test_training_is_the_same_with_and_without(
    make_model: MakeModel, make_trainer: MakeTrainer, tiny_root: Path, tmp_path: Path
) -> None:
    alone, watched = make_model(), make_model()
    fit(alone, make_trainer, tiny_root, gradient_clip_val=0.1)
    callbacks = [GradientNorm(components=True), RunDescription()]
    fit(watched, make_trainer, tiny_root, gradient_clip_val=0.1, callbacks=callbacks, logger=CSVLogger(tmp_path))
    for name, value in alone.state_dict().items():
        assert torch.equal(watched.state_dict()[name], value), name
    # The parts of the network are the components; each step's squares add up.
    (path,) = tmp_path.rglob("metrics.csv")
    rows = [row for row in csv.DictReader(path.read_text().splitlines()) if row["gradient/norm"]]
    assert len(rows) == 4
    parts = {name for name in rows[0] if name.startswith("gradient/")} - {"gradient/norm"}
    trained = {name.split(".")[1] for name, _ in alone.named_parameters()}
    assert parts == {f"gradient/{name}" for name in trained} >= {"gradient/decoder", "gradient/audio_encoder"}
    for row in rows:
        assert sum(float(row[part] or 0) ** 2 for part in parts) == pytest.approx(float(row["gradient/norm"]) ** 2)


def test_run_description_is_logged(make_model: MakeModel, make_trainer: MakeTrainer, tmp_path: Path) -> None:
    from facediff import registry

    root = write_tiny(tmp_path / "corpus")
    (root / "manifest.json").write_text(json.dumps({"frame_rate": 25}))
    model = make_model(decoder=registry.decoder.gru, identity_encoder=registry.identity_encoder.none)
    for parameter in model.network.fusion.parameters():
        parameter.requires_grad = False
    frozen = sum(parameter.numel() for parameter in model.network.fusion.parameters())
    fit(model, make_trainer, root, callbacks=[RunDescription()], logger=CSVLogger(tmp_path), max_steps=1)
    (path,) = tmp_path.rglob("hparams.yaml")
    said = yaml.safe_load(path.read_text())
    assert said["component/decoder"] == "gru"
    assert said["component/identity_encoder"] == "none"
    assert said["component/style_encoder"] == "tcn_gru_transformer"
    assert said["model"] == "DualPathDiffusion"
    assert said["protocol"] == "paper"
    assert said["data/corpus"] == "tiny"
    assert said["data/synthetic"] is True
    assert said["data/people"] == "none"
    assert said["data/manifest"] == hashlib.sha256((root / "manifest.json").read_bytes()).hexdigest()
    assert said["parameters/frozen"] == frozen > 0
    assert said["parameters/trainable"] + frozen == sum(np.prod(p.shape) for p in model.parameters())
    assert said["version/torch"] == torch.__version__
    assert said["dim"] == 16  # what Lightning logs is still there


def test_wandb_gets_a_row_per_clip_and_method(
    make_model: MakeModel, make_trainer: MakeTrainer, tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import wandb

    monkeypatch.setenv("WANDB_DATA_DIR", str(tmp_path / "data"))
    wandb.finish()  # another test's run in this process
    logger = WandbLogger(save_dir=tmp_path)
    trainer = make_trainer(logger=logger, callbacks=[ScoreTable(), RunDescription()])
    trainer.test(make_model(motion_scale="none"), datamodule=Tiny(root=str(tiny_root), batch_size=3), verbose=False)
    wandb.finish()
    (folder,) = tmp_path.glob("wandb/offline-run-*")
    run = OfflineRun(folder)
    table = run.table("test/sequences")
    rows = [dict(zip(table["columns"], values, strict=True)) for values in table["data"]]
    assert len(rows) == 30  # four clips and two, five methods each
    scored = [row for row in rows if row["split"] == "test_a" and row["method"] == "model"]
    mean = sum(row["lve"] * row["frames"] for row in scored) / sum(row["frames"] for row in scored)
    assert run.column("test_a/lve") == [pytest.approx(mean, rel=1e-5)]
    assert run.config["component/decoder"] == "style_transformer"
    assert "LVE" in run.config["protocol_definition"]
