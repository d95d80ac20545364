"""What fails the build of the manual's site, beyond what MkDocs itself notices."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.site.checks import broken, differences

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(
    ("source", "html", "element"),
    [
        ("Text\n- one\n- two\n", "<p>Text\n- one\n- two</p>", "<ul>"),  # no blank line before the list
        ("- one\n  - two\n", "<ul><li>one</li><li>two</li></ul>", "<ul>"),  # indented by two spaces
        ("> quoted\n", "<p>quoted</p>", "<blockquote>"),
    ],
)
def test_a_page_that_reads_differently_on_a_code_host_is_reported(source: str, html: str, element: str) -> None:
    assert any(problem.startswith(element) for problem in differences(source, html))


def test_a_page_that_reads_the_same_is_not_reported() -> None:
    source = "# Title\n\nText **bold**\n\n- one\n    - two\n\n| a | b |\n|---|---|\n| 1 | 2 |\n"
    html = '<h1 id="title">Title<a class="headerlink">¶</a></h1><p>Text <strong>bold</strong></p><ul><li>one<ul><li>two'
    html += "</li></ul></li></ul><table><thead><tr><th>a</th><th>b</th></tr></thead><tr><td>1</td><td>2</td></tr>"
    assert list(differences(source, html)) == []


def site(folder: Path, body: str) -> list[str]:
    (folder / "other.html").write_text('<h2 id="part">Part</h2>')
    (folder / "index.html").write_text(body)
    return list(broken(folder))


@pytest.mark.parametrize(
    "body", ['<a href="other.html#part">', '<a href="#top"><b id="top">', '<a href="mailto:a@b.c">']
)
def test_a_site_that_is_whole_has_nothing_to_report(tmp_path: Path, body: str) -> None:
    assert site(tmp_path, body) == []


@pytest.mark.parametrize(
    "body",
    [
        '<img src="missing.png">',
        '<a href="other.html#nowhere">',
        '<a href="sub/">',
        '<script src="https://cdn.example/a.js"></script>',
        '<link rel="stylesheet" href="//fonts.example/a.css">',
    ],
)
def test_links_to_nothing_and_to_the_network_are_reported(tmp_path: Path, body: str) -> None:
    assert len(site(tmp_path, body * 2)) in (1, 2)


def test_style_sheets_fetch_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.css").write_text("@font-face { src: url('https://fonts.example/a.woff') }")
    assert "a.css" in next(broken(tmp_path))


def test_every_picture_of_the_manual_is_shown_somewhere() -> None:
    shown = "".join(page.read_text() for page in DOCS.rglob("*.md"))
    assert [picture.name for picture in (DOCS / "images").iterdir() if picture.name not in shown] == []


def test_every_page_is_in_the_index() -> None:
    index = (DOCS / "README.md").read_text()
    pages = [page.relative_to(DOCS).as_posix() for suffix in ("md", "ipynb") for page in DOCS.rglob(f"*.{suffix}")]
    assert [page for page in sorted(pages) if page != "README.md" and f"]({page})" not in index] == []
