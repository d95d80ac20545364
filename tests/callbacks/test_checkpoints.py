"""Training that was stopped anywhere continues to the very weights and curve of a run that was not."""

from __future__ import annotations

import csv
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint

from facediff import registry
from facediff.callbacks import EmaWithWarmup
from facediff.callbacks.checkpoints import (
    AtomicCheckpointIO,
    LastCheckpoint,
    agreed,
    random_states,
    restore_random_states,
)
from facediff.callbacks.runs import ResumableCSVLogger
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny

pytestmark = pytest.mark.filterwarnings("ignore:Checkpoint directory")


class Stop(pl.Callback):
    """Sends a signal in the middle of a training step, or raises where a kill would strike."""

    def __init__(self, step: int, number: int | None = None) -> None:
        self.step = step
        self.number = number

    def on_before_optimizer_step(self, trainer: pl.Trainer, *_: object) -> None:
        if trainer.global_step != self.step:
            return
        if self.number is None:
            raise RuntimeError("killed")
        os.kill(os.getpid(), self.number)


def fit(
    folder: Path,
    tiny_root: Path,
    make_model: Callable[..., DualPathDiffusion],
    *stops: pl.Callback,
    ckpt_path: Path | None = None,
    every_n_steps: int = 1,
    model_options: dict[str, object] | None = None,
    data_options: dict[str, object] | None = None,
    data_class: type[Tiny] = Tiny,
    **trainer_options: object,
) -> tuple[DualPathDiffusion, list[dict[str, str]]]:
    pl.seed_everything(7)
    encoder = partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1, dropout=0.1)
    options = {"lr_schedule": "cosine", "warmup_steps": 2, **(model_options or {})}
    model = make_model(audio_encoder=encoder, **options)
    logger = ResumableCSVLogger(folder, name="run", version=0)
    logger.continues = ckpt_path is not None
    trainer = quiet_trainer(
        folder,
        logger=logger,
        enable_checkpointing=True,
        callbacks=[
            EmaWithWarmup(decay=0.6, warmup=3.0),
            ModelCheckpoint(monitor="val/lve", filename="best"),
            LearningRateMonitor(),
            LastCheckpoint(every_n_steps=every_n_steps),
            *stops,
        ],
        **{"max_epochs": 3, **trainer_options},
    )
    trainer.strategy.checkpoint_io = AtomicCheckpointIO()
    data = data_class(root=str(tiny_root), **{"batch_size": 3, **(data_options or {})})  # type: ignore[arg-type]
    trainer.fit(model, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
    return model, rows(folder)


def rows(folder: Path) -> list[dict[str, str]]:
    """The log."""
    with (folder / "run" / "version_0" / "metrics.csv").open() as stream:
        return list(csv.DictReader(stream))


def last(folder: Path) -> Path:
    return folder / "run" / "version_0" / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def uninterrupted(
    tmp_path_factory: pytest.TempPathFactory, tiny_root: Path, make_model: Callable[..., DualPathDiffusion]
) -> tuple[dict[str, torch.Tensor], list[dict[str, str]]]:
    model, curve = fit(tmp_path_factory.mktemp("whole"), tiny_root, make_model)
    return model.state_dict(), curve


@pytest.mark.parametrize(
    ("step", "every", "number", "workers"),
    [
        pytest.param(1, 1, None, 0, marks=pytest.mark.slow),  # within the first epoch
        pytest.param(2, 1, None, 0, marks=pytest.mark.slow),
        pytest.param(3, 1, None, 0, marks=pytest.mark.slow),  # between epochs
        pytest.param(4, 2, None, 0, marks=pytest.mark.slow),
        (5, 3, None, 0),  # some steps after the last checkpoint
        pytest.param(8, 1, None, 0, marks=pytest.mark.slow),
        pytest.param(4, 1, None, 1, marks=pytest.mark.slow),
        pytest.param(2, 100, signal.SIGINT, 0, marks=pytest.mark.slow),
        (5, 100, signal.SIGINT, 0),
        pytest.param(4, 100, signal.SIGTERM, 0, marks=pytest.mark.slow),
        pytest.param(3, 100, signal.SIGUSR1, 0, marks=pytest.mark.slow),
    ],
)
def test_a_stopped_run_continues_to_the_same_weights_and_curve(
    step: int,
    every: int,
    number: int | None,
    workers: int,
    uninterrupted: tuple[dict[str, torch.Tensor], list[dict[str, str]]],
    tmp_path: Path,
    tiny_root: Path,
    make_model: Callable[..., DualPathDiffusion],
) -> None:
    (weights, curve), data = uninterrupted, {"num_workers": workers}
    with pytest.raises((RuntimeError, SystemExit)) as stop:
        fit(tmp_path, tiny_root, make_model, Stop(step, number), every_n_steps=every, data_options=data)
    assert number is None or stop.value.code == 128 + number  # type: ignore[union-attr]
    assert last(tmp_path).is_file()
    torch.rand(99)  # whatever happened since must not matter
    model, continued = fit(tmp_path, tiny_root, make_model, ckpt_path=last(tmp_path), data_options=data)
    assert continued == curve
    assert {k: v.tolist() for k, v in model.state_dict().items()} == {k: v.tolist() for k, v in weights.items()}


VARIANTS: dict[str, dict[str, object]] = {
    "accumulated gradients": {"accumulate_grad_batches": 2},
    "validation within an epoch": {"val_check_interval": 1},
    "validation across epochs": {"val_check_interval": 2, "check_val_every_n_epoch": None},
    "validation now and then": {"check_val_every_n_epoch": 2, "num_sanity_val_steps": 2},
    "a part of each epoch": {"limit_train_batches": 2},
    "mixed precision": {"precision": "bf16-mixed"},
    "steps in place of epochs": {"max_epochs": -1, "max_steps": 7},
    "windows": {"data_options": {"batch_size": 3, "window": 6}},
    "two workers": {"data_options": {"batch_size": 3, "window": 6, "num_workers": 2}},
    "a budget of frames": {"data_options": {"batch_size": 3, "max_frames_per_batch": 60}},
    "a constant rate": {"model_options": {"lr_schedule": "constant", "warmup_steps": 0}},
    "clipped gradients": {"gradient_clip_val": 0.1, "log_every_n_steps": 2},
}


# The one that goes another way through the loader; the others change the loop or the optimiser.
QUICK = ("windows",)
STOPS = {"accumulated gradients": (5,), "windows": (2, 5)}


@pytest.mark.parametrize(
    "variant", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in VARIANTS]
)
def test_every_way_of_training_continues_exactly(
    variant: str, tmp_path: Path, tiny_root: Path, make_model: Callable[..., DualPathDiffusion]
) -> None:
    options = VARIANTS[variant]
    model, curve = fit(tmp_path / "whole", tiny_root, make_model, **options)
    stopped = tmp_path / "stopped"
    for step in STOPS.get(variant, (1, 2, 3, 5)):  # stopped again and again
        start = last(stopped) if last(stopped).exists() else None
        with pytest.raises(RuntimeError, match="killed"):
            fit(stopped, tiny_root, make_model, Stop(step), ckpt_path=start, **options)
    again, continued = fit(stopped, tiny_root, make_model, ckpt_path=last(stopped), **options)
    assert continued == curve
    assert all(torch.equal(mine, again.state_dict()[name]) for name, mine in model.state_dict().items())
    left = [sorted(path.name for path in folder.rglob("*.ckpt")) for folder in (tmp_path / "whole", stopped)]
    assert left[0] == left[1]


def test_the_state_of_every_generator_comes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    import random

    import numpy as np

    put_back: list[torch.Tensor] = []
    assert random_states()["mps"] is None or torch.backends.mps.is_available()
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    monkeypatch.setattr(torch.mps, "get_rng_state", lambda: torch.tensor([7], dtype=torch.uint8))
    monkeypatch.setattr(torch.mps, "set_rng_state", put_back.append)
    states = random_states()
    first = (torch.rand(3).tolist(), random.random(), float(np.random.rand()))  # noqa: NPY002, S311
    restore_random_states(states)
    assert (torch.rand(3).tolist(), random.random(), float(np.random.rand())) == first  # noqa: NPY002, S311
    assert [state.tolist() for state in put_back] == [[7]]
    restore_random_states({name: state for name, state in states.items() if name != "mps"})  # of an earlier version


@pytest.mark.parametrize(
    ("fault", "reported"),
    [("[enforce fail at inline_container.cc:672] . unexpected pos 704 vs 598", FaceDiffError), ("CUDA", RuntimeError)],
)
def test_the_fault_of_a_device_is_no_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str, reported: type[Exception]
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError(fault)

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(reported) as raised:
        AtomicCheckpointIO().save_checkpoint({"a": torch.ones(3)}, tmp_path / "last.ckpt")
    assert raised.type is reported
    assert not list(tmp_path.iterdir())


def test_the_curve_of_an_earlier_run_stays_until_rows_replace_it(tmp_path: Path) -> None:
    path = tmp_path / "run" / "version_0" / "metrics.csv"
    for value in (1.0, 2.0):
        logger = ResumableCSVLogger(tmp_path, name="run", version=0)
        assert logger.rows() == 0
        assert path.is_file() == (value == 2.0)
        logger.log_metrics({"loss": value}, step=0)
        assert logger.rows() == 1
        logger.log_metrics({"loss": value, "other": 3.0}, step=1)
        assert logger.rows() == 2
        assert [row["loss"] for row in rows(tmp_path)] == [str(value), str(value)]
    again = ResumableCSVLogger(tmp_path, name="run", version=0)
    again.continues = True
    again.keep(0)  # saved before the first row: what is there is of a run before
    again.log_metrics({"new": 4.0}, step=0)
    again.save()
    assert rows(tmp_path) == [{"new": "4.0", "step": "0"}]


def test_weights_from_a_forked_process_come_back_and_nothing_else_does(tmp_path: Path) -> None:
    plugin, path = AtomicCheckpointIO(), tmp_path / ".temp.ckpt"
    plugin.save_checkpoint({"a": torch.ones(3)}, path)
    assert plugin.load_checkpoint(path)["a"].tolist() == [1.0, 1.0, 1.0]
    plugin.save_checkpoint({"a": torch.ones(3), "hyper_parameters": {"_class_path": "os.system"}}, path)
    with pytest.raises(FaceDiffError, match=r"\.temp\.ckpt"):
        plugin.load_checkpoint(path)
    plugin.save_checkpoint({"a": torch.ones(3)}, tmp_path / "other.ckpt")
    with pytest.raises(FaceDiffError, match=r"other\.ckpt"):
        plugin.load_checkpoint(tmp_path / "other.ckpt")


@pytest.mark.parametrize("requests", [[(False, 0), (True, 0)], [(True, 0), (False, 12)], [(False, 0), (False, 0)]])
def test_a_request_of_one_process_is_one_of_all(
    requests: list[tuple[bool, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each process's request, reduced as torch.distributed would over two of them."""
    values = torch.tensor([[int(due), number] for due, number in requests])
    trainer: Any = SimpleNamespace(world_size=2, strategy=SimpleNamespace(root_device="cpu"))
    reductions = {torch.distributed.ReduceOp.MAX: values.amax(0), torch.distributed.ReduceOp.MIN: values.amin(0)}
    reductions[torch.distributed.ReduceOp.SUM] = values.sum(0)
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda request, op: request.copy_(reductions[op]))
    together = any(due for due, _ in requests), max(number for _, number in requests)
    assert [agreed(trainer, *request) for request in requests] == [together] * 2
