"""Optimisers and learning-rate schedules: a model's defaults, ``--optimizer``, and their state at a resume."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.cli import LightningCLI, instantiate_class
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from facediff.errors import ArgumentError, FaceDiffError, choices

Schedule = Literal["constant", "cosine", "exponential", "step"]

Description = Mapping[str, Any]
"""A class with its options as Lightning writes them: ``class_path`` and ``init_args``."""

CYCLED = ("lr", "betas", "momentum")
"""Options of a parameter group that a schedule may change."""


def lr_factor(
    step: int,
    *,
    total: int,
    warmup_steps: int,
    schedule: Schedule,
    epoch_steps: int = 1,
    decay: float = 0.9,
    decay_epoch: int = 30,
) -> float:
    """Factor of the learning rate at an optimiser step.

    Args:
        step: the step, counted from 0.
        total: steps of the whole training.
        warmup_steps: steps over which the factor rises from zero.
        schedule: constant; half a cosine down to zero at the end; exponential, which multiplies by ``decay`` in
            every epoch from ``decay_epoch`` on; or step, which does so once in every ``decay_epoch`` epochs.
        epoch_steps: steps of an epoch.
        decay: the factor of an epoch.
        decay_epoch: the first epoch with the factor, counted from 0 as Lightning counts; of step, how many epochs lie
            between two decays.
    """
    warm = min(1.0, (step + 1) / max(1, warmup_steps))
    if schedule == "constant":
        return warm
    if schedule == "exponential":
        return warm * decay ** max(0, step // max(1, epoch_steps) - decay_epoch + 1)
    if schedule == "step":
        return warm * decay ** (step // max(1, epoch_steps) // max(1, decay_epoch))
    return warm * 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / max(1, total))))


class FactorSchedule(LRScheduler):
    """Multiplies the learning rate of every parameter group by one factor of the step.

    Unlike PyTorch's ``LambdaLR`` it takes parameter groups that are added during training, as Lightning's
    ``BaseFinetuning`` adds them: such a group has the learning rate that it was added with, and follows the schedule
    from there. A resume keeps the position and takes the factor from the options.
    """

    def __init__(self, optimizer: Optimizer, factor: Callable[[int], float]) -> None:
        self.factor = factor
        super().__init__(optimizer)

    def get_lr(self) -> list[float | torch.Tensor]:
        """The learning rate of every group at this step."""
        previous, factor = self.factor(max(0, self.last_epoch - 1)), self.factor(self.last_epoch)
        for group in self.optimizer.param_groups:
            group.setdefault("initial_lr", group["lr"] / previous if previous else group["lr"])
        return [group["initial_lr"] * factor for group in self.optimizer.param_groups]

    def state_dict(self) -> dict[str, Any]:
        """The position, as plain data."""
        return {name: value for name, value in super().state_dict().items() if name != "factor"}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a position, also of 1.x, with its ``LambdaLR``."""
        super().load_state_dict({k: v for k, v in state_dict.items() if k not in ("base_lrs", "lr_lambdas")})


def parameter_groups(model: LightningModule, options: Mapping[str, Mapping[str, Any]] | None) -> list[dict[str, Any]]:
    """The trainable parameters in groups: parts with options of their own, all others first.

    Args:
        model: the model.
        options: options of parts by their name among the modules, such as ``{audio_encoder: {lr: 1e-5}}``; ``network.``
            may be left out. A parameter belongs to the longest name that it begins with.
    """
    groups: dict[str, dict[str, Any]] = {"": {"params": []}}
    groups |= {name: {"params": [], **values} for name, values in (options or {}).items()}
    parts: dict[str, None] = {}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            path = f"{name.removeprefix('network.')}."
            parts[path.partition(".")[0]] = None
            owner = max((n for n in groups if path.startswith(f"{n.removeprefix('network.')}." if n else "")), key=len)
            groups[owner]["params"].append(parameter)
    for name, group in groups.items():
        if name and not group["params"]:
            messages = {f"model.parameter_groups.{name}": ""}
            raise ArgumentError(messages, f"nothing to train there: {choices(name, parts)}", located=True)
    return [group for group in groups.values() if group["params"]]


def configure(
    model: LightningModule, optimizer: Description | None, lr_scheduler: Description | None
) -> OptimizerLRScheduler:
    """The optimiser and the schedule of ``--optimizer`` and ``--lr_scheduler``, or the model's own."""
    model_: Any = model
    if optimizer is None:
        result = model_.default_optimizer()
    else:
        result = instantiate_class(parameter_groups(model, model_.parameter_groups), dict(optimizer))
    if lr_scheduler is None:
        return model_.scheduled(result)
    schedule: Any = instantiate_class(result, dict(lr_scheduler))
    schedule.description = dict(lr_scheduler)  # a part of its state in checkpoints, see schedule_changed
    apply_at_resume(result)
    return LightningCLI.configure_optimizers(model, result, schedule)


def schedule_changed(checkpoint: Mapping[str, Any], lr_scheduler: Description | None) -> bool:
    """Whether a training that began with one ``--lr_scheduler`` is to be resumed with another.

    PyTorch's schedules would silently keep the options that are in the checkpoint.
    """
    states = checkpoint.get("lr_schedulers") or [{}]
    return bool(states[0].get("description") != (None if lr_scheduler is None else dict(lr_scheduler)))


def apply_at_resume(optimizer: Optimizer) -> Optimizer:
    """Let an optimiser keep its options, such as learning rate and weight decay, where it loads a checkpoint's state.

    A schedule's progress is kept: the rate is multiplied by new over old initial rate. To be called once the schedule
    is made.
    """
    for group in optimizer.param_groups:
        group.setdefault("initial_lr", group["lr"])
    stated = [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]
    optimizer.register_load_state_dict_pre_hook(partial(_with_options, stated))
    return optimizer


def _with_options(stated: list[dict[str, Any]], optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    groups = [dict(group) for group in state["param_groups"]]
    absent_options = [name for name in optimizer.defaults if any(name not in group for group in groups)]
    if absent_options:
        raise FaceDiffError(
            f"--optimizer: the checkpoint's training had another optimiser, without {', '.join(absent_options)}; "
            f"resume with the same one, or start a new training"
        )
    for new, group in zip(stated, groups, strict=False):  # BaseFinetuning adds further ones
        before = group.get("initial_lr", group["lr"])
        if before != new["initial_lr"]:
            group["lr"] = group["lr"] * (new["initial_lr"] / before) if before else new["lr"]
        group["initial_lr"] = new["initial_lr"]
        group |= {name: new[name] for name in optimizer.defaults if name in new and name not in CYCLED}
        if not {"max_momentum", "base_momentum"} & group.keys():
            group |= {name: new[name] for name in ("betas", "momentum") if name in new and name in group}
    return {**state, "param_groups": groups}
