"""Plots as SVG elements: alike on every run, without addresses, and with all text as text."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from facediff.reporting.drawing import LINES, MARKERS, plain, plot_svg, point_style


def draw(axes: Axes) -> None:
    axes.plot([0, 1], [1, 2], label="a_$x$ & <script> 字")
    axes.set_xlabel("steps")


def test_a_plot_is_one_element_that_loads_nothing() -> None:
    element = plot_svg(draw, 'errors "over" <steps>')
    assert element == plot_svg(draw, 'errors "over" <steps>')
    root = ElementTree.fromstring(element)  # noqa: S314 - our own
    assert root.get("aria-label") == 'errors "over" <steps>'
    assert "a_$x$ & <script> 字" in [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
    assert "metadata" not in element
    assert set(re.findall(r'(?:href|src)="([^"]?)', element)) <= {"#"}


def test_a_name_that_begins_with_an_underscore_is_in_the_legend() -> None:
    axes = Figure().add_subplot()
    axes.plot([0, 1], [1, 2], label=plain("_$old"))
    assert [label.strip() for label in axes.get_legend_handles_labels()[1]] == [r"_\$old"]


def test_thirty_rows_look_different() -> None:
    looks = {(point_style(number)["color"], point_style(number)["marker"]) for number in range(30)}
    assert len(looks) == len(LINES) * len(MARKERS) == 30
