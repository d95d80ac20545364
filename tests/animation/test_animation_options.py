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
    RecordingOptions,
    TargetOptions,
    WindowOptions,
    option_texts,
)
from facediff.errors import OptionError
from facediff.speech.windows import LOW_LATENCY, LOW_LATENCY_STEPS

# The model is there already, where an animation is asked for.
OF_THE_MODEL = {"checkpoint", "quiet", "device", "commercial_only", "threads"}
OF_A_FILE = {"own_shapes"}  # `Animation.drive` writes it


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
    assert {*option_texts(AnimationOptions)} == {*names, "checkpoint", "quiet"}


def test_low_latency_is_described_by_its_figures() -> None:
    text = option_texts(WindowOptions)["low_latency"]
    assert f"{LOW_LATENCY.after:g} s of look-ahead" in text
    assert LOW_LATENCY_STEPS == 2
    assert "two denoising steps" in text


@pytest.mark.parametrize(
    ("group", "options", "option"),
    [
        (WindowOptions, {"low_latency": True, "window": 1.0}, "low_latency"),
        (WindowOptions, {"window": "long"}, "window"),
        (RecordingOptions, {"alignment": "a.csv", "transcript": "hello"}, "alignment"),
        (RecordingOptions, {"closure_budget": 3.0}, "closure_budget"),
        (RecordingOptions, {"denoise": "yes"}, "denoise"),
        (RecordingOptions, {"voice_shift": 13}, "voice_shift"),
        (TargetOptions, {"correspondence": "map.npz"}, "correspondence"),
        (AnimationControls, {"blinks": 1000}, "blinks"),
        (ExportOptions, {"view": "back"}, "view"),
    ],
)
def test_wrong_options_are_carried_by_the_error(group: type, options: dict[str, object], option: str) -> None:
    with pytest.raises(OptionError) as caught:
        group(**options)
    assert caught.value.option == option
    assert str(caught.value).startswith(option)
    assert caught.value.on_command_line.startswith(f"--{option.replace('_', '-')}")
    assert "{" not in str(caught.value)


def test_groups_are_merged_and_know_what_was_changed() -> None:
    options = AnimationOptions.of(
        WindowOptions(window=2.0), AnimationControls(blinks=True), checkpoint="a.ckpt", seed=None
    )
    assert options.changed() == {"window": 2.0, "blinks": 17.0, "seed": None}
    assert options.controls == AnimationControls(blinks=17.0)
    assert AnimationControls(gaze=False).is_off
