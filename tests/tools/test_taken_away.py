"""What a version may not take from those who rely on the one before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

griffe = pytest.importorskip("griffe", reason="pip install 'facediff[docs]'")
pytest.importorskip("mkdocs", reason="pip install 'facediff[docs]'")

from tools.site.taken_away import reference, taken_away  # noqa: E402

Lines = Callable[[str, str], list[str]]

ONE = """
class Kept:
    size: int = 1

    def run(self, first: int, *, second: int = 2) -> int: ...

    def _own(self) -> None: ...

class Gone: ...
"""
PACKAGE = "from facediff.one import Gone as Gone\nfrom facediff.one import Kept as Kept\n"


@pytest.fixture
def lines(tmp_path: Path) -> Lines:
    """What a version with a package's __init__.py and a module takes away from :data:`ONE`."""

    def loaded(name: str, package: str, one: str) -> griffe.Module:
        folder = tmp_path / name / "facediff"
        (folder / "models").mkdir(parents=True)
        for file, text in {"__init__.py": "", "models/__init__.py": package, "one.py": one}.items():
            (folder / file).write_text(text)
        return griffe.load("facediff", search_paths=[folder.parent], try_relative_path=False, resolve_aliases=True)

    def found(package: str, one: str) -> list[str]:
        old, new = loaded("old", PACKAGE, ONE), loaded("new", package, one)
        return list(taken_away(old, new, ["facediff.models"]))

    return found


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("second: int = 2", "second: int = 3"), "second"),
        (("first: int, *, ", "*, "), "first"),
        (("size: int = 1", "length: int = 1"), "size"),
        (("def run(self, first: int", "def run(self, zeroth: int, first: int"), "zeroth"),
    ],
)
def test_what_is_missing_or_different_is_said(lines: Lines, change: tuple[str, str], said: str) -> None:
    assert any(said in line for line in lines(PACKAGE, ONE.replace(*change)))


def test_a_name_that_is_no_more_is_said(lines: Lines) -> None:
    said = lines(PACKAGE.splitlines(keepends=True)[1], ONE.replace("class Gone: ...", ""))
    assert "facediff.models.Gone: is no more" in said


def test_what_nobody_relies_on_may_go_and_more_may_come(lines: Lines) -> None:
    more = ONE.replace("    def _own(self) -> None: ...", "    def own(self) -> None: ...") + "\nclass New: ...\n"
    assert lines(PACKAGE, more.replace("second: int = 2", "second: int = 2, third: int = 3")) == []


def test_the_reference_is_that_of_the_manual() -> None:
    assert {"facediff", "facediff.models", "facediff.metrics"} <= {*reference()}
