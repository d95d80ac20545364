"""Adapting a trained model to a new speaker, by a row more in its identity table."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import torch
from lightning.pytorch.cli import instantiate_module
from torch import Tensor

from facediff.data.batch import ASSETS_KEY
from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.models.dual_path import DualPathDiffusion

Part = Literal["all", "person"]
"""Trained parameters: all, or only those that hold identity and style."""


def with_extra_identities(model: AnimationModel, identities: list[str]) -> AnimationModel:
    """The same model with further identities in front of those it was trained on, each starting as the mean of them."""
    trained = model.identities
    count = len(identities) - len(trained)
    if count < 0 or identities[count:] != trained:
        raise FaceDiffError(
            f"the checkpoint was trained on {', '.join(trained)}, which is not the end of {', '.join(identities)}: "
            f"adapt it with the corpus and the identities that it was trained on"
        )
    if not count:
        return model
    options = {key: value for key, value in model.hparams.items() if not key.startswith("_")}
    grown: AnimationModel = instantiate_module(type(model), {**options, "identities": identities})
    content: dict[str, Any] = {"state_dict": model.state_dict()}
    model.on_save_checkpoint(content)  # what is measured too, such as the noise scale
    grown.on_load_checkpoint({**content, ASSETS_KEY: replace(model.assets, identities=identities).state()})
    before = content["state_dict"]
    grown.load_state_dict({name: grow(before[name], value) for name, value in grown.state_dict().items()})
    if isinstance(grown, DualPathDiffusion) and grown.network.speech_style is not None:
        grown.network.speech_style.counts[:count] = 0  # or their usual styles would stay those of the others
    return grown


def grow(before: Tensor, after: Tensor) -> Tensor:
    """``before`` with as many rows as ``after``, the new ones in front and equal to the mean of the old ones."""
    if before.shape == after.shape:
        return before
    # New rows come first, as new identities do in the list. Starting from the mean, fine-tuning takes fewer steps than
    # from noise, and no known identity is preferred.
    mean = before.mean(0, keepdim=True)
    return torch.cat([mean.expand(len(after) - len(before), *mean.shape[1:]), before])


def train_only(model: AnimationModel, part: Part) -> None:
    """Freeze everything but a part; ``all`` leaves everything as it is."""
    if part == "all":
        return
    trained = {id(p) for module in model.personal_modules() for p in module.parameters()}
    if not trained:
        raise FaceDiffError("--train person: the model has neither identity nor style to train; train all of it")
    for parameter in model.parameters():
        parameter.requires_grad_(id(parameter) in trained and parameter.requires_grad)
