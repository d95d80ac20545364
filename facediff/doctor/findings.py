"""What the doctor finds: one remark about one file, and how remarks of a kind are put together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from facediff.errors import FaceDiffError, MissingExtraError

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
FEW = 3
"""How many names of a list are told."""


@dataclass(frozen=True)
class Finding:
    """One remark.

    Attributes:
        severity: ``error``: training or scores would fail or be wrong; ``warning``: it works, and something is lost;
            ``note``: good to know.
        kind: a word for remarks of this sort; stable, for programs.
        where: the file or the field, relative to the corpus folder.
        message: what is the matter, and what to do.
    """

    severity: Severity
    kind: str
    where: str
    message: str


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Errors first, then warnings, then notes; within these, in the order in which they were found."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def grouped(findings: Iterable[Finding]) -> list[list[Finding]]:
    """Findings of equal severity and kind together, in the order of their first ones."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.severity, finding.kind), []).append(finding)
    return list(groups.values())


@contextmanager
def guarded(findings: list[Finding], kind: str, path: Path, root: Path) -> Iterator[None]:
    """Turn whatever goes wrong with a file into an error finding: the folder is not trusted.

    Args:
        findings: where the finding goes.
        kind: its kind.
        path: the file that is looked at.
        root: the corpus folder.

    Raises:
        MissingExtraError: as it comes; that is not the folder's fault.
    """
    where = relative(path, root)
    try:
        yield
    except MissingExtraError:
        raise
    except FaceDiffError as error:
        message = str(error).removeprefix(f"{path}: ").removeprefix(f"{root}: ")
        findings.append(Finding("error", kind, where, message))
    except Exception as error:  # a damaged file can fail anywhere in the library that reads it
        message = f"cannot be read ({type(error).__name__}: {error}); get it anew or remove it"
        findings.append(Finding("error", kind, where, message))


def relative(path: Path, root: Path) -> str:
    """A path as it is told: below the corpus folder if it is there."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def few(names: Iterable[object]) -> str:
    """The first few names of a list, and how many more there are."""
    words = [str(name) for name in names]
    more = f" and {number(len(words) - FEW)} more" if len(words) > FEW else ""
    return ", ".join(words[:FEW]) + more


def number(value: int) -> str:
    """A whole number with spaces between thousands.

    >>> number(23370)
    '23 370'
    """
    return f"{value:,}".replace(",", " ")


def counted(value: int, one: str, many: str | None = None) -> str:
    """A number and its noun.

    >>> counted(1, "clip"), counted(3879, "frame"), counted(2, "vertex", "vertices")
    ('1 clip', '3 879 frames', '2 vertices')
    """
    return f"{number(value)} {one if value == 1 else many or one + 's'}"
