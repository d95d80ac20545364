"""Damaging packed corpora, and reading all of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.fakes.tiny import Tiny

TINY = "tests.fakes.tiny.Tiny"


def read_all(source: Path) -> None:
    """All that training and unpacking read."""
    data = Tiny(root=str(source))
    corpus = data.corpus
    for clip in corpus.clips.values():
        corpus.read_motion(clip)
        corpus.read_audio(clip, 0, corpus.frames(clip))
    data.packed.templates() if data.packed else None


def change(source: Path, key: str, value: Callable[[dict[str, Any]], object], file: str = "zarr.json") -> None:
    """Change a metadata file as its function says; ``key`` is where in it."""
    content = json.loads((source / file).read_text())
    place = content
    for part in key.split(".") if key else []:
        place = place[int(part) if part.isdecimal() else part]
    value(place)
    (source / file).write_text(json.dumps(content))


RECORD = "attributes.facediff"
