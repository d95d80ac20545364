"""A trained system that is to know one person more."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from lightning.pytorch.cli import instantiate_module
from torch import Tensor

from facediff.errors import FaceDiffError
from facediff.systems.base import SpeechAnimator

Part = Literal["all", "person"]
"""What is trained: everything, or only what holds identity and style."""


def with_newcomers(system: SpeechAnimator, identities: list[str]) -> SpeechAnimator:
    """The same system with further identities in front of those it knows, each starting as the mean of them all.

    Args:
        system: a trained system.
        identities: what its identities shall be; those it has must be their end.

    Raises:
        FaceDiffError: if the system has other identities.
    """
    known = system.identities
    count = len(identities) - len(known)
    if count < 0 or identities[count:] != known:
        raise FaceDiffError(
            f"the checkpoint knows {', '.join(known)}, which is not the end of {', '.join(identities)}: adapt it with "
            f"the corpus and the people that it was trained on"
        )
    if not count:
        return system
    described = {key: value for key, value in system.hparams.items() if not key.startswith("_")}
    grown: SpeechAnimator = instantiate_module(type(system), {**described, "identities": identities})
    before = system.state_dict()
    grown.load_state_dict({name: grow(before[name], value) for name, value in grown.state_dict().items()})
    grown.adopt(replace(system.assets, identities=identities))
    return grown


def grow(before: Tensor, after: Tensor) -> Tensor:
    """``before`` with as many rows as ``after``, the new ones in front and equal to the mean of the old ones."""
    if before.shape == after.shape:
        return before
    if before.shape[1:] != after.shape[1:] or len(before) > len(after):
        raise FaceDiffError(f"weights of the shape {tuple(before.shape)} cannot take in another identity")
    mean = before.mean(0, keepdim=True)
    return torch.cat([mean.expand(len(after) - len(before), *mean.shape[1:]), before])


def train_only(system: SpeechAnimator, part: Part) -> None:
    """Freeze everything but a part; ``all`` leaves everything as it is.

    Raises:
        FaceDiffError: if the system has nothing of that part.
    """
    if part == "all":
        return
    chosen = {id(p) for module in system.personal_modules() for p in module.parameters()}
    if not chosen:
        raise FaceDiffError("--train person: the system has neither identity nor style to train; train all of it")
    for parameter in system.parameters():
        parameter.requires_grad_(id(parameter) in chosen and parameter.requires_grad)
