"""Errors about options: what they carry, wherever they have been."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import pytest

from facediff.errors import OptionError

OPTION = OptionError("target_mesh", "no such file; omit {correspondence} too", "face.obj")
SENTENCE = OptionError.naming("face.obj: has no triangles; give {target_mesh}")
ERRORS = pytest.mark.parametrize("error", [OPTION, SENTENCE], ids=["option", "sentence"])


@ERRORS
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda error: pickle.loads(pickle.dumps(error)), "{}"),  # noqa: S301 - its own
        (lambda error: error.within("pairs.csv"), "pairs.csv: {}"),
    ],
    ids=["pickled", "within"],
)
def test_an_error_keeps_its_option(
    error: OptionError, change: Callable[[OptionError], OptionError], expected: str
) -> None:
    changed = change(error)
    assert changed.option == "target_mesh"
    assert changed.on_command_line == expected.format(error.on_command_line)
    assert str(changed) == expected.format(error)
