"""What has another name now: the one place of old names, which go on working until the next major version.

A command, an option or a public Python name that is renamed gets a line here and nowhere else. The old name works as
before, and one note or :class:`DeprecationWarning` says what it is called now. A test fails as soon as the package's
version is one in which an old name was to go. Depends on the standard library only.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Renamed:
    """The new name of something, since which version it has it, and in which one the old name goes."""

    new: str
    since: str
    until: str

    def note(self, old: str) -> str:
        """The sentence that users of the old name read."""
        return f"{old} is called {self.new} since facediff {self.since}; the old name goes with {self.until}"


COMMANDS = {"yardsticks": Renamed("generation-metrics", "1.0", "2.0")}

OPTIONS = {
    "--takes": Renamed("--samples", "1.0", "2.0"),
    "--directing-seed": Renamed("--controls-seed", "1.0", "2.0"),
    "--at-once": Renamed("--low-latency", "1.0", "2.0"),
}

NAMES = {
    "facediff.evaluation.Report": Renamed("EvaluationReport", "1.0", "2.0"),
    "facediff.study.Report": Renamed("StudyReport", "1.0", "2.0"),
    "facediff.benchmark.Plan": Renamed("BenchmarkPlan", "1.0", "2.0"),
    "facediff.benchmark.Outline": Renamed("ReportOutline", "1.0", "2.0"),
}


def current_option(word: str, flags: Collection[str]) -> str:
    """An option as it is typed, ``--old=3`` too, under its present name, with a note if that is another one.

    Args:
        word: what was typed.
        flags: the options of the command; an old name that is a name of its own there is left alone.
    """
    old, equals, value = word.partition("=")
    renamed = OPTIONS.get(old)
    if renamed is None or old in flags or renamed.new not in flags:
        return word
    tell(renamed.note(old))
    return renamed.new + equals + value


def tell(note: str) -> None:
    """Print a note to the terminal, apart from the output."""
    print(f"facediff: note: {note}", file=sys.stderr, flush=True)


def old_names(package: str) -> Callable[[str], object]:
    """``__getattr__`` of a package for its old names (PEP 562)."""

    def get(name: str) -> object:
        renamed = NAMES.get(f"{package}.{name}")
        if renamed is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        warnings.warn(renamed.note(f"{package}.{name}"), DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(package), renamed.new)

    return get
