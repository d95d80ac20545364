"""Optimisers and schedules: groups, what a resume applies, and Lightning's callbacks that change groups."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import BaseFinetuning

from facediff.callbacks.checkpoints import AtomicCheckpointIO
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.optimizers import FactorSchedule, configure, parameter_groups, schedule_changed
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]
SGD = {"class_path": "torch.optim.SGD", "init_args": {"lr": 0.01, "momentum": 0.9}}


def fit(model: DualPathDiffusion, root: Path, folder: Path, **options: Any) -> pl.Trainer:  # noqa: ANN401
    path = options.pop("ckpt_path", None)
    trainer = quiet_trainer(folder, limit_val_batches=0, plugins=[AtomicCheckpointIO()], **options)
    trainer.fit(model, datamodule=Tiny(root=str(root), batch_size=4), weights_only=True, ckpt_path=path)
    return trainer


def test_parts_get_options_of_their_own_and_every_parameter_one_group(make_model: Make) -> None:
    model = make_model(parameter_groups={"decoder": {"lr": 1e-5}, "network.decoder.blocks": {"weight_decay": 0.0}})
    groups = model.default_optimizer().param_groups
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    members = [sorted(names[id(p)] for p in group["params"]) for group in groups]
    assert sorted(sum(members, [])) == sorted(name for name, p in model.named_parameters() if p.requires_grad)
    inside = [name for name in names.values() if name.startswith("network.decoder.")]
    assert sorted(members[1] + (members[2] if len(members) > 2 else [])) == sorted(inside)
    assert [group["lr"] for group in groups[:2]] == [model.learning_rate, 1e-5]
    with pytest.raises(FaceDiffError, match="decoder"):
        parameter_groups(model, {"decodr": {"lr": 1.0}})


def test_groups_that_are_added_follow_the_schedule_from_their_rate() -> None:
    """Against the formula: the rate times the factor of the step, over the factor at which the group came."""
    weights = [torch.nn.Parameter(torch.zeros(1)) for _ in range(2)]
    optimizer = torch.optim.SGD([weights[0]], lr=2.0)
    schedule = FactorSchedule(optimizer, lambda step: 1.0 / (1 + step))
    for step in range(6):
        if step == 3:
            optimizer.add_param_group({"params": [weights[1]], "lr": 0.5})
        rates = [group["lr"] for group in optimizer.param_groups]
        assert rates == pytest.approx([2.0 / (1 + step), 0.5 * 4 / (1 + step)][: len(rates)])
        optimizer.step()
        schedule.step()


class Thaw(BaseFinetuning):
    """Lightning's own way to train the decoder later."""

    def freeze_before_training(self, pl_module: Any) -> None:  # noqa: ANN401
        self.freeze(pl_module.network.decoder)

    def finetune_function(self, pl_module: Any, epoch: int, optimizer: torch.optim.Optimizer) -> None:  # noqa: ANN401
        if epoch == 1:
            self.unfreeze_and_add_param_group(pl_module.network.decoder, optimizer)


def test_freezing_and_thawing_works_with_a_cosine_and_a_warm_up(
    make_model: Make, tiny_root: Path, tmp_path: Path
) -> None:
    model = make_model(lr_schedule="cosine", warmup_steps=2)
    trainer = fit(model, tiny_root, tmp_path, callbacks=[Thaw()], max_epochs=3)
    assert len(trainer.optimizers[0].param_groups) == 2


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_a_resume_applies_the_rate_and_the_decay_that_are_given(
    schedule: str, make_model: Make, tiny_root: Path, tmp_path: Path
) -> None:
    """After two of four epochs: the given rate times the schedule's factor there, and the given decay."""
    trainer = fit(make_model(lr_schedule=schedule), tiny_root, tmp_path, max_epochs=2)
    trainer.save_checkpoint(tmp_path / "two.ckpt", weights_only=False)
    saved = trainer.optimizers[0].param_groups[0]
    seen: list[float] = []

    class Look(pl.Callback):
        def on_train_start(self, trainer: pl.Trainer, *_: object) -> None:
            seen.extend(trainer.optimizers[0].param_groups[0][name] for name in ("lr", "initial_lr", "weight_decay"))

    again = make_model(lr_schedule=schedule, learning_rate=3e-3, weight_decay=0.125)
    fit(again, tiny_root, tmp_path, max_epochs=4, callbacks=[Look()], ckpt_path=tmp_path / "two.ckpt")
    assert seen == pytest.approx([saved["lr"] * 3e-3 / saved["initial_lr"], 3e-3, 0.125])


def test_an_optimiser_and_a_schedule_by_class_path_train_and_resume(
    make_model: Make, tiny_root: Path, tmp_path: Path
) -> None:
    step = {"class_path": "torch.optim.lr_scheduler.StepLR", "init_args": {"step_size": 1, "gamma": 0.5}}
    model = make_model(lr_schedule="constant")
    model.configure_optimizers = partial(configure, model, SGD, step)  # type: ignore[method-assign]
    trainer = fit(model, tiny_root, tmp_path, max_epochs=2)
    (optimizer,) = trainer.optimizers
    assert (type(optimizer), optimizer.param_groups[0]["lr"]) == (torch.optim.SGD, pytest.approx(0.01 / 4))
    trainer.save_checkpoint(tmp_path / "sgd.ckpt", weights_only=False)
    content = torch.load(tmp_path / "sgd.ckpt", weights_only=True)
    assert not schedule_changed(content, step)
    assert schedule_changed(content, None)
    assert schedule_changed(content, {**step, "init_args": {"step_size": 2}})
    with pytest.raises(FaceDiffError, match="--optimizer"):  # AdamW would start from another optimiser's state
        fit(make_model(), tiny_root, tmp_path, max_epochs=3, ckpt_path=tmp_path / "sgd.ckpt")
