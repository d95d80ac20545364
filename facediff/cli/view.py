"""``facediff view``: one HTML file that plays animations with their speech in any browser."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import SourceOptions
from facediff.cli.options import Animations, check_source, with_different_names
from facediff.cli.process import tell
from facediff.errors import counted
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.animation import Animation


def view(
    animations: Animations,
    *,
    output: Annotated[Path, Option(also="-o", metavar="OUT", writes="file", suffixes=(".html", ".htm"))],
    truth: Annotated[Path | None, Option(metavar="FILE", reads=True, exists="file")] = None,
    labels: Annotated[list[str] | None, Option(metavar="NAME", many=True)] = None,
    shortest: bool = False,
    open: bool = False,  # noqa: A002 - the option's name
    source: SourceOptions,
) -> None:
    """Write one HTML file that plays animations with their speech in any browser.

    The page is one file that loads nothing from the network: mail it, put it on a share, open it by a double click.
    Animations next to each other need one frame rate and one length. A bare .npy takes mesh, frame rate and unit from
    the first .npz given, if both have equally many vertices.

    Args:
        animations: motions, shown side by side: .npz, .npy, or ARKit's weights (.csv of Live Link Face, .json); four at
            most
        output: the page (.html)
        truth: the reference of the animations: shown first, and in heat maps
        labels: names to show, in the order of the panels
        shortest: cut all to the shortest instead of refusing
        open: open the page in the browser
        source: mesh, frame rate and unit of a bare .npy.
    """
    paths = [*([] if truth is None else [truth]), *animations]
    check_source(source)

    from facediff.pipelines.motion import view as page_of

    panels = with_different_names(read_animations(paths, source), paths)
    first = None if truth is None else panels.pop(0)
    page = page_of(panels, truth=first, labels=labels, shortest=shortest)
    page.save(output)
    size = output.stat().st_size / 1e6
    frames, count = len(page.animations[0].vertices), len(page.animations)
    length = f"{counted(frames, 'frame')} of {counted(count, 'animation')}"
    tell(f"{output}: {length}, {size:.1f} MB; open it in a browser")
    if open:
        import webbrowser

        webbrowser.open(output.resolve().as_uri())


def read_animations(paths: Sequence[Path], source: SourceOptions) -> list[Animation]:
    """The animations of all files; the first archive completes arrays of as many vertices."""
    from facediff.pipelines.motion import SourceReader
    from facediff.utils.arrays import open_vertices

    reader = SourceReader(source)
    archives = {path: reader.read(path) for path in paths if path.suffix == ".npz"}
    lender = next(iter(archives.values()), None)
    animations: list[Animation] = []
    for path in paths:
        alike = lender is not None and path.suffix == ".npy" and open_vertices(path).shape[1] == len(lender.template)
        animations.append(archives[path] if path in archives else reader.read(path, lender if alike else None))
    return animations
