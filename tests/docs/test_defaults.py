"""Defaults that the manual's tables state are those of the code."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from facediff import registry
from facediff.callbacks.previews import SamplingPreview
from facediff.utils.hints import defaults

DOCS = Path(__file__).parents[2] / "docs"
Owner = Callable[..., Any]


def rows(page: str, head: str, heading: str = "") -> list[list[str]]:
    """Cells of the first table that begins so, after a heading."""
    text = (DOCS / page).read_text()
    text = text.partition(heading)[2] if heading else text
    table = text.partition(f"\n{head}")[2].partition("\n\n")[0].splitlines()[2:]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]


def stated(options: str, values: str) -> dict[str, str]:
    """Options of one row with the values that stand beside them, without units and limits."""
    parts = [re.sub(r" (mm|degrees|at most).*|`", "", part.strip()) for part in values.split(", ")]
    return dict(zip(re.findall(r"`(\w+)`", options), parts, strict=False))


def compare(owner: Owner, promised: Mapping[str, str]) -> None:
    """Texts of the manual with defaults of the code, of which a name on the hub may be cut short."""
    own = defaults(owner)
    for option, text in promised.items():
        if isinstance(own[option], str):
            assert own[option].rpartition("/")[2] == ("" if text == "nothing" else text), option
        else:
            assert own[option] == yaml.safe_load(text), option


@pytest.mark.parametrize("name", registry.augmentation.names())
def test_defaults_of_augmentations(name: str) -> None:
    (options,) = [row[2] for row in rows("voices.md", "| augmentation |") if row[0] == f"`{name}`"]
    promised = dict(re.findall(r"(\w+)=([^,`]+)", options))
    compare(registry.augmentation.get(name), promised)
    assert promised.keys() == defaults(registry.augmentation.get(name)).keys()


@pytest.mark.parametrize("name", ["energy"])
def test_defaults_of_voice_gates(name: str) -> None:
    promised = {
        option: text
        for options, meaning, default in rows("voices.md", "| option | meaning | default |")
        for option, text in stated(options, default).items()
        if not meaning.startswith("`") or meaning.startswith(f"`{name}`")
    }
    compare(registry.voice_gate.get(name), promised)
    assert promised.keys() == defaults(registry.voice_gate.get(name)).keys()


@pytest.mark.parametrize(
    ("page", "head", "owner"),
    [
        ("animation_controls.md", "| option | default | is |", registry.acting.get("prosody")),
        ("monitoring.md", "| option | default | meaning |", SamplingPreview),
    ],
)
def test_defaults_of_whole_tables(page: str, head: str, owner: Owner) -> None:
    promised: dict[str, str] = {}
    for options, default, *_ in rows(page, head):
        promised |= stated(options, default)
    compare(owner, promised)
    assert promised.keys() == defaults(owner).keys()


@pytest.mark.parametrize(
    ("heading", "name", "count"),
    [
        ("FaceFormer", "FaceFormer", 2),
        ("CodeTalker", "CodeTalker", 3),
        ("FaceDiffuser", "FaceDiffuser", 3),
        ("DiffSpeaker", "DiffSpeaker", 4),
        ("SelfTalk", "SelfTalk", 6),
        ("TalkingStyle", "TalkingStyle", 2),
        ("VOCA", "Voca", 3),
        ("LAM-Audio2Expression", "LamAudio2Expression", 1),
        ("UniTalker", "UniTalker", 2),
    ],
)
def test_defaults_of_published_methods(heading: str, name: str, count: int) -> None:
    """As published, but where the table names another default; what depends on the data set has none."""
    promised: dict[str, str] = {}
    for options, published, *more in rows("methods.md", "| option |", f"\n## {heading}\n"):
        other = re.search(r"`(\w+)` (?:\(the default\)|is the default)", more[0])
        promised |= stated(options, f"`{other[1]}`" if other else published)
    own = defaults(registry.model.get(name))
    compared = {
        option: text for option, text in promised.items() if own.get(option) is not None and re.fullmatch(r"\S+", text)
    }
    compare(registry.model.get(name), compared)
    assert len(compared) == count, compared


@pytest.mark.parametrize("name", registry.corpus.names())
def test_defaults_of_corpora(name: str) -> None:
    """As method.md and data.md say: whole clips, and up to 100 frames of another clip of the same speaker."""
    own = defaults(registry.corpus.get(name))
    promised = {"window": None, "windows_per_clip": 1, "reference": "same_subject", "reference_frames": 100}
    promised |= {"batch_size": 8 if name.startswith("Puppet") else 1, "augmented_share": 1.0}
    promised |= {"Mead3D": {"split": "sentence"}}.get(name, {})
    assert {option: own[option] for option in promised} == promised
