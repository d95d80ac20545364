"""What a strict build of MkDocs does not notice: raw links that lead nowhere, and the network."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

FETCHED = {"audio", "iframe", "img", "link", "script", "source", "video"}
"""Elements whose address a browser opens by itself."""


class Elements(HTMLParser):
    """Elements of a page, with their attributes.

    Attributes:
        found: the names and attributes in order.
        anchors: what ``#`` may follow in a link to the page.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.anchors: set[str] = set()
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keeps one element."""
        named = dict(attrs)
        self.found.append((tag, named))
        self.anchors |= {str(named[key]) for key in ("id", "name") if named.get(key)}


def broken(site: Path) -> Iterator[str]:
    """Links of the built site that lead nowhere, each once, and what a page would fetch from another place."""
    reported: set[tuple[Path, str]] = set()
    # The links of a server's page 404 begin at its root.
    paths = [path for path in sorted(site.rglob("*.html")) if path.name != "404.html"]
    pages = {path: Elements(path.read_text(encoding="utf-8")) for path in paths}
    for path, page in pages.items():
        for tag, attributes in page.found:
            address = attributes.get("src" if tag in FETCHED - {"link"} else "href") or ""
            parts = urlsplit(address)
            where = path.relative_to(site)
            if parts.scheme or parts.netloc:
                if tag in FETCHED and parts.scheme != "data":
                    yield f"{where}: <{tag}> fetches {address}; pages must work without a network"
                continue
            target = path if not parts.path else (path.parent / unquote(parts.path)).resolve()
            if target.is_dir():
                target /= "index.html"
            missing = not target.is_file()
            if not missing and (target not in pages or unquote(parts.fragment) in {"", *pages[target].anchors}):
                continue
            if (target, parts.fragment) not in reported:  # what the navigation links to is linked from every page
                yield f"{where}: {address} " + ("leads nowhere" if missing else "names no anchor of that page")
            reported.add((target, parts.fragment))
    for style in sorted(site.rglob("*.css")):
        for address in re.findall(r"url\(['\"]?(?!data:)(https?:[^)'\"]+)", style.read_text(encoding="utf-8")):
            yield f"{style.relative_to(site)}: fetches {address}"
