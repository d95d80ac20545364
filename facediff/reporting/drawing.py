"""Drawing with matplotlib: settings that do not depend on the user's, lines that differ without colours, and SVG."""

from __future__ import annotations

import html
import importlib.util
import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from facediff.errors import needs_extra

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.axes import Axes

SMALLEST_TEXT, TEXT = 7.0, 8.0  # Sizes of letters in points
FONT = "DejaVu Sans"
"""The font that comes with matplotlib: it has the letters of the IPA, and is the same on every machine."""
GREY = "#595959"

# Okabe and Ito's colours (2008), without black, which is the truth's, and yellow, which is too faint for lines.
LINES: tuple[tuple[str, Any], ...] = (
    ("#0072B2", "-"),
    ("#D55E00", (0, (5, 1.5))),
    ("#009E73", (0, (1.2, 1.2))),
    ("#CC79A7", (0, (5, 1.5, 1.2, 1.5))),
    ("#E69F00", (0, (3, 1))),
    ("#56B4E9", (0, (8, 1.5, 1.2, 1.5, 1.2, 1.5))),
)
"""Colour and dashes of each line, so that lines differ without colours too."""
MARKERS = "os^Dv"
"""Shapes of points: a combination of colour and shape comes again after thirty rows."""
LONGEST_LABEL = 34  # Letters of a legend's entry


def matplotlib() -> ModuleType:
    """The package matplotlib."""
    with needs_extra("matplotlib", "figures", "drawing figures"):
        import matplotlib as package
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401
    return package


def has_matplotlib() -> bool:
    """Whether plots can be drawn; reports are written without them otherwise."""
    return importlib.util.find_spec("matplotlib") is not None


@contextmanager
def drawing_settings(font: str = FONT) -> Iterator[None]:
    """Settings of matplotlib for drawing and saving a figure; the caller's own are restored afterwards."""
    package = matplotlib()
    settings = {
        "font.family": [font],
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
    """Colour, dashes and width of a method's or run's line, as matplotlib's options."""
    colour, dashes = LINES[number % len(LINES)]
    return {"color": colour, "linestyle": dashes, "linewidth": 1.1 if number < len(LINES) else 0.7}


def point_style(number: int) -> dict[str, Any]:
    """Colour and shape of a row's points, as matplotlib's options."""
    shape = MARKERS[(number + number // len(LINES)) % len(MARKERS)]
    return {"color": LINES[number % len(LINES)][0], "marker": shape, "markersize": 3.5, "alpha": 0.8}


def listed(text: str) -> str:
    """A label that legends have, although matplotlib leaves out those that begin with "_"."""
    return f" {text}" if text.startswith("_") else text


def plain(text: str) -> str:
    """Text in which matplotlib sees no formula, nor a name that legends leave out: one that begins with "_"."""
    return listed(text).replace("$", r"\$")


def plot_svg(draw: Callable[[Axes], None], label: str, *, width: float = 4.8, height: float = 3.4) -> str:
    """A plot as an SVG element for a page; equal plots give equal text.

    Args:
        draw: draws into the axes. Its labels form a legend below them.
        label: a description for readers who cannot see it.
        width: in inches.
        height: of the plot in inches; a legend is added to it.
    """
    with drawing_settings():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
        axes = figure.add_subplot()
        draw(axes)
        handles, names = axes.get_legend_handles_labels()
        if names:
            figure.set_figheight(height + 0.19 * -(-len(names) // 2))
            labels = [plain(name[:LONGEST_LABEL]) for name in names]
            figure.legend(handles, labels, loc="outside lower left", ncols=2)
        # The browser draws the letters: those that matplotlib's font lacks are no fault.
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing", UserWarning)
        content = io.StringIO()
        figure.savefig(content, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    element = content.getvalue()
    element = re.sub(r"<metadata>.*?</metadata>\s*", "", element[element.index("<svg") :], count=1, flags=re.DOTALL)
    return element.replace("<svg ", f'<svg role="img" aria-label="{html.escape(label)}" ', 1).strip()
