"""Previews show the averaged weights, the same clips and noise each time, and leave training as it is."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import cv2
import lightning.pytorch as pl
import numpy as np
import pytest
import torch
import yaml
from lightning.pytorch.loggers import CSVLogger, WandbLogger
from PIL import Image

from facediff.callbacks import SamplingPreview
from facediff.data import collate
from facediff.models import DualPathDiffusion, load_model
from facediff.render import Renderer
from facediff.render.panels import heat_colours
from tests.fakes.tiny import Tiny
from tests.fakes.wandb_run import OfflineRun

MakeModel = Callable[..., DualPathDiffusion]
MakeTrainer = Callable[..., pl.Trainer]

SIZE, SCALE = 64, 0.013  # not what the clips would give
CLIPS = ["A_e05", "B_e05"]
SMALL = {"every_n_epochs": 1, "size": SIZE, "steps": 3, "sampler": "ddim", "error_scale": SCALE}


class Weights(pl.Callback):
    """Keeps raw and averaged weights after every epoch, as a checkpoint would hold them."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        trainer.save_checkpoint(self.folder / f"{trainer.current_epoch + 1}.ckpt")


class Losses(pl.Callback):
    def __init__(self) -> None:
        self.found: list[Any] = []

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        self.found.append(outputs["loss"].item())  # type: ignore[index]
        self.found.append((random.random(), np.random.rand(), torch.rand(()).item()))  # noqa: NPY002, S311
        self.found.append(sum(module.training for module in pl_module.modules()))

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.found += [trainer.callback_metrics["val/loss"].item(), trainer.callback_metrics["val/lve"].item()]


def shown(sheet: Path, model: DualPathDiffusion, clip: str, tiny: Tiny, seed: int = 0) -> bool:
    """Whether the first picture of a sheet shows this model's motion and error, drawn by the renderer alone."""
    dataset = tiny.dataset("val")
    sample = dataset[[found.name for found in dataset.clips].index(clip)]
    model.choose_sampler("ddim", 3)
    with torch.inference_mode():
        motion = model.eval().generate(collate([sample]), seed=seed)[0]
    mesh = tiny.assets()
    assert mesh.faces is not None
    width, colours = SIZE * 3 // 4, mesh.colours_of(sample.identity_name)
    renderer = Renderer(mesh.faces.numpy(), template=sample.template.numpy(), size=(SIZE, width), colours=colours)
    first = round(0.5 * (len(motion) - 1) / 6)
    true, moved = ((found + sample.template)[first].numpy() for found in (sample.motion, motion))
    heat = heat_colours(np.linalg.norm(moved - true, axis=1), SCALE)
    truth, made, wrong = renderer.render(true), renderer.render(moved), renderer.render(moved, colours=heat)
    with Image.open(sheet) as image:
        picture = np.asarray(image)
    for top in range(SIZE):
        if np.array_equal(picture[top : top + SIZE, :width], truth):
            return np.array_equal(picture[top : top + SIZE, width : 3 * width], np.hstack([made, wrong]))
    raise AssertionError("the truth is not on the sheet")


def model_of(checkpoint: Path, *, averaged: bool) -> DualPathDiffusion:
    model = load_model(checkpoint)
    weights = torch.load(checkpoint, weights_only=True)["state_dict" if averaged else "current_model_state"]
    model.load_state_dict(weights)
    return model


class Broken(SamplingPreview):
    def _clip(self, *arguments: object) -> NoReturn:
        raise RuntimeError("the disk is full")


@pytest.mark.slow
def test_preview_with_two_processes(tiny: Tiny, tiny_root: Path, tmp_path: Path) -> None:
    """One process draws, and fails where it must; the other neither draws nor waits for ever."""
    here = "tests.callbacks.test_sampling_preview"
    callbacks: list[dict[str, Any]] = [
        {"class_path": "facediff.callbacks.SamplingPreview", "init_args": SMALL},
        {"class_path": f"{here}.Broken", "init_args": SMALL},
        {"class_path": "EMAWeightAveraging", "init_args": {"decay": 0.9, "use_buffers": False}},
        {"class_path": f"{here}.Weights", "init_args": {"folder": str(tmp_path)}},
    ]
    # Forked processes are spared the imports.
    options: dict[str, Any] = {"max_epochs": 3, "check_val_every_n_epoch": 2, "devices": 2, "strategy": "ddp_fork"}
    options |= {"callbacks": callbacks, "default_root_dir": str(tmp_path)}
    options |= dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary", "enable_checkpointing"), False)
    (tmp_path / "two.yaml").write_text(yaml.safe_dump({"trainer": options}))
    words = ["--config", "configs/experiment/puppet.yaml", "--config", str(tmp_path / "two.yaml")]
    words += ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", "--data.batch_size=2"]
    words += ["--model.dim=16", "--model.diffusion_steps=20", "--model.sampler.steps=2"]
    # So that a few steps move the weights, and the pictures of averaged and latest ones differ.
    words += ["--model.motion_space=vertices", "--model.timestep_sampling=uniform"]
    words += ["--model.warmup_steps=0", "--model.learning_rate=3e-3"]
    done = subprocess.run(
        [sys.executable, "-m", "facediff", "fit", *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[2],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=240,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for epoch in (2, 3):
        assert done.stderr.count(f"of A_e05 after epoch {epoch} failed, and training goes on: the disk is full") == 1
        assert done.stdout.count(f"preview after epoch {epoch}: A_e05, B_e05 in") == 1
        folder = tmp_path / "previews" / f"epoch_{epoch:04d}"
        assert sorted(path.name for path in folder.iterdir()) == [f"{c}.{s}" for c in CLIPS for s in ("mp4", "png")]
        for averaged in (True, False):
            model = model_of(tmp_path / f"{epoch}.ckpt", averaged=averaged)
            assert shown(folder / "B_e05.png", model, "B_e05", tiny) is averaged


@pytest.mark.parametrize("preview", [SamplingPreview, pytest.param(Broken, marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore:the preview of:UserWarning")
def test_preview_leaves_training_the_same_digit_for_digit(
    preview: type[SamplingPreview], make_model: MakeModel, make_trainer: MakeTrainer, tiny_root: Path
) -> None:
    found = []
    for callbacks in ([], [preview(**SMALL)]):
        pl.seed_everything(3, verbose=False)
        spy, model = Losses(), make_model()
        trainer = make_trainer(max_epochs=2, val_check_interval=0.5, callbacks=[*callbacks, spy])
        sampler = model.sampler
        trainer.fit(model, datamodule=Tiny(root=str(tiny_root), window=9))
        found.append([*spy.found, *(tensor.sum().item() for tensor in model.state_dict().values())])
        assert model.sampler is sampler
    assert len(found[0]) > 50
    assert found[0] == found[1]


@pytest.mark.slow
def test_preview_is_drawn_when_it_is_due(
    make_model: MakeModel, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path
) -> None:
    def epochs(folder: str, trainer_options: dict[str, Any], **options: object) -> list[int]:
        preview = SamplingPreview(**{**SMALL, "clips": 1, "seconds": 0.1, **options})
        trainer = make_trainer(callbacks=[preview], default_root_dir=tmp_path / folder, **trainer_options)
        trainer.fit(make_model(), datamodule=tiny)
        return sorted(int(path.name[-4:]) for path in (tmp_path / folder).glob("previews/*"))

    often = {"max_epochs": 7, "check_val_every_n_epoch": 3, "limit_train_batches": 1, "limit_val_batches": 1}
    assert epochs("a", often, every_n_epochs=2) == [3, 6, 7]
    assert epochs("b", often, every_n_epochs=4, at_end=False) == [6]
    assert epochs("c", often, every_n_epochs=None) == [7]
    assert epochs("d", {"max_epochs": 1, "limit_val_batches": 0}) == [1]
    assert epochs("e", {"fast_dev_run": True}) == []
    assert epochs("f", {"max_epochs": 0, "num_sanity_val_steps": 2}) == []


def test_preview_that_fails_warns_and_leaves_nothing_half_written(
    make_model: MakeModel, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(self: Renderer, *arguments: object, **options: object) -> None:
        raise MemoryError("no memory for pictures")

    monkeypatch.setattr(Renderer, "render", interrupted)
    trainer = make_trainer(callbacks=[SamplingPreview(**{**SMALL, "clips": 1})], logger=CSVLogger(tmp_path))
    with pytest.warns(UserWarning, match="preview of A_e05 after epoch 1 failed, and .* no memory for pictures"):
        trainer.fit(make_model(), datamodule=tiny)
    assert trainer.current_epoch == 1
    assert not [path for path in tmp_path.rglob("*") if "previews" in str(path)]


@pytest.mark.slow
def test_preview_in_wandb_has_videos_and_a_growing_table(
    make_model: MakeModel, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = pytest.importorskip("wandb")
    monkeypatch.chdir(tmp_path)
    wandb.finish()  # another test's run in this process
    logger = WandbLogger(project="facediff", save_dir=tmp_path, settings=wandb.Settings(console="off"))
    trainer = make_trainer(max_epochs=2, callbacks=[SamplingPreview(**SMALL)], logger=logger)
    trainer.fit(make_model(), datamodule=tiny)
    # Ends wandb's own process too: all is on disk then, and a later test's starts in that test's folder.
    wandb.finish()
    wandb.teardown()
    (folder,) = tmp_path.glob("wandb/offline-run-*")
    run = OfflineRun(folder)
    for clip in CLIPS:
        videos = run.column(f"preview/{clip}")
        assert [video["caption"] for video in videos] == [f"{clip} after epoch {epoch}" for epoch in (1, 2)]
        for video in videos:
            capture = cv2.VideoCapture(str(run.files / video["path"]))
            assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == {"A_e05": 22, "B_e05": 23}[clip]
    tables = [json.loads(path.read_text()) for name, path in run.media.items() if name.endswith("clips.table.json")]
    assert tables[0]["columns"] == ["clip", "epoch", "video", "mve", "lve", "fdd"]
    rows = [row for table in tables for row in table["data"]]
    assert [row[:2] for row in rows] == [[clip, epoch] for epoch in (1, 2) for clip in CLIPS]
    assert all(row[2]["_type"] == "video-file" and row[4] > 0 for row in rows)
