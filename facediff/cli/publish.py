"""``facediff publish``: a trained model as a folder for others, and on the Hugging Face hub."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from facediff.animation.options import LicenceOptions
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils import hub
from facediff.utils.option import Option


def publish(
    checkpoint: Annotated[Path, Option(metavar="CHECKPOINT", reads=True)],
    folder: Annotated[Path, Option(metavar="FOLDER", writes="folder", new=True)],
    *,
    license: Annotated[str | None, Option(metavar="NAME")] = None,
    name: Annotated[str | None, Option(metavar="NAME")] = None,
    push: Annotated[str | None, Option(metavar="USER/NAME")] = None,
    private: Annotated[bool, Option(needs="push")] = False,
    licence: LicenceOptions,
) -> None:
    """Write a trained model as a folder that others can use, and send it to the Hugging Face hub.

    The folder holds the weights, the corpus's mesh and templates, licence labels and a model card (README.md), but no
    state of the training: `facediff fit` cannot continue from it. Wherever a command takes a checkpoint, it takes such
    a folder too, and user/name[@revision] of the hub.

    For example:
      facediff publish demo/puppet.ckpt puppet --license apache-2.0
      facediff publish demo/puppet.ckpt puppet --push ada/puppet
      facediff animate speech.wav --checkpoint ada/puppet -o speech.mp4

    Args:
        checkpoint: trained model (.ckpt), a model folder, or user/name[@revision] of the hub
        folder: new folder to write
        license: licence of the weights, such as apache-2.0 or cc-by-nc-4.0 (default: the data's)
        name: the model's name on the card (default: from --push, else the folder's)
        push: send the folder to this name on the hub; log in with `hf auth login` before
        private: with --push: a new model is visible to its owner alone
        licence: which models are refused.
    """
    hub.check_model_source(checkpoint)
    if push is not None and not hub.is_hub_name(push):
        raise FaceDiffError(f"--push {push}: is no name of a model on the hub; expected user/name")

    from facediff.models import load_model
    from facediff.models.pretrained import published_licences
    from facediff.utils.licences import in_words

    model = load_model(checkpoint, commercial_only=licence.commercial_only)
    model.provenance = {"published_from": hub.model_name(checkpoint), **model.provenance}
    model.save_pretrained(folder, license=license, name=name or push)
    labels = in_words(published_licences(model.licences, license))
    size = sum(path.stat().st_size for path in folder.iterdir())
    weights = (folder / hub.WEIGHTS).stat().st_size
    tell(f"{folder}: {size / 1e6:.1f} MB, {weights / 1e6:.1f} of them weights; licence: {labels}")
    tell(f"{folder / hub.CARD}: model card; complete it before you publish")
    source = str(folder)
    if push is not None:
        tell(f"sent to {hub.push(folder, push, private=private)}")
        source = push
    tell(f"next: {shlex.join(['facediff', 'animate', 'speech.wav', '--checkpoint', source, '-o', 'speech.mp4'])}")
