"""``facediff export``: animations as files of other programs."""

from __future__ import annotations

from pathlib import Path

from facediff.cli.options import (
    Animations,
    ControlOptions,
    Output,
    OutputOptions,
    SourceOptions,
    with_different_names,
)
from facediff.cli.parsing import with_more_help
from facediff.errors import FaceDiffError


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
    if files.shapes is not None and output.suffix != ".csv":
        raise FaceDiffError(f"--shapes: is for weights; write .csv instead of {output.suffix}, or omit it")

    from facediff.export import FORMATS, check_export, write_animations

    options = files.export(footer=footer(source.checkpoint) if output.suffix == ".mp4" else "", quiet=quiet)
    check_export(output, options, len(animations))
    wanted = controls.controls()
    finished = [wanted.apply(source.read(path)) for path in animations]
    for written in write_animations(output, with_different_names(finished, animations), options):
        print(f"{written}: {size_of(written)}")
    print(FORMATS[output.suffix].next_step)


def footer(checkpoint: Path | None) -> str:
    """The text under a video: the corpus, and whether it is synthetic."""
    if checkpoint is None:
        return ""
    from facediff.models.checkpoint import read_assets

    assets = read_assets(checkpoint)
    return f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus


def size_of(path: Path) -> str:
    """How much was written, in words."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.is_file()]
        return f"{len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:.2f} MB"
    return f"{path.stat().st_size / 1e6:.2f} MB"
