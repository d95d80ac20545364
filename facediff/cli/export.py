"""``facediff export``: animations as files of other programs."""

from __future__ import annotations

from dataclasses import replace

from facediff.animation.options import AnimationControls, ExportOptions, SourceOptions
from facediff.cli.options import Animations, Output, check_source, with_different_names
from facediff.cli.process import tell


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

    `facediff components export_format` lists the formats.

    Args:
        animations: motion: .npz of `facediff animate`, .npy, or ARKit's weights (.csv of Live Link Face, .json)
        output: file to write
        quiet: no progress bars
        files: how the files are written.
        source: mesh, frame rate and unit of a bare .npy.
        controls: changes of the animations.
    """
    check_source(source)

    from facediff.animation import Animation
    from facediff.editing.blendshapes import has_arkit_weights, is_built_in_face
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
    check_controls(controls)
    read = SourceReader(source).read
    motions: list[Animation] = [read(path) for path in animations]
    weights = seeks_weights(output, options) and all(
        has_arkit_weights(motion) or is_built_in_face(len(motion.template), motion.faces) for motion in motions
    )
    check_export(output, options, len(animations), weights=weights)
    if not controls.is_off:
        from facediff.editing.controls.controlled_face import apply_controls

        motions = [apply_controls(animation, controls) for animation in motions]
    for written in write_animations(output, with_different_names(motions, animations), options):
        inside = [file for file in written.iterdir() if file.is_file()] if written.is_dir() else [written]
        count = f"{len(inside)} files, " if written.is_dir() else ""
        tell(f"{written}: {count}{sum(file.stat().st_size for file in inside) / 1e6:.2f} MB")
    tell(FORMATS[output.suffix].next_step)
