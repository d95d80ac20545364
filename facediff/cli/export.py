"""``facediff export``: animations as files of other programs."""

from __future__ import annotations

from facediff.cli.options import (
    Animations,
    ControlOptions,
    Output,
    OutputOptions,
    SourceOptions,
    with_different_names,
)
from facediff.cli.parsing import with_more_help
from facediff.cli.process import tell


def format_table() -> str:
    """The formats, one a line."""
    from facediff.export import FORMATS

    return "formats:\n" + "\n".join(f"  {suffix:<7}{made.help}" for suffix, made in FORMATS.items())


@with_more_help(format_table)
def export(
    animations: Animations,
    *,
    output: Output,
    quiet: bool = False,
    files: OutputOptions,
    source: SourceOptions,
    controls: ControlOptions,
) -> None:
    """Write animations as files of other programs. The suffix of OUT chooses the format.

    Args:
        animations: motion: .npz of `facediff animate`, or .npy
        output: file to write; formats below
        quiet: no progress bars
        files: how the files are written.
        source: what completes a bare .npy.
        controls: what is changed in the animations.
    """
    source.check(animations)

    from facediff.export import FORMATS, check_export, write_animations

    footer = ""  # under a video: the corpus, and whether it is synthetic
    if source.checkpoint is not None and output.suffix == ".mp4":
        from facediff.models.checkpoint import read_assets

        assets = read_assets(source.checkpoint)
        footer = f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus
    files.check(output.suffix)
    options = files.export(footer=footer, quiet=quiet)
    check_export(output, options, len(animations))
    animation_controls = controls.controls()
    finished = [source.read(path) for path in animations]
    if not animation_controls.is_off:
        from facediff.editing.controlled import apply_controls

        finished = [apply_controls(animation, animation_controls) for animation in finished]
    for written in write_animations(output, with_different_names(finished, animations), options):
        inside = [file for file in written.iterdir() if file.is_file()] if written.is_dir() else [written]
        counted = f"{len(inside)} files, " if written.is_dir() else ""
        tell(f"{written}: {counted}{sum(file.stat().st_size for file in inside) / 1e6:.2f} MB")
    tell(FORMATS[output.suffix].next_step)
