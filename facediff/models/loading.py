"""Trained models from checkpoints and model folders, which :mod:`facediff.models.checkpoint` reads and checks."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, cast

import torch

from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.models.checkpoint import misfit, model_of, naming, read_checkpoint
from facediff.utils.licences import require_cleared


def load_model(path: Path | str, device: str = "cpu", *, commercial_only: bool = False) -> AnimationModel:
    """A trained model, ready for inference.

    Args:
        path: a checkpoint of any model, also of an installed package's; a model folder; or ``user/name[@revision]`` of
            the Hugging Face hub, where no such path exists.
        device: where it computes.
        commercial_only: refuse a model if its licence labels do not allow commercial use.

    Example:
        >>> model = load_model("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate(speech, identity="F1").vertices.shape  # doctest: +SKIP
        torch.Size([75, 1008, 3])
    """
    model = build_model(path, read_checkpoint(path))
    if commercial_only:
        require_cleared(path, model.licences)
    return model.to(device)


def build_model(path: Path | str, checkpoint: dict[str, Any]) -> AnimationModel:
    """The model of a checkpoint that :func:`read_checkpoint` has read, ready for inference on the CPU."""
    weights = checkpoint["state_dict"]
    # The model is rebuilt from its own options with the sizes that the checkpoint states; then come the assets,
    # before the weights, since tables of mesh encoders are among these.
    implementation, arguments = model_of(path, checkpoint["hyper_parameters"])
    with naming(path), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that are 0, for example
        built = implementation(**arguments)
        built.on_load_checkpoint(checkpoint)
        if difference := misfit(weights, built.state_dict()):
            raise FaceDiffError(difference)
        built.load_state_dict(weights)
        model = cast(AnimationModel, built.eval())  # no other model has what it extends
        check_styles(model)
    return model


def check_styles(model: AnimationModel) -> None:
    """Refuse styles of speakers that are not as long as the model's; a single number would fill all."""
    lengths = {len(style.vector) for style in model.person_styles.values()}
    if not lengths:
        return
    still = torch.zeros(1, 1, model.n_vertices, model.dims)
    with torch.inference_mode():
        width = model.encode_style(still, torch.ones(1, 1, dtype=torch.bool)).shape[-1]
    if lengths != {width}:
        raise FaceDiffError(
            f"its styles of speakers have {min(lengths)} numbers, those of its model {width}; the file is damaged"
        )
