"""Every option of every command with wild values obeys the law of :mod:`tests.robustness.options`."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from facediff.cli.app import COMMANDS, main
from facediff.cli.data import CORPORA
from tests.robustness import options

# Commands that read and write more get fewer command lines.
EXAMPLES = {
    "export-model": 2,
    "animate": 16,
    "evaluate": 10,
    "data import-person": 8,
    "export": 14,
    "view": 10,
    "retarget": 8,
}
LIGHTNING = ("fit", "validate", "test", "predict")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return options.build_world(tmp_path_factory.mktemp("options") / "world")


def test_every_command_is_tried() -> None:
    tried = {*options.BASES, *LIGHTNING} - {f"data prepare {corpus}" for corpus in CORPORA} | {"data prepare"}
    assert tried == set(COMMANDS)


SLOW = {"export-model"}  # records graphs


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in SLOW else ())
        for name in options.BASES
        if not name.startswith("data prepare")
    ],
)
def test_the_usual_command_line_is_valid(name: str, world: Path, tmp_path: Path) -> None:
    assert options.obey(world, name, options.BASES[name].split(), tmp_path / "run") == (0, "")


@pytest.mark.parametrize("divisor", [2, pytest.param(1, marks=pytest.mark.slow)], ids=["half", "all"])
@pytest.mark.parametrize("name", options.BASES)
def test_wild_values_of_options(name: str, divisor: int, world: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    @settings(
        max_examples=EXAMPLES.get(name, 6) // divisor,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**32))
    def obeys(seed: int) -> None:
        words = options.draw(name, random.Random(seed))  # noqa: S311 - it must repeat
        _, problem = options.obey(world, name, words, tmp_path_factory.mktemp("out") / "run")
        assert problem == "", words

    obeys()


WORDS = st.sampled_from([*options.NUMBERS, *options.TEXTS, *options.FILES[:4]])


@pytest.mark.parametrize("name", LIGHTNING)
@settings(max_examples=12, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
@given(option=st.sampled_from(["confi", "modell", "data-root", "trainer_x", "ckpt"]), word=WORDS)
def test_options_that_training_does_not_have(name: str, option: str, word: str) -> None:
    assert main([name, f"--{option}={word}"]) == 2
