"""What every run tells its loggers under stable names, beside losses and scores; listed in docs/dashboard.md."""

from __future__ import annotations

from os.path import commonprefix
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

import facediff
from facediff import registry
from facediff.data import SpeechMotionDataModule
from facediff.files import sha256
from facediff.systems import SpeechAnimator


class RunDescription(Callback):
    """Logs what a run is made of, as flat entries of its config.

    Flat, so that runs are grouped and filtered by ``component/decoder`` and the like. Every logger gets them: Weights &
    Biases in the run's config, the CSV logger in ``hparams.yaml``.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Describe a training run."""
        log_description(trainer, pl_module)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Describe a run that only validates."""
        if trainer.state.fn == TrainerFn.VALIDATING:
            log_description(trainer, pl_module)

    def on_test_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Describe a test."""
        log_description(trainer, pl_module)

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Describe a prediction."""
        log_description(trainer, pl_module)


def log_description(trainer: Trainer, pl_module: LightningModule) -> None:
    """Give every logger the description of a run of facediff's systems; others have none."""
    data = trainer.datamodule  # type: ignore[attr-defined]
    if isinstance(pl_module, SpeechAnimator) and isinstance(data, SpeechMotionDataModule):
        facts = describe_run(pl_module, data)
        facts |= {"trainer/processes": trainer.world_size, "trainer/precision": str(trainer.precision)}
        for logger in trainer.loggers:
            logger.log_hyperparams(facts)


def describe_run(system: SpeechAnimator, data: SpeechMotionDataModule) -> dict[str, Any]:
    """System, components, sizes, corpus, protocol and versions as flat entries of plain data."""
    protocol = system.evaluation.protocol
    parameters = {True: 0, False: 0}
    for parameter in system.parameters():
        parameters[parameter.requires_grad] += parameter.numel()
    return {
        "system": type(system).__name__,
        **{f"component/{kind}": name for kind, name in component_names(system).items()},
        "parameters/trainable": parameters[True],
        "parameters/frozen": parameters[False],
        "data/corpus": data.corpus_name,
        "data/synthetic": data.synthetic,
        "data/manifest": manifest_hash(data.root),
        "data/people": ", ".join(f"{folder.name} {manifest_hash(folder)}" for folder in data.people) or "none",
        "protocol": protocol.name,
        "protocol_definition": protocol.describe(),
        "version/facediff": facediff.__version__,
        "version/torch": str(torch.__version__),
        "version/lightning": lightning.__version__,
    }


def component_names(system: SpeechAnimator) -> dict[str, str]:
    """The name of every part that was chosen by name, by its kind."""
    names = {}
    for kind in registry.KINDS:
        chosen = system.hparams.get(kind)
        if isinstance(chosen, dict) and "class_path" in chosen:
            names[kind] = str(chosen["class_path"]).rpartition(".")[2]
    return names


def manifest_hash(folder: Path) -> str:
    """SHA-256 of a corpus's ``manifest.json``; it changes with every file that the manifest lists. ``none`` without."""
    path = folder / "manifest.json"
    return sha256(path) if path.is_file() else "none"


class GradientNorm(Callback):
    """Logs the Euclidean norm of the gradient at every optimiser step, before it is clipped.

    It is the norm of what the optimiser gets but for clipping: summed over accumulated batches, averaged over the
    processes of data-parallel training, and without the scale of mixed precision. A step that mixed precision skips for
    an overflow has the norm infinity or NaN.

    Args:
        components: also log the norm of every part's gradient, ``gradient/decoder`` and the like. Their squares add up
            to the square of ``gradient/norm``.
    """

    def __init__(self, components: bool = False) -> None:
        self.components = components

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Log the norms; Lightning clips after this and removes the scale of mixed precision before."""
        gradients = gradients_by_part(pl_module) if self.components else {"": all_gradients(pl_module)}
        norms = {name: get_total_norm(parts) for name, parts in gradients.items() if parts}
        if not norms:
            return
        logged = {f"gradient/{name}": norm for name, norm in norms.items() if name}
        total = torch.linalg.vector_norm(torch.stack(list(norms.values())))
        pl_module.log_dict({**logged, "gradient/norm": total}, on_step=True, on_epoch=False)


def all_gradients(module: LightningModule) -> list[Tensor]:
    """The gradients of all parameters that have one."""
    return [parameter.grad for parameter in module.parameters() if parameter.grad is not None]


def gradients_by_part(module: LightningModule) -> dict[str, list[Tensor]]:
    """The same by the part of the module that the parameter belongs to.

    The part is the first word in which the parameters' names differ: ``network.decoder.…`` belongs to ``decoder``.
    """
    found = [(name.split("."), p.grad) for name, p in module.named_parameters() if p.requires_grad]
    shared = len(commonprefix([words[:-1] for words, _ in found])) if found else 0
    parts: dict[str, list[Tensor]] = {}
    for words, gradient in found:
        if gradient is not None:
            parts.setdefault(words[shared], []).append(gradient)
    return parts
