"""What the doctor finds: one remark about one file, and how remarks of a kind are put together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

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


# Published facts that a folder is held against.


@dataclass(frozen=True)
class CheckFigure:
    """What everybody's copy of a split has.

    Attributes:
        split: the split.
        clips: its clips.
        frames: its frames.
    """

    split: str
    clips: int
    frames: int


CHECK_FIGURES = {"biwi": CheckFigure("test_a", 24, 3879)}
"""BIWI: what users of CodeTalker's scoring script report for its six people and sentences 37 to 40."""

INCOMPLETE = {"vocaset"}
"""Corpora of which some clips were never recorded."""

NEVER_RECORDED = 0.05
"""Share of a split that may be missing of these without a warning; the true number is not published."""

TEMPLATES = {
    "biwi": {"606284c0": "FaceFormer and TalkingStyle", "d436309f": "FaceDiffuser and DiffSpeaker"},
    "vocaset": {"2fc95570": "TalkingStyle and DiffSpeaker"},
}
"""``templates.pkl`` in the repositories of which projects, by the beginning of the file's git blob id."""

UNIT_AREA = {"biwi"}
"""Corpora whose circulating templates have a surface area of one."""

FLAME_REGIONS = {
    "regions/lve.txt": 428,
    "regions/fdd.txt": 1501,
    "FLAME_masks.pkl:lips": 250,
    "regions/FLAME_masks.pkl:lips": 250,
    "FLAME_masks.pkl:forehead+eye_region": 827,
    "regions/FLAME_masks.pkl:forehead+eye_region": 827,
    "regions/lip.txt": 648,
}
REGIONS = {
    "biwi": {"regions/lve.txt": 4996, "regions/lip.txt": 4996, "BIWI_lip.pkl": 4996, "regions/fdd.txt": 7784},
    "vocaset": FLAME_REGIONS,
    "mead3d": FLAME_REGIONS,
}
"""Distinct vertices of the lists that circulate."""


# The doctor's report.

FORMAT = 1
"""Goes up when a field of the JSON object changes its meaning; new fields do not count."""


@dataclass
class Report:
    """What a folder is and what is wrong in it.

    Attributes:
        root: the folder.
        quick: whether headers only were read.
        corpus: name of the corpus; None if it was not recognised.
        data_module: import path of the data module that reads it; None for a person's folder, or if unknown.
        raw: name of the raw distribution that the folder holds instead of a corpus; None if it does not.
        frame_rate: motion frames a second that models see; None if unknown, as the next two.
        stored_frame_rate: motion frames a second on disk.
        n_vertices: vertices of the topology.
        findings: errors first, then warnings, then notes.
        splits: one row a split: way, split, expected, present, missing, frames, seconds, missing_clips.
        subjects: one row a subject: subject, trained_on, clips, frames, seconds, template.
        templates: file, subjects, broken (subjects whose template cannot be used), blob (git blob id), origin (whose
            file it is), areas.
        mesh: the mesh file that is used; None if there is none.
        regions: by name: source, count, hash, duplicates, circulating_count; None for one that cannot be used.
        manifest: there, ended (whether preparing has ended), facediff (version that wrote it), changed, missing.
    """

    root: Path
    quick: bool = False
    corpus: str | None = None
    data_module: str | None = None
    raw: str | None = None
    frame_rate: float | None = None
    stored_frame_rate: float | None = None
    n_vertices: int | None = None
    findings: list[Finding] = field(default_factory=list)
    splits: list[dict[str, Any]] = field(default_factory=list)
    subjects: list[dict[str, Any]] = field(default_factory=list)
    templates: dict[str, Any] = field(default_factory=dict)
    mesh: str | None = None
    regions: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether there is no error; warnings are allowed."""
        return not any(finding.severity == "error" for finding in self.findings)

    def state(self) -> dict[str, Any]:
        """The report as plain data, ready for JSON; the fields are those above with ``format`` and ``sound``."""
        plain = asdict(self) | {"root": str(self.root), "findings": [asdict(f) for f in by_severity(self.findings)]}
        return {"format": FORMAT, "sound": self.sound, **plain}
