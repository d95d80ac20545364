"""Which pages a search of the site finds first.

The theme's search is lunr.js in a browser. This ranks the same entries, a section of a page each, in the same way:
Okapi BM25, whole words or their beginnings, and a match in a heading counts a thousand times (the theme's boost).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

TITLE_BOOST, TEXT_BOOST = 1e3, 1.0
SATURATION, LENGTH_SHARE = 1.2, 0.75
"""k1 and b of BM25 as lunr.js has them."""


class Entry(NamedTuple):
    """A section of a page."""

    page: str
    title: list[str]
    text: list[str]


def words(text: str) -> list[str]:
    """The words of a text, in lower case."""
    return re.findall(r"\w+", text.lower())


def entries(docs: Path) -> Iterator[Entry]:
    """The sections of all pages of a folder, as the site's search has them."""
    for path in sorted(docs.rglob("*.md")):
        text = re.sub(r"\]\([^)]*\)", "]", path.read_text(encoding="utf-8"))
        # A comment in a block of code is no heading.
        text = re.sub(r"^```.*?^```", lambda block: block[0].replace("\n#", "\n"), text, flags=re.DOTALL | re.MULTILINE)
        for title, body in re.findall(r"^#+ (.+)\n((?:(?!#+ ).*\n?)*)", text, re.MULTILINE):
            yield Entry(path.relative_to(docs).as_posix(), words(title), words(body))


def ranking(docs: Path, query: str) -> list[str]:
    """The pages that match a query, by their best section."""
    sections = list(entries(docs))
    scores = [0.0] * len(sections)
    for boost, fields in (
        (TITLE_BOOST, [section.title for section in sections]),
        (TEXT_BOOST, [section.text for section in sections]),
    ):
        usual = sum(map(len, fields)) / len(fields)
        for term in words(query):
            counts = [sum(word.startswith(term) for word in field) for field in fields]
            matches = sum(count > 0 for count in counts)
            rarity = math.log(1 + (len(fields) - matches + 0.5) / (matches + 0.5))
            for place, (field, count) in enumerate(zip(fields, counts, strict=True)):
                length = 1 - LENGTH_SHARE + LENGTH_SHARE * len(field) / usual
                scores[place] += boost * rarity * count * (SATURATION + 1) / (count + SATURATION * length)
    best: dict[str, float] = {}
    for section, score in zip(sections, scores, strict=True):
        best[section.page] = max(best.get(section.page, 0.0), score)
    return sorted((page for page, score in best.items() if score > 0), key=lambda page: -best[page])
