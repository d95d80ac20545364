"""Figures of exact size in millimetres: fonts, colours, files, and pictures in rows and columns."""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.errors import check_known, needs_extra
from facediff.utils import ranges
from facediff.utils.files import atomic, check_writable

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


DATES: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None},
}
"""Formats by suffix, with the metadata that would differ between equal figures."""
COLUMN, PAGE = 85.0, 175.0  # Widths in mm of a column and of a page of the usual journals
POINTS_PER_MM = 72 / 25.4
SMALLEST_TEXT, TEXT = 7.0, 8.0  # Sizes of letters in points
FONT = "DejaVu Sans"
"""The font that comes with matplotlib: it has the letters of the IPA, and is the same on every machine."""

BLACK, GREY, FAINT = "#000000", "#595959", "#BFBFBF"
# Okabe and Ito's colours (2008), without black, which is the truth's, and yellow, which is too faint for lines.
LINES: tuple[tuple[str, Any], ...] = (
    ("#0072B2", "-"),
    ("#D55E00", (0, (5, 1.5))),
    ("#009E73", (0, (1.2, 1.2))),
    ("#CC79A7", (0, (5, 1.5, 1.2, 1.5))),
    ("#E69F00", (0, (3, 1))),
    ("#56B4E9", (0, (8, 1.5, 1.2, 1.5, 1.2, 1.5))),
)
"""Colour and dashes of each method's line, so that lines differ without colours too."""
PANEL_HEIGHT = 42.0  # Height in mm of axes with curves
GAP = 1.0  # Millimetres between pictures, and between pictures and labels
NAME_LINES = 2  # The most lines of a row's name


@dataclass(frozen=True)
class Paper:
    """Size, resolution and font of a figure."""

    width: ranges.PageWidth = PAGE  # in mm
    dpi: ranges.Resolution = 300  # of PNG and of the pictures inside PDF and SVG
    font: str = FONT  # family of all letters

    def __post_init__(self) -> None:
        ranges.check_options(self)

    def pixels(self, mm: float) -> int:
        """Whole pixels of a length."""
        return round(mm * self.dpi / 25.4)


def check_output(path: Path) -> None:
    """Check, before any work is done, that a figure can be written to a file."""
    check_known(path, "format", [path.suffix.lower()], DATES)
    check_writable(path)


def matplotlib() -> ModuleType:
    """The package matplotlib."""
    with needs_extra("matplotlib", "figures", "drawing figures"):
        import matplotlib as package
        import matplotlib.backends.backend_agg
        import matplotlib.figure
        import matplotlib.font_manager  # noqa: F401
    return package


@contextmanager
def style(paper: Paper) -> Iterator[None]:
    """Settings of matplotlib for drawing and saving a figure; the caller's own are restored afterwards."""
    package = matplotlib()
    check_known("--font", "font", [paper.font], sorted(set(package.font_manager.get_font_names())))
    settings = {
        "font.family": [paper.font],
        "font.size": TEXT,
        "axes.labelsize": TEXT,
        "axes.titlesize": TEXT,
        "xtick.labelsize": SMALLEST_TEXT,
        "ytick.labelsize": SMALLEST_TEXT,
        "legend.fontsize": TEXT,
        "legend.frameon": False,
        "legend.handlelength": 2.6,
        "axes.linewidth": 0.6,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.formatter.use_mathtext": False,
        "pdf.fonttype": 42,
        "svg.fonttype": "none",
        "svg.hashsalt": "facediff",
    }
    with package.rc_context(), warnings.catch_warnings():
        package.rcdefaults()  # a matplotlibrc of the user's must not change the figure
        package.rcParams.update(settings)
        yield


def line_style(number: int) -> dict[str, Any]:
    """Colour, dashes and width of a method's line, as matplotlib's options."""
    colour, dashes = LINES[number % len(LINES)]
    return {"color": colour, "linestyle": dashes, "linewidth": 1.1 if number < len(LINES) else 0.7}


def plain(text: str) -> str:
    """Text in which matplotlib sees no formula, nor a name that legends leave out: one that begins with "_"."""
    return f"{' ' * text.startswith('_')}{text}".replace("$", r"\$")


def new_figure(paper: Paper, height: float, **options: object) -> Figure:
    """An empty figure of whole pixels, without any of pyplot's state; options are matplotlib's for ``Figure``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    settings: dict[str, Any] = dict(options)
    # matplotlib rounds down to whole pixels, hence a little more.
    size = [(paper.pixels(mm) + 1e-3) / paper.dpi for mm in (paper.width, height)]
    figure = Figure(figsize=(size[0], size[1]), dpi=paper.dpi, facecolor="white", **settings)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's suffix, whole or not at all; the same figure gives the same bytes.

    Call it inside :func:`style`.
    """
    check_output(path)
    suffix = path.suffix.lower()
    with atomic(path) as temporary:
        content = io.BytesIO()  # on a full disk, matplotlib's writers fail with errors that do not say so
        figure.savefig(content, format=suffix[1:], dpi="figure", metadata=DATES[suffix])
        temporary.write_bytes(content.getbuffer())


def legend_columns(axes: Axes, paper: Paper) -> int:
    """The number of legend entries that surely fit on one line."""
    labels = axes.get_legend_handles_labels()[1]
    font_size = axes.xaxis.label.get_fontproperties().get_size_in_points()
    widest = max(text_width(label, font_size, paper.font) for label in labels)
    entry = widest + (2.6 + 0.8 + 2.0) * font_size / POINTS_PER_MM
    return max(1, min(len(labels), int((paper.width - 2) / entry)))


def text_width(text: str, size: float, font: str = FONT) -> float:
    """Width of a line of text in mm, at a size in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(family=font, size=size), False)
    return float(width) / POINTS_PER_MM


def wrapped(text: str, width: float, size: float, font: str = FONT) -> list[str]:
    """Text in lines of at most about a width in mm, by the mean width of its letters."""
    letters = int(len(text) * width / max(text_width(text, size, font), 1e-6))
    return textwrap.wrap(text, max(letters, 1)) or [""]


def line_height(size: float) -> float:
    """Height of a line of text in mm, at a size in points."""
    return 1.25 * size / POINTS_PER_MM


@dataclass(frozen=True)
class Heading:
    """The text above a column: a line in large letters and one in small ones; either may be empty."""

    large: str = ""
    small: str = ""


class Grid:
    """A figure of pictures of one size, laid out in mm: row names upright at the left, headings above the columns.

    Args:
        aspect: width of a picture by its height.
        highest: largest height of a picture in mm.
        right: mm that stay free at the right, for colour bars.
    """

    def __init__(
        self,
        paper: Paper,
        rows: Sequence[str],
        columns: Sequence[Heading],
        *,
        aspect: float,
        highest: float,
        right: float = 0.0,
        remark: str = "",
    ) -> None:
        self.paper, self.rows, self.columns, self.remark = paper, rows, columns, remark
        line = line_height(TEXT)
        lines = 1 if any(rows) else 0
        # The height of pictures follows from the width that names leave, and the lines of a name from the height:
        # this is repeated until the lines cannot grow any more.
        for _ in range(NAME_LINES):
            names = lines * line + (GAP if lines else 0)
            width = (paper.width - names - right - GAP * (len(columns) - 1)) / len(columns)
            height = min(width / aspect, highest)
            self.names = [wrapped(name, height, TEXT, paper.font) for name in rows]
            lines = min(max(map(len, self.names)), NAME_LINES) if any(rows) else 0
        self.width, self.height = aspect * height, height
        extent = names + len(columns) * self.width + (len(columns) - 1) * GAP + right
        self.left = (paper.width - extent) / 2 + names
        self.headings = [wrapped(heading.large, self.width, TEXT, paper.font) for heading in columns]
        self.header = max(len(text) * line * any(text) for text in self.headings)
        self.header += line_height(SMALLEST_TEXT) * any(heading.small for heading in columns)
        self.header += GAP if self.header else 0.0  # half above the headings, half below
        self.bottom = self.header + len(rows) * self.height + (len(rows) - 1) * GAP
        self.total = self.bottom + (line_height(SMALLEST_TEXT) + GAP / 2 if remark else 0.0)

    @property
    def pixels(self) -> tuple[int, int]:
        """Width and height of a picture in pixels."""
        return self.paper.pixels(self.width), self.paper.pixels(self.height)

    @property
    def end(self) -> float:
        """Where the last column ends, in mm from the left."""
        return self.left + len(self.columns) * (self.width + GAP) - GAP

    def place(self, row: int, column: int) -> tuple[float, float]:
        """Left and top of a picture, in mm."""
        return self.left + column * (self.width + GAP), self.header + row * (self.height + GAP)

    def draw_labels(self) -> Figure:
        """Make the figure with all labels on it; call it inside :func:`style`."""
        self.figure = new_figure(self.paper, self.total)
        line, small_line = line_height(TEXT), line_height(SMALLEST_TEXT)
        for row, lines in enumerate(self.names):
            middle = self.place(row, 0)[1] + self.height / 2
            name = lines if len(lines) <= NAME_LINES else [*lines[: NAME_LINES - 1], lines[NAME_LINES - 1][:-1] + "…"]
            for number, text in enumerate(reversed(name)):
                self._text(text, self.left - GAP - (number + 0.5) * line, middle, rotation=90)
        small = small_line * any(heading.small for heading in self.columns)
        for column, heading in enumerate(self.columns):
            x = self.place(0, column)[0] + self.width / 2
            if heading.small:
                self._text(heading.small, x, self.header - GAP / 2 - small / 2, size=SMALLEST_TEXT, color=GREY)
            for number, text in enumerate(reversed(self.headings[column])):
                self._text(text, x, self.header - GAP / 2 - small - (number + 0.5) * line)
        if self.remark:
            y = self.bottom + GAP / 2 + small_line / 2
            self._text(self.remark, self.end, y, ha="right", size=SMALLEST_TEXT, color=GREY)
        return self.figure

    def picture(self, picture: npt.NDArray[np.uint8], row: int, column: int) -> None:
        """Show a picture (height, width, 3) at its place, pixel for pixel."""
        height, width = picture.shape[:2]
        left, top = (self.paper.pixels(mm) for mm in self.place(row, column))
        axes = self._axes(left, top, width, height)
        axes.set_axis_off()
        axes.imshow(picture, interpolation="none", aspect="auto", extent=(0, width, 0, height))

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Axes in a rectangle in mm, with edges on whole pixels."""
        return self._axes(*(self.paper.pixels(mm) for mm in (left, top, width, height)))

    def _axes(self, left: int, top: int, width: int, height: int) -> Axes:
        across, down = self.paper.pixels(self.paper.width), self.paper.pixels(self.total)
        return self.figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))

    def _text(self, text: str, x: float, y: float, **options: object) -> None:
        settings: dict[str, Any] = {"va": "center", "ha": "center", "size": TEXT, **options}
        self.figure.text(x / self.paper.width, 1 - y / self.total, plain(text), **settings)
