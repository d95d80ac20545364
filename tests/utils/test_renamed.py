"""Old names work, say the new one, and go when they were to go."""

import importlib
from typing import Annotated

import pytest

import facediff
from facediff.cli.app import COMMANDS, find, main
from facediff.cli.parsing import arguments_of
from facediff.errors import FaceDiffError
from facediff.utils import renamed
from facediff.utils.ranges import Range


def numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


EVERY = {**renamed.COMMANDS, **renamed.OPTIONS, **renamed.NAMES}


Number = Annotated[int, Range(0, 10)]


def present(*, samples: Number = 1, controls_seed: Number = 0, low_latency: bool = False) -> None:
    """A command whose options were renamed."""


def other(*, takes: Number = 1) -> None:
    """A command that has an option by the old name of another one."""


@pytest.mark.parametrize("old", EVERY)
def test_no_old_name_outlives_its_version(old: str) -> None:
    entry = EVERY[old]
    assert numbers(facediff.__version__) < numbers(entry.until)
    assert numbers(entry.until)[1:] == (0,), "names go with a major version only"
    assert numbers(entry.since) < numbers(entry.until)


def test_an_old_command_runs_and_says_its_new_name(capsys: pytest.CaptureFixture[str]) -> None:
    for old, entry in renamed.COMMANDS.items():
        assert entry.new in COMMANDS
        assert old not in COMMANDS
        assert find([old, "--json", "x"]) == (entry.new, ["--json", "x"])
        with pytest.raises(SystemExit, match="0"):
            main([old, "--help"])
        printed = capsys.readouterr()
        assert f"usage: facediff {entry.new}" in printed.out
        assert printed.err.count(entry.new) == 2


def test_an_old_option_is_read_as_the_new_one(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--takes=3", "--directing-seed", "4", "--at-once"]
    assert arguments_of(present, "x", words) == {"samples": 3, "controls_seed": 4, "low_latency": True}
    lines = capsys.readouterr().err.splitlines()
    assert all(e.new in line and old in line for (old, e), line in zip(renamed.OPTIONS.items(), lines, strict=True))
    with pytest.raises(FaceDiffError, match="--samples"):  # given twice, under both names
        arguments_of(present, "x", ["--takes", "3", "--samples", "4"])


def test_an_old_option_means_nothing_where_the_new_one_is_unknown() -> None:
    assert arguments_of(other, "x", ["--takes", "3"]) == {"takes": 3}
    with pytest.raises(FaceDiffError, match="--at-once"):
        arguments_of(other, "x", ["--at-once"])


@pytest.mark.parametrize("old", renamed.NAMES)
def test_an_old_python_name_is_the_new_one(old: str) -> None:
    module, _, name = old.rpartition(".")
    package = importlib.import_module(module)
    with pytest.warns(DeprecationWarning, match=renamed.NAMES[old].new):
        value = getattr(package, name)
    assert value is getattr(package, renamed.NAMES[old].new)
    assert name not in package.__all__
    with pytest.raises(AttributeError):
        _ = package.nonsense
