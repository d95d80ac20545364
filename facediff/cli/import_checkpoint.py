"""``facediff import-checkpoint``: checkpoints of other projects become models of facediff."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from facediff.cli.options import File, Folder, Output
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils.option import Option

MOST_NAMED = 4
"""Tensors of one part of a model that are named one by one where they are not needed."""


def import_checkpoint(
    files: Annotated[list[Path], Option(metavar="FILE", reads=True)],
    *,
    output: Output,
    dataset: Literal["vocaset", "biwi", "multiface"] | None = None,
    identities: Annotated[Sequence[str] | None, Option(metavar="A,B,…")] = None,
    templates: File = None,
    regions: Folder = None,
    mesh: File = None,
    audio_config: File = None,
    option: Annotated[list[str] | None, Option(metavar="NAME=VALUE")] = None,
) -> None:
    """Make a model of a published method's checkpoint, as its authors distribute it.

    The method is recognised by the names of the tensors, all sizes by their shapes. The model gives what the authors'
    code gives, and is like any other: animate, test, evaluate, export. docs/methods.md has a page for each method.

    For example:
      facediff import-checkpoint vocaset.pth --templates templates.pkl -o faceformer.ckpt
      facediff animate speech.wav --checkpoint faceformer.ckpt --condition FaceTalk_170725_00137_TA -o speech.npy

    Args:
        files: the checkpoint; both of a method with two stages; of VOCA the checkpoint and DeepSpeech's graph
        output: checkpoint to write (.ckpt)
        dataset: what it was trained on, where the number of vertices does not say it
        identities: training identities in the order of the training command; by default the data set's usual ones
        templates: neutral faces by speaker (templates.pkl)
        regions: folder with lve.txt and fdd.txt, the vertices of lips and upper face
        mesh: the data set's mesh, for triangles, so that faces can be drawn
        audio_config: config.json of an audio encoder of unusual size
        option: an option of the model or its audio encoder that no file holds, such as num_heads=4; may be repeated
    """
    if output.suffix != ".ckpt":
        raise FaceDiffError(f"--output {output}: expected a name that ends in .ckpt")
    for path in files:
        # A checkpoint of TensorFlow is named by what its files' names begin with, too.
        if not path.is_file() and not path.with_name(f"{path.name}.index").is_file():
            raise FaceDiffError(f"{path}: no such file; expected the checkpoint of a published method")
    options: dict[str, object] = {}
    for words in option or []:
        name, equals, value = words.partition("=")
        if not equals or not name:
            raise FaceDiffError(f"--option {words}: expected a name and a value, such as num_heads=4")
        options[name] = [*as_list(options.get(name)), value] if name == "ignore" else value

    from facediff.models.published.importing import import_files, save_model

    made = import_files(
        files,
        dataset=dataset,
        identities=identities,
        templates=templates,
        regions=regions,
        mesh=mesh,
        audio_config=audio_config,
        **options,
    )
    save_model(made.model, output)
    model = made.model
    count = sum(parameter.numel() for parameter in model.parameters())
    tell(
        f"{output}: {type(model).__name__} of {made.dataset}, {model.n_vertices} vertices, {model.frame_rate:g} frames "
        f"a second, identities {', '.join(model.identities)}, {count / 1e6:.1f} M parameters from {made.used} tensors"
    )
    for names, why in gathered(made.ignored):
        tell(f"not needed: {names} ({why})")
    for licence in model.licences:
        tell(f"licence: {licence}")
    for note in made.notes:
        tell(f"note: {note}")
    if model.animates:
        tell(f"next: facediff animate speech.wav --checkpoint {output} -o speech.npy")
    else:
        tell(f"next: train what hears speech on it, with --model.prior={output}")


def gathered(ignored: Mapping[str, str]) -> list[tuple[str, str]]:
    """Tensors by the reason why they are not needed; many of one part of a model as their count.

    >>> gathered({"PPE.pe": "a table", **{f"head.{i}.weight": "of no use" for i in range(9)}})
    [('PPE.pe', 'a table'), ('head.… of 9 tensors', 'of no use')]
    """
    parts: dict[tuple[str, str], list[str]] = {}
    for name, why in ignored.items():
        parts.setdefault((name.split(".")[0], why), []).append(name)
    found: dict[str, list[str]] = {}
    for (part, why), names in parts.items():
        found.setdefault(why, []).extend(names if len(names) <= MOST_NAMED else [f"{part}.… of {len(names)} tensors"])
    return [(", ".join(names), why) for why, names in found.items()]


def as_list(value: object) -> list[object]:
    """What an option was given before."""
    return list(value) if isinstance(value, list) else []
