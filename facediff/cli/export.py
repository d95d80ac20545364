"""``facediff export``: animations as files of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from facediff.animation.options import AnimationControls, ExportOptions, SourceOptions
from facediff.cli.options import Animations, Output, check_source, with_different_names
from facediff.cli.parsing import with_more_help
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils.hub import bundled_by_name, may_have_weights


def format_table() -> str:
    """The formats, one a line."""
    from facediff.export import FORMATS

    return "formats:\n" + "\n".join(f"  {suffix:<7}{form.help}" for suffix, form in FORMATS.items())


@with_more_help(format_table)
def export(
    animations: Animations,
    *,
    output: Output,
    quiet: bool = False,
    files: ExportOptions,
    source: SourceOptions,
    controls: AnimationControls,
) -> None:
    """Write animations as files of other programs. The suffix of OUT chooses the format.

    Args:
        animations: motion: .npz of `facediff animate`, .npy, or ARKit's weights (.csv of Live Link Face, .json)
        output: file to write; formats below
        quiet: no progress bars
        files: how the files are written.
        source: mesh, frame rate and unit of a bare .npy.
        controls: changes of the animations.
    """
    check_source(source)

    from facediff.animation import Animation
    from facediff.editing.controls import check_controls
    from facediff.export import FORMATS, check_export, check_used, write_animations
    from facediff.export.writing import seeks_weights
    from facediff.pipelines.motion import SourceReader

    footer = ""  # under a video: the corpus, and whether it is synthetic
    if source.checkpoint is not None and "view" in getattr(FORMATS.get(output.suffix), "uses", ()):
        from facediff.pipelines.motion import corpus_of_model

        footer = corpus_of_model(source.checkpoint)
    check_used(output.suffix, files.changed())
    options = replace(files, footer=footer, quiet=quiet)
    lent = source.checkpoint is not None and may_have_weights(bundled_by_name(source.checkpoint))
    weights = seeks_weights(output, options) and all(
        _may_have_weights(path, path.suffix == ".npy" and lent) for path in animations
    )
    check_export(output, options, len(animations), weights=weights)
    check_controls(controls)
    read = SourceReader(source).read
    motions: list[Animation] = [read(path) for path in animations]
    if not controls.is_off:
        from facediff.editing.controls.controlled_face import apply_controls

        motions = [apply_controls(animation, controls) for animation in motions]
    for written in write_animations(output, with_different_names(motions, animations), options):
        inside = [file for file in written.iterdir() if file.is_file()] if written.is_dir() else [written]
        count = f"{len(inside)} files, " if written.is_dir() else ""
        tell(f"{written}: {count}{sum(file.stat().st_size for file in inside) / 1e6:.2f} MB")
    tell(FORMATS[output.suffix].next_step)


def _may_have_weights(path: Path, lent: bool) -> bool:
    """Whether weights can be had of a file's motion before it is read whole; ``lent`` where a model completes it."""
    from facediff.editing.blendshapes import is_built_in_face
    from facediff.editing.recorded_weights import SUFFIXES
    from facediff.utils.arrays import read_arrays

    if lent or path.suffix.lower() in SUFFIXES:
        return True
    try:
        arrays = read_arrays(path, ("values", "faces", "template")) if path.suffix == ".npz" else {}
    except FaceDiffError:  # reading the file in full reports the reason
        return False
    if "values" in arrays or not {"faces", "template"} <= arrays.keys():
        return "values" in arrays
    return is_built_in_face(arrays["template"].size // 3, arrays["faces"])
