"""Attributes to group clips by: the columns of a corpus's ``clips.csv``, or the fields of its file names."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from facediff.data.corpus import read_clip_table
from facediff.errors import FaceDiffError, choices

BIWI_NAME = re.compile(r"[FM]\d_(e?)\d\d")
"""Of BIWI's 80 sequences of a speaker, 40 are emotional (e01 to e40) and 40 neutral (01 to 40)."""


def attributes_of(corpus: Path | None, names: Collection[str], by: Sequence[str]) -> dict[str, dict[str, str]]:
    """The attributes ``by`` of each clip, empty where it has none.

    Args:
        corpus: the corpus folder; its ``clips.csv`` is read if there is one.
        names: of the clips' files, without suffix. Those of 3DMEAD (``M003_001_4_1``: emotion, intensity) and of BIWI
            (``F2_e37``, ``F2_37``: emotional or neutral) hold attributes.
        by: which attributes.
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
    """The attributes in a clip's name in 3DMEAD and BIWI."""
    from facediff.data.mead3d import Mead3D

    clip = Mead3D.parse_name(name)
    if clip is not None:
        return clip.attributes
    biwi = BIWI_NAME.fullmatch(name)
    return {} if biwi is None else {"emotion": "emotional" if biwi[1] else "neutral"}
