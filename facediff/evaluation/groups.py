"""Attributes to group clips by: the columns of a corpus's ``clips.csv``, or the fields of its file names."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from facediff import registry
from facediff.data import SpeechMotionDataModule
from facediff.data.corpus import read_clip_table
from facediff.errors import FaceDiffError, choices


def attributes_of(corpus: Path | None, names: Collection[str], by: Sequence[str]) -> dict[str, dict[str, str]]:
    """The attributes ``by`` of each clip, empty where it has none.

    They are read from the corpus's ``clips.csv``, else from the clips' names, which hold them in some corpora.
    """
    table = {} if corpus is None else read_clip_table(corpus)
    by_clip = {name: table[name] if name in table else attributes_of_name(name) for name in names}
    available = sorted({attribute for attributes in by_clip.values() for attribute in attributes})
    for attribute in by:
        if attribute not in available:
            offered = (
                choices(attribute, available) if available else "list them in the columns of the corpus's clips.csv"
            )
            raise FaceDiffError(f"--by {attribute}: no clip has it: {offered}")
    return {
        name: {attribute: attributes.get(attribute, "") for attribute in by} for name, attributes in by_clip.items()
    }


def attributes_of_name(name: str) -> Mapping[str, str]:
    """The attributes in a clip's name, by the first corpus with attributes in names of this form."""
    modules: list[type[SpeechMotionDataModule]] = [entry.implementation for entry in registry.corpus]
    return next(filter(None, (module.name_attributes(name) for module in modules)), {})
