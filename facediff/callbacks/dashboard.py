"""Values that every run logs under stable names next to losses and scores; listed in docs/monitoring.md."""

from __future__ import annotations

from os.path import commonprefix
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from facediff import registry
from facediff.data import SpeechMotionDataModule
from facediff.models import AnimationModel
from facediff.utils.checksums import hash_of, sha256
from facediff.utils.hints import checks_arguments
from facediff.utils.hub import model_hash, split_face
from facediff.utils.provenance import Provenance
from facediff.version import __version__


class RunDescription(Callback):
    """Logs model, components, corpus and versions of a run, as flat entries of its config.

    Flat, so that runs are grouped and filtered by ``component/decoder`` and the like. Every logger gets them: Weights &
    Biases in the run's config, the CSV logger in ``hparams.yaml``.
    """

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give every logger the description of a run of facediff's models; other models have none."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if isinstance(pl_module, AnimationModel) and isinstance(data, SpeechMotionDataModule):
            facts = describe_run(pl_module, data)
            facts |= {"trainer/processes": trainer.world_size, "trainer/precision": str(trainer.precision)}
            for logger in trainer.loggers:
                logger.log_hyperparams(facts)

    on_test_start = on_predict_start = on_fit_start

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Describe a run that only validates."""
        self._validates |= not trainer.sanity_checking
        if trainer.state.fn == TrainerFn.VALIDATING:
            self.on_fit_start(trainer, pl_module)

    _validates = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say at the beginning that a training will never validate, where its epochs tell."""
        every, epochs = trainer.check_val_every_n_epoch, trainer.max_epochs
        self._validates = bool(trainer.fast_dev_run) or not trainer.enable_validation  # type: ignore[attr-defined]
        if every and epochs is not None and 0 <= epochs < every:
            self.on_train_end(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say that a training has never validated."""
        if not self._validates:
            rank_zero_info(
                f"this training does not validate, so that no best checkpoint is chosen: it has {trainer.max_epochs} "
                f"epochs or {trainer.max_steps} steps, and trainer.check_val_every_n_epoch is "
                f"{trainer.check_val_every_n_epoch}, trainer.val_check_interval {trainer.val_check_interval}"
            )
            self._validates = True


def describe_run(model: AnimationModel, data: SpeechMotionDataModule) -> dict[str, Any]:
    """Model, components, sizes, corpus, protocol and versions as flat entries of plain data."""
    protocol = model.evaluation.protocol
    parameters = {True: 0, False: 0}
    for parameter in model.parameters():
        parameters[parameter.requires_grad] += parameter.numel()
    return {
        "model": type(model).__name__,
        **{
            f"component/{kind}": str(component["class_path"]).rpartition(".")[2]
            for kind in registry.COMPONENTS
            if isinstance(component := model.hparams.get(kind), dict) and "class_path" in component
        },
        "parameters/trainable": parameters[True],
        "parameters/frozen": parameters[False],
        "data/corpus": data.corpus_name,
        "data/synthetic": data.synthetic,
        "data/manifest": manifest_hash(data.root),
        "data/people": ", ".join(f"{folder.name} {manifest_hash(folder)}" for folder in data.people) or "none",
        "protocol": protocol.name,
        "protocol_definition": protocol.describe(),
        "version/facediff": __version__,
        "version/torch": str(torch.__version__),
        "version/lightning": lightning.__version__,
    }


def provenance_of(trainer: Trainer, model: AnimationModel, data: SpeechMotionDataModule) -> Provenance:
    """The training run behind scores or predictions: seed, checkpoint, components and options."""
    facts = describe_run(model, data)
    path = Path(split_face(trainer.ckpt_path)[0]) if isinstance(trainer.ckpt_path, str | Path) else None
    seed, steps = (model.provenance.get(name, "") for name in ("seed", "steps"))
    scored = {"protocol", "metrics", "unseen_identity"}  # options of scoring, not of training
    options = {name: value for name, value in model.hparams.items() if name not in scored}
    trained = {name: value for name, value in model.data_options.items() if name not in ("root", "num_workers")}
    return Provenance(
        model=facts["model"],
        components={key.partition("/")[2]: name for key, name in facts.items() if key.startswith("component/")},
        recipe=hash_of({"model": options, "data": trained}),
        seed=int(seed) if seed.isdecimal() else None,
        steps=int(steps) if steps.isdecimal() else None,
        checkpoint=model_hash(path) if path is not None and path.exists() else "",
        corpus=facts["data/corpus"],
        manifest=facts["data/manifest"],
        parameters=facts["parameters/trainable"] + facts["parameters/frozen"],
        versions={key.partition("/")[2]: name for key, name in facts.items() if key.startswith("version/")},
    )


def manifest_hash(folder: Path) -> str:
    """SHA-256 of a corpus's ``manifest.json``; it changes with every file that the manifest lists. ``none`` without."""
    path = folder / "manifest.json"
    return sha256(path) if path.is_file() else "none"


class GradientNorm(Callback):
    """Logs the Euclidean norm of the gradient at every optimiser step, before it is clipped.

    The gradient is the one that the optimiser would get without clipping: summed over accumulated batches, averaged
    over the processes of data-parallel training, and without the scale of mixed precision. A step that mixed precision
    skips because of an overflow has the norm infinity or NaN.

    Args:
        components: also log the norm of every part's gradient, ``gradient/decoder`` and the like. Their squares add up
            to the square of ``gradient/norm``. A part of that name is ``gradient/norm_part``.
    """

    @checks_arguments
    def __init__(self, components: bool = False) -> None:
        self.components = components

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Log the norms; Lightning clips after this and removes the scale of mixed precision before."""
        if self.components:
            gradients = gradients_by_part(pl_module)
        else:
            gradients = {"": [parameter.grad for parameter in pl_module.parameters() if parameter.grad is not None]}
        norms = {name: get_total_norm(parts) for name, parts in gradients.items() if parts}
        if not norms:
            return
        logged = {f"gradient/{'norm_part' if name == 'norm' else name}": norm for name, norm in norms.items() if name}
        total = torch.linalg.vector_norm(torch.stack(list(norms.values())))
        pl_module.log_dict({**logged, "gradient/norm": total}, on_step=True, on_epoch=False)


def gradients_by_part(module: LightningModule) -> dict[str, list[Tensor]]:
    """The gradients of all parameters that have one, by the part of the module that the parameter belongs to.

    The part is the first word in which the parameters' names differ: ``network.decoder.…`` belongs to ``decoder``, also
    where the model has parts beside its network.
    """
    trained = [(name.removeprefix("network."), p) for name, p in module.named_parameters() if p.requires_grad]
    gradients = [(name.split("."), parameter.grad) for name, parameter in trained]
    shared = len(commonprefix([path[:-1] for path, _ in gradients])) if gradients else 0
    parts: dict[str, list[Tensor]] = {}
    for path, gradient in gradients:
        if gradient is not None:
            parts.setdefault(path[shared], []).append(gradient)
    return parts
