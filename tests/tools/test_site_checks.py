"""What fails the build of the manual's site, beyond what MkDocs itself notices."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.site.checks import broken

DOCS = Path(__file__).parents[2] / "docs"


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
