"""The options of animating: one declaration for Python and the command line, checked where they are made."""

from __future__ import annotations

import dataclasses
import typing

import pytest

from facediff.animation.options import (
    GROUPS,
    AnimateKeywords,
    AnimationControls,
    AnimationOptions,
    ExportKeywords,
    ExportOptions,
    WindowOptions,
    option_texts,
)

# The model is there already, where an animation is asked for.
OF_THE_MODEL = {"checkpoint", "quiet", "device", "commercial_only", "threads"}
OF_A_FILE = {"carry", "own_shapes", "alive"}  # `Animation.drive` and `Animation.save` write it


def plain(hint: object) -> object:
    """A type hint as a set of types, without annotations."""
    return frozenset(typing.get_args(hint)) or hint


@pytest.mark.parametrize(
    ("options", "keywords", "without"),
    [
        (AnimationOptions, AnimateKeywords, OF_THE_MODEL | OF_A_FILE),
        (ExportOptions, ExportKeywords, {"footer", "quiet", "speech_file"}),
    ],
)
def test_keywords_are_the_fields_with_their_types(options: type, keywords: type, without: set[str]) -> None:
    fields = {name: plain(hint) for name, hint in typing.get_type_hints(options).items() if name not in without}
    assert {name: plain(hint) for name, hint in typing.get_type_hints(keywords).items()} == fields


def test_every_option_has_a_text_and_belongs_to_one_group() -> None:
    names = [field.name for group in GROUPS for field in dataclasses.fields(group)]
    assert len(names) == len(set(names))
    assert {*option_texts(AnimationOptions)} == {*names, "checkpoint", "quiet", "alive"}


def test_groups_are_merged_and_know_what_was_changed() -> None:
    options = AnimationOptions.of(
        WindowOptions(window=2.0), AnimationControls(blinks=True), checkpoint="a.ckpt", seed=None
    )
    assert options.changed() == {"window": 2.0, "blinks": 17.0, "seed": None}
    assert options.controls == AnimationControls(blinks=17.0)
    assert AnimationControls(gaze=False).is_off
