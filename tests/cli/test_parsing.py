"""Command functions become parsers: every kind of parameter, every error, the help of every command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from facediff.cli.app import COMMANDS, load
from facediff.cli.data import CORPORA, options_of
from facediff.cli.parsing import (
    OptionGroup,
    Parameters,
    arguments_of,
    flat,
    make_parser,
    parameters_of,
    plain_text,
)
from facediff.errors import FaceDiffError
from facediff.utils.option import Option
from facediff.utils.ranges import Range

OWN_PARSERS = ("run", "lightning")
FUNCTIONS = sorted(name for name in COMMANDS if COMMANDS[name].target.partition(":")[2] not in OWN_PARSERS)


Second = Annotated[float, Range(0, 60)]


@dataclass(frozen=True)
class LookOptions:
    """How it looks.

    Only where there is a picture.

    Attributes:
        colour: of the face, 100 % sure
        blinks: blinks a minute
        share: between 0 and 1
    """

    colour: str = "grey"
    blinks: Annotated[float | None, Option(metavar="RATE", bare=17.0), Range(1, 40)] = None
    share: Annotated[float, Range(0, 1, above=True, below=True)] = 0.5


def command(
    recording: Path,
    others: Annotated[list[Path], Option(metavar="OTHER")],
    *,
    output: Annotated[Path, Option(also="-o", metavar="OUT")],
    name: Annotated[str | None, Option(without="quiet")] = None,
    strength: Annotated[int, Range(0, 10), Option(needs="name")] = 0,
    frame_rate: Annotated[float | None, Range(0, 1000, above=True)] = None,
    seed: Annotated[int, Range(0, 10)] = 0,
    precision: Literal["32", "bf16"] = "32",
    span: Annotated[tuple[Second, Second], Option(metavar=("FROM", "TO"))] = (0.0, 1.0),
    times: Annotated[list[Second] | None, Option(many=True)] = None,
    method: list[str] | None = None,
    sound: bool = True,
    quiet: bool = False,
    look: LookOptions,
) -> None:
    """Do something.

    This is ``literal`` text.

    Args:
        recording: a :func:`print` of ``speech``
        others: more
        output: what to write
        name: of it
        strength: of the name
        frame_rate: frames a second
        seed: of the noise
        precision: bits
        span: seconds
        times: columns
        method: repeatable
        sound: without sound
        quiet: no bars
        look: the group.
    """


def parsed(*words: str) -> dict[str, Any]:
    return arguments_of(command, "facediff command", ["a.wav", "b.wav", "-o", "out.mp4", *words])


def refused(*words: str) -> str:
    with pytest.raises(FaceDiffError) as caught:
        arguments_of(command, "facediff command", words)
    assert len(str(caught.value).splitlines()) == 1
    return caught.value.on_command_line


def test_defaults() -> None:
    assert parsed() == {
        "recording": Path("a.wav"),
        "others": [Path("b.wav")],
        "output": Path("out.mp4"),
        "name": None,
        "strength": 0,
        "frame_rate": None,
        "seed": 0,
        "precision": "32",
        "span": (0.0, 1.0),
        "times": None,
        "method": None,
        "sound": True,
        "quiet": False,
        "look": LookOptions(),
    }


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["--name", "007"], "name", "007"),
        (["--name", "null"], "name", "null"),
        (["--name", "[1, 2]"], "name", "[1, 2]"),
        (["--name=a=b"], "name", "a=b"),
        (["--frame-rate", "25"], "frame_rate", 25.0),
        (["--frame_rate", "25"], "frame_rate", 25.0),
        (["--precision", "bf16"], "precision", "bf16"),
        (["--span", "2", "3.5"], "span", (2.0, 3.5)),
        (["--times", "1", "2"], "times", [1.0, 2.0]),
        (["--method", "a=x", "--method", "b=y"], "method", ["a=x", "b=y"]),
        (["--no-sound"], "sound", False),
        (["--quiet"], "quiet", True),
        (["--seed", "10"], "seed", 10),
        (["--blinks"], "look", LookOptions(blinks=17.0)),
        (["--blinks", "3", "--colour", "red"], "look", LookOptions("red", 3.0)),
    ],
)
def test_values_have_the_type_of_their_hint(words: list[str], name: str, value: object) -> None:
    found = parsed(*words)[name]
    assert found == value
    assert type(found) is type(value)


FILES = ["a.wav", "b.wav", "-o", "out.mp4"]


def test_mistakes_name_the_option() -> None:
    assert "recording" in refused()
    assert "--output" in refused("a.wav", "b.wav")
    for words, named in (
        ("--sed 1", 'did you mean "--seed"'),
        ("--zzz", "--zzz"),
        ("--seed", "--seed"),
        ("--seed 1.5", "--seed 1.5"),
        ("--seed 11", "from 0 to 10"),
        ("--seed -1", "--seed"),
        ("--frame-rate nan", "--frame-rate nan"),
        ("--share 1", "and below 1"),
        ("--precision 16", "one of 32, bf16"),
        ("--span 1", "--span"),
        ("--blinks c.wav", "goes to the end"),
        ("--strength 1", "--strength: has no effect without --name; omit it"),
        ("--name x --quiet", "--name: has no effect with --quiet; omit it"),
    ):
        assert named in refused(*FILES, *words.split()), words


def test_a_sequence_is_one_word_with_commas() -> None:
    from collections.abc import Sequence

    def listed(*, subjects: Sequence[str] | None = None) -> None:
        """Nothing."""

    listed.__annotations__ = {"subjects": Sequence[str] | None}
    assert arguments_of(listed, "x", ["--subjects", "F2, F3"]) == {"subjects": ["F2", "F3"]}
    assert arguments_of(listed, "x", []) == {"subjects": None}


def test_a_positional_argument_with_a_default_may_be_missing() -> None:
    def optional(kind: str | None = None, *, json: bool = False) -> None:
        """Nothing."""

    assert arguments_of(optional, "x", []) == {"kind": None, "json": False}
    assert arguments_of(optional, "x", ["a", "--json"]) == {"kind": "a", "json": True}
    with pytest.raises(FaceDiffError, match="b: one argument too many"):
        arguments_of(optional, "x", ["a", "b"])


def test_docstrings_lose_what_only_web_pages_read() -> None:
    assert plain_text(r"``a`` of :class:`~x.y.B`, \|c\|") == "a of B, |c|"


def test_help_shows_groups_defaults_and_plain_text(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parsed("--help")
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "usage: facediff command" in text
    assert "How it looks:\n  Only where there is a picture." in text
    assert "a print of speech" in text
    assert "This is literal text." in text
    assert "of the face, 100 % sure (default: grey)" in " ".join(text.split())
    assert "--no-sound" in text
    assert "--frame_rate" not in text


def test_help_shows_defaults_of_zero_and_one_and_no_switch(capsys: pytest.CaptureFixture[str]) -> None:
    def command(*, count: int = 1, share: float = 0.0, quick: bool = False, name: str | None = None) -> None:
        """Nothing.

        Args:
            count: how many
            share: of what
            quick: no details
            name: of it
        """

    with pytest.raises(SystemExit):
        arguments_of(command, "x", ["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "how many (default: 1)" in text
    assert "of what (default: 0.0)" in text
    assert text.count("default") == 2


def all_parameters() -> dict[str, Parameters]:
    import importlib

    found: dict[str, Parameters] = {name: parameters_of(load(name)) for name in FUNCTIONS}
    for corpus in CORPORA:
        plan = importlib.import_module(f"facediff.data.prepare.{corpus}").plan
        found[f"data prepare {corpus}"] = options_of(plan)
    return found


def test_every_option_of_every_command_is_explained() -> None:
    for name in FUNCTIONS:
        parameters = parameters_of(load(name))
        text = make_parser(parameters, f"facediff {name}", "").format_help()
        for parameter in flat(parameters):
            assert parameter.help, f"{name}: {parameter.flag} has no help"
            assert parameter.positional or parameter.flag in text
        assert all(entry.title for entry in parameters.values() if isinstance(entry, OptionGroup))
        assert COMMANDS[name].help


# Options that have one name and two types, and why.
DIFFERENT = {
    "corpus": "the folder of a corpus where a video is imported; the name of one elsewhere",
    "frame_rate": "30 or 60 where VOCASET is prepared",
    "low_latency": "steps of a distillation in `adapt`; a flag elsewhere",
    "json": "`evaluate` writes a file; the others print",
    "scale": "a factor where a video is imported; the measure of a face where one is tracked",
}


def test_one_option_has_one_type_everywhere() -> None:
    found: dict[str, dict[Any, str]] = {}
    for command_name, parameters in all_parameters().items():
        for parameter in flat(parameters):
            if not parameter.positional and parameter.name not in DIFFERENT:
                kind = (str(parameter.value_type), parameter.is_list)
                found.setdefault(parameter.name, {}).setdefault(kind, command_name)
    assert {name: kinds for name, kinds in found.items() if len(kinds) > 1} == {}


def test_every_number_of_every_command_has_a_range() -> None:
    numbers = [
        (command_name, parameter)
        for command_name, parameters in all_parameters().items()
        for parameter in flat(parameters)
        if parameter.is_number
    ]
    assert len(numbers) > 40
    assert [(name, parameter.flag) for name, parameter in numbers if parameter.range is None] == []


def test_the_help_says_the_range(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parsed("--help")
    assert "of the noise; from 0 to 10" in " ".join(capsys.readouterr().out.split())


def test_an_option_given_twice_is_refused() -> None:
    for words in ("--seed 1 --seed 1", "--seed=1 --seed 2", "--frame-rate 1 --frame_rate 2", "-o again.mp4"):
        assert "is given twice" in refused(*FILES, *words.split())


def test_lists_and_switches_may_be_repeated() -> None:
    assert parsed("--method", "a=x", "--quiet", "--method", "b=y", "--quiet")["method"] == ["a=x", "b=y"]


def test_empty_words_and_empty_and_repeated_entries_are_refused() -> None:
    assert "--name" in refused(*FILES, "--name= ")
    assert "--output" in refused("a.wav", "b.wav", "-o", "\t")
    for word in (",", "F2,", "F2,,F3", "F2,F2"):
        with pytest.raises(FaceDiffError, match="--subjects"):
            arguments_of(load_plan(), "x", ["raw", "--subjects", word])


def load_plan() -> Callable[..., object]:
    from facediff.data.prepare.biwi import plan

    return plan
