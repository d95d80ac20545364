"""``facediff import-checkpoint``: checkpoints of other projects become models of facediff."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

from facediff.animation.options import LicenceOptions
from facediff.cli.options import CheckpointFile
from facediff.cli.process import tell
from facediff.errors import counted
from facediff.models.published.import_options import ImportOptions
from facediff.utils.option import Option


def import_checkpoint(
    files: Annotated[list[Path], Option(metavar="FILE", reads=True)],
    *,
    output: CheckpointFile = Path("model.ckpt"),
    doctor: bool = False,
    facts: ImportOptions,
    licence: LicenceOptions,
) -> None:
    """Make a model of a published method's checkpoint, as its authors distribute it.

    The method is recognised by the names of the tensors. The model gives what the authors'
    code gives, and is like any other: animate, test, evaluate, export. docs/methods.md has a page for each method.

    For example:
      facediff import-checkpoint vocaset.pth --templates templates.pkl -o faceformer.ckpt
      facediff animate speech.wav --checkpoint faceformer.ckpt --condition FaceTalk_170725_00137_TA -o speech.npy

    Args:
        files: the checkpoint; both of a method with two stages; of VOCA the checkpoint and DeepSpeech's graph
        output: checkpoint to write (.ckpt)
        doctor: write nothing, and print differences of the files from the expected ones: names, shapes, hashes of files
        facts: identities, mesh and corpus, which the checkpoint does not hold
        licence: which licences are accepted
    """
    from facediff.models.published.importing import examine, import_files, save_model

    if doctor:
        for line in examine(files, facts):
            tell(line)
        return
    from facediff.utils.licences import require_cleared

    imported = import_files(files, facts)
    if licence.commercial_only:
        require_cleared(", ".join(map(str, files)), imported.model.licences)
    save_model(imported.model, output)
    model = imported.model
    identities = ", ".join(model.identities[:16]) + " …" * (len(model.identities) > 16)
    count = sum(parameter.numel() for parameter in model.parameters())
    tell(
        f"{output}: {type(model).__name__} of {imported.facts.dataset}, {model.n_vertices} "
        f"{'vertices' if model.space.is_vertices else 'channels'}, {model.frame_rate:g} "
        f"frames a second, identities {identities}, {count / 1e6:.1f} M parameters from "
        f"{len(imported.weights)} tensors"
    )
    for why, tensors in Counter(imported.files.ignored.values()).items():
        tell(f"not needed: {counted(tensors, 'tensor')} ({why})")
    for label in model.licences:
        tell(f"licence: {label}")
    for note in imported.facts.notes:
        tell(f"note: {note}")
    if model.animates:
        tell(f"next: facediff animate speech.wav --checkpoint {output} -o speech.npy")
    else:
        tell(f"next: train a model of speech on it, with --model.prior={output}")
