"""``facediff view``: one HTML file that plays animations with their speech in any browser."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.cli.options import add_animation_options, surroundings, told_apart
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.animation.files import Surroundings


EPILOG = """\
The page is one file that loads nothing from anywhere: mail it, put it on a share, open it by a double click. Takes next
to each other need one frame rate and one length. A bare .npy borrows what it does not say from the first .npz given,
if both have equally many vertices."""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff view",
        description="Write one HTML file that plays animations with their speech in any browser.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "takes", type=Path, nargs="+", metavar="TAKE", help="motions, shown side by side: .npz or .npy; four at most"
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the page (.html)")
    made.add_argument(
        "--truth", type=Path, metavar="FILE", help="what the takes are compared with: shown first, and in heat maps"
    )
    made.add_argument("--labels", nargs="+", metavar="NAME", help="names to show, in the order of the panels")
    made.add_argument("--shortest", action="store_true", help="cut all to the shortest instead of refusing")
    made.add_argument("--max-mb", type=float, default=30.0, metavar="MB", help="largest page written (default: 30)")
    made.add_argument("--open", action="store_true", help="open the page in the browser")
    add_animation_options(made)
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Write a page.

    Raises:
        FaceDiffError: for anything that the user can put right; then nothing has been written.
    """
    args = parser().parse_args(list(arguments))
    if args.output.suffix not in (".html", ".htm"):
        raise FaceDiffError(f'--output {args.output}: unknown suffix "{args.output.suffix}"; expected .html')
    if not args.max_mb > 0:
        raise FaceDiffError(f"--max-mb {args.max_mb:g}: expected a number above 0")
    from facediff.export.viewer import write_page
    from facediff.utils.files import check_writable

    check_writable(args.output)
    paths = [*([] if args.truth is None else [args.truth]), *args.takes]
    takes = named(read_animations(paths, args), paths, args.labels)
    if args.shortest:
        takes = shortest(takes)
    write_page(args.output, takes, max_mb=args.max_mb, truth=None if args.truth is None else 0)
    size = args.output.stat().st_size / 1e6
    print(
        f"{args.output}: {len(takes[0].vertices)} frames of {len(takes)} take(s), {size:.1f} MB; open it in a browser"
    )
    if args.open:
        import webbrowser

        webbrowser.open(args.output.resolve().as_uri())
    return 0


def read_animations(paths: Sequence[Path], args: argparse.Namespace) -> list[Animation]:
    """The takes of all files, archives lending to arrays what those do not say.

    Raises:
        FaceDiffError: if a file is unreadable, or something needed is not said.
    """
    from facediff.animation import read_animation

    given, lent = surroundings(args)
    whole = {path: read_animation(path, given, lent) for path in paths if path.suffix == ".npz"}
    lender = next(iter(whole.values()), None)
    return [
        whole[path] if path in whole else read_animation(path, given, lent_to(path, lent, lender)) for path in paths
    ]


def lent_to(path: Path, lent: Surroundings | None, lender: Animation | None) -> Surroundings | None:
    """What completes an array: the checkpoint's facts before those of the lender."""
    if lender is None or path.suffix != ".npy":
        return lent
    from facediff.animation.files import Surroundings
    from facediff.utils.arrays import open_vertices

    if open_vertices(path).shape[1] != len(lender.template):
        return lent
    return (lent or Surroundings()).completed(Surroundings.of(lender))


def named(takes: Sequence[Animation], paths: Sequence[Path], labels: Sequence[str] | None) -> list[Animation]:
    """The takes under the names that are shown: the labels, else their own, else, where those are alike, the files'.

    Raises:
        FaceDiffError: if there are not as many names as takes.
    """
    if labels is None:
        return told_apart(takes, paths)
    if len(labels) != len(takes):
        raise FaceDiffError(
            f"--labels: {len(labels)} names for {len(takes)} panels; give one for each, the truth's first"
        )
    return [replace(animation, name=label) for animation, label in zip(takes, labels, strict=True)]


def shortest(takes: Sequence[Animation]) -> list[Animation]:
    """The takes, cut to the frames that all have."""
    frames = min(len(animation.vertices) for animation in takes)
    return [replace(animation, vertices=animation.vertices[:frames]) for animation in takes]
