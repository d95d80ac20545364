"""Pictures in rows and columns with their labels, laid out in millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from facediff.figures.page import GREY, SMALLEST_TEXT, TEXT, Page, Paper, line_height, wrapped

GAP = 1.0
"""Millimetres between pictures, and between pictures and labels."""

NAME_LINES = 2
"""Lines that a row's name may have."""


@dataclass(frozen=True)
class Heading:
    """What is written above a column: a line in large letters and one in small ones; either may be empty."""

    large: str = ""
    small: str = ""


class Grid:
    """Places of pictures of one size; row names stand upright at the left, headings above the columns.

    Args:
        paper: what the figure is drawn on.
        rows: name of each row.
        columns: heading of each column.
        aspect: width of a picture by its height.
        highest: largest height of a picture in mm.
        right: mm that stay free at the right, for colour bars.
        remark: small text below everything.
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
        for _ in range(NAME_LINES):  # how many lines a name takes depends on the height, which depends on them
            names = lines * line + (GAP if lines else 0)
            width = (paper.width - names - right - GAP * (len(columns) - 1)) / len(columns)
            height = min(width / aspect, highest)
            self.names = [wrapped(name, height, TEXT, paper.font) for name in rows]
            lines = min(max(map(len, self.names)), NAME_LINES) if any(rows) else 0
        self.width, self.height = aspect * height, height
        used = names + len(columns) * self.width + (len(columns) - 1) * GAP + right
        self.left = (paper.width - used) / 2 + names
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

    def page(self) -> Page:
        """A page with all labels on it."""
        page = Page(self.paper, self.total)
        for row, lines in enumerate(self.names):
            _, top = self.place(row, 0)
            shown = lines if len(lines) <= NAME_LINES else [*lines[: NAME_LINES - 1], lines[NAME_LINES - 1][:-1] + "…"]
            for number, text in enumerate(reversed(shown)):
                x = self.left - GAP - (number + 0.5) * line_height(TEXT)
                page.text(text, x, top + self.height / 2, rotation=90)
        small = line_height(SMALLEST_TEXT) * any(heading.small for heading in self.columns)
        for column, heading in enumerate(self.columns):
            x = self.place(0, column)[0] + self.width / 2
            if heading.small:
                page.text(heading.small, x, self.header - GAP / 2 - small / 2, size=SMALLEST_TEXT, color=GREY)
            for number, text in enumerate(reversed(self.headings[column])):
                page.text(text, x, self.header - GAP / 2 - small - (number + 0.5) * line_height(TEXT))
        if self.remark:
            y = self.bottom + GAP / 2 + line_height(SMALLEST_TEXT) / 2
            page.text(self.remark, self.end, y, ha="right", size=SMALLEST_TEXT, color=GREY)
        return page
