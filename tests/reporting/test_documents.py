"""Documents: the same blocks in every form, and text from elsewhere that stays text."""

from __future__ import annotations

from xml.etree import ElementTree

from facediff.reporting.documents import (
    Bullets,
    Paragraph,
    ReportTable,
    Title,
    between,
    html_page,
    latex,
    markdown,
    markdown_text,
    p_value,
    terminal_text,
)

TABLE = ReportTable(
    ["", "score /1e-4 ↓"], [["ours", "1.5 ± 0.1"], ["still", None]], {(0, 1): "best"}, frozenset({1}), "50 % of a_b"
)
BLOCKS = [
    Title("Report"),
    Paragraph("made: up", warning=True),
    TABLE,
    Bullets(["one", "two"]),
]


def test_every_form_has_every_block() -> None:
    assert markdown(BLOCKS) == (
        "# Report\n\n**made**: up\n\n|  | score /1e-4 ↓ |\n|---|---:|\n| ours | **1.5 ± 0.1** |\n| *still* | – |\n\n"
        "- one\n- two\n"
    )
    assert terminal_text(BLOCKS).split() == (
        "Report made: up score /1e-4 ↓ ours 1.5 ± 0.1 (best) still – one two".split()  # noqa: SIM905 - reads as printed
    )
    table = latex([TABLE])
    assert r"score $/10^{-4}$ $\downarrow$" in table
    assert r"ours & \textbf{1.5 $\pm$ 0.1} \\" + "\n\\midrule\nstill & -- \\\\" in table
    assert r"\caption{50 \% of a\_b}" in table
    page = html_page("Report", BLOCKS)
    for part in ("<h1>Report</h1>", '<p class="warning">', "<li>two</li>"):
        assert part in page
    assert "default-src 'none'" in page


def test_a_table_of_a_page_shows_hostile_text_and_marks_single_cells() -> None:
    rows = [["<b>ours</b>", None], ["a & b\x1b[2J\nc", 'x"y']]
    page = html_page("", [ReportTable(["", "score"], rows, {(1, 1): "best", (0, 1): ""}, frozenset({1}))])
    root = ElementTree.fromstring(page[page.index("<table") : page.index("</div>")])  # noqa: S314 - our own
    cells = [[cell.text for cell in row] for row in root.iter("tr")]
    assert cells == [[None, "score"], ["<b>ours</b>", "–"], ["a & b\\x1b[2J\nc", 'x"y']]
    assert [row.get("class") for row in root.iter("tr")] == [None, None, "reference"]
    assert [cell.get("class") for cell in root.iter("td")] == [None, None, None, "best"]


def test_code_stays_code_and_all_else_stays_text() -> None:
    assert markdown_text("made by `a_b|c` and x_y") == "made by `a_b\\|c` and x\\_y"
    assert markdown_text("an odd ` and_") == "an odd \\` and\\_"
    assert markdown_text("# [a](http://b) \\*") == "\\# \\[a\\](http://b) \\\\\\*"


def test_what_is_not_known_is_a_dash() -> None:
    assert between(float("nan"), 1.0, str) == p_value(None) == "–"
    assert between(0.25, 1.0, "{:.1f}".format) == "[0.2, 1.0]"
    assert (p_value(0.0004), p_value(0.05)) == ("<0.001", "0.050")
