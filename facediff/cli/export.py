"""``facediff export``: animations as files of other programs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.cli.options import (
    add_animation_options,
    add_directing_options,
    animation_of,
    assets_of,
    check_directing,
    directed,
    told_apart,
)
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.export import Format


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    from facediff.export import FORMATS

    made = argparse.ArgumentParser(
        "facediff export",
        description="Write animations as files of other programs. The suffix of OUT chooses the format.",
        epilog=format_table(FORMATS),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("takes", type=Path, nargs="+", metavar="TAKE", help="motion: .npz of `facediff animate`, or .npy")
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write; formats below")
    made.add_argument(
        "--output-unit", metavar="U", help="unit of length to convert to: m, cm, mm, in (default: the motion's own)"
    )
    made.add_argument("--up", choices=["y", "z"], help="axis that points up in the file (default: y)")
    made.add_argument("--no-speech", action="store_true", help="leave the sound away")
    made.add_argument("--shapes", type=Path, metavar="SHAPES", help="for .csv: folder of meshes, or .glb with targets")
    made.add_argument(
        "--tolerance", type=float, default=0.05, metavar="MM", help="for .glb: largest error in mm (default: 0.05)"
    )
    made.add_argument("--view", default="front", choices=["front", "three_quarter", "side"], help="for .mp4: camera")
    made.add_argument("--size", type=int, default=512, help="for .mp4: height and width in pixels (default: 512)")
    made.add_argument("--quiet", action="store_true", help="no progress bars")
    add_animation_options(made)
    add_directing_options(made)
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Export; what can be refused is refused before a take is read, and all files appear or none."""
    args = parser().parse_args(list(arguments))

    from facediff.export import FORMATS, ExportOptions, check_export, write_animations

    options = ExportOptions(
        unit=args.output_unit,
        up=args.up,
        speech=not args.no_speech,
        view=args.view,
        size=args.size,
        shapes=args.shapes,
        tolerance_mm=args.tolerance,
        footer=footer(args.checkpoint) if args.output.suffix == ".mp4" else "",
        quiet=args.quiet,
    )
    check_export(args.output, options, len(args.takes))
    check_directing(args)
    if args.shapes is not None and not FORMATS[args.output.suffix].needs_shapes:
        raise FaceDiffError(f"--shapes: is for weights; write .csv instead of {args.output.suffix}, or leave it away")
    takes = told_apart([directed(animation_of(path, args), args) for path in args.takes], args.takes)
    for written in write_animations(args.output, takes, options):
        print(f"{written}: {size_of(written)}")
    print(FORMATS[args.output.suffix].next_step)
    return 0


def footer(checkpoint: Path | None) -> str:
    """What stands under a video: the corpus, and whether a program made it."""
    if checkpoint is None:
        return ""
    assets = assets_of(checkpoint)
    return f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus


def format_table(formats: Mapping[str, Format]) -> str:
    """The formats, one a line."""
    return "formats:\n" + "\n".join(f"  {suffix:<7}{made.help}" for suffix, made in formats.items())


def size_of(path: Path) -> str:
    """How much there is, in words."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.is_file()]
        return f"{len(files)} files, {sum(file.stat().st_size for file in files) / 1e6:.2f} MB"
    return f"{path.stat().st_size / 1e6:.2f} MB"
