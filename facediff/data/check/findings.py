"""The report of a check: its findings, as data and as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from facediff.errors import FaceDiffError, MissingExtraError, counted, number, printable
from facediff.utils.text_tables import format_table

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
FEW = 3  # how many names of a list are printed
LISTED = 4  # findings of a kind that are printed one by one; of more, only the first is
FORMAT = 1  # goes up when a field of the JSON object changes its meaning; new fields do not count

SPLIT_NAMES = {"test_a": "test A", "test_b": "test B", "test_c": "test C", "none": "(style references only)"}


@dataclass(frozen=True)
class Finding:
    """One finding."""

    # error: training or scores would fail or be wrong; warning: it works, and something is lost; note: good to know
    severity: Severity
    kind: str  # identifier of findings of this kind; stable, for programs
    where: str  # the file or the field, relative to the corpus folder
    message: str  # the problem, and its remedy


class Findings(list[Finding]):
    """A list of findings, in the order in which they were made."""

    def error(self, kind: str, where: str, message: str) -> None:
        """Add an error."""
        self.append(Finding("error", kind, where, message))

    def warning(self, kind: str, where: str, message: str) -> None:
        """Add a warning."""
        self.append(Finding("warning", kind, where, message))

    def note(self, kind: str, where: str, message: str) -> None:
        """Add a note."""
        self.append(Finding("note", kind, where, message))

    @contextmanager
    def guard(self, kind: str, path: Path, root: Path) -> Iterator[None]:
        """Turn every exception about a file into an error of the report: the folder is not trusted."""
        try:
            yield
        except MissingExtraError:
            raise
        except FaceDiffError as error:
            self.error(kind, relative(path, root), str(error).removeprefix(f"{path}: ").removeprefix(f"{root}: "))
        except Exception as error:  # a damaged file can fail anywhere in the library that reads it
            message = f"cannot be read ({type(error).__name__}: {error}); get it again or remove it"
            self.error(kind, relative(path, root), message)


@dataclass
class CheckReport:
    """The corpus in a folder, its contents and its defects."""

    root: Path | str  # an address of a packed corpus is a text
    quick: bool = False  # whether headers only were read
    corpus: str | None = None  # name of the corpus; None if it was not recognised
    # import path of the data module that reads it; None for a person's folder, or if unknown
    data_module: str | None = None
    frame_rate: float | None = None  # motion frames a second that models see; None if unknown, as the next two
    stored_frame_rate: float | None = None  # motion frames a second on disk
    n_vertices: int | None = None
    points: str = "vertices"  # what n_vertices counts
    findings: Findings = field(default_factory=Findings)  # errors first, then warnings, then notes
    # one row a split: way, split, expected, present, missing, frames, seconds, missing_clips
    splits: list[dict[str, Any]] = field(default_factory=list)
    # one row a subject: subject, trained_on, clips, frames, seconds, template
    subjects: list[dict[str, Any]] = field(default_factory=list)
    # file, subjects, broken (subjects without a usable template), blob (git blob id), origin (project of the file),
    # areas
    templates: dict[str, Any] = field(default_factory=dict)
    mesh: str | None = None  # the mesh file that is used; None if there is none
    # by name: source, count, hash, duplicates, circulating_count; None for one that cannot be used
    regions: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    # there, ended (whether preparation has ended), facediff (version that wrote it), changed, missing
    manifest: dict[str, Any] = field(default_factory=lambda: {"changed": [], "missing": []})

    @property
    def sound(self) -> bool:
        """Whether there is no error; warnings are allowed."""
        return not any(finding.severity == "error" for finding in self.findings)

    def sorted(self) -> CheckReport:
        """Put errors first, then warnings, then notes; within these, the order stays."""
        self.findings.sort(key=lambda finding: SEVERITIES.index(finding.severity))
        return self

    def state(self) -> dict[str, Any]:
        """The report as plain data, ready for JSON; the fields are those above with ``format`` and ``sound``."""
        return {"format": FORMAT, "sound": self.sound, **asdict(self), "root": str(self.root)}


# Texts of findings.


def relative(path: Path, root: Path) -> str:
    """A path as findings show it: relative to the corpus folder if it lies there."""
    return path.relative_to(root).as_posix() if path != root and path.is_relative_to(root) else str(path)


def few(names: Iterable[object]) -> str:
    """The first few names of a list, and how many more there are."""
    texts = [str(name) for name in names]
    more = f" and {number(len(texts) - FEW)} more" if len(texts) > FEW else ""
    return ", ".join(texts[:FEW]) + more


# The report as text.


def text(report: CheckReport) -> str:
    """The report as text for a terminal; characters that could control it are escaped."""
    blocks = [_heading(report)]
    if report.splits:
        blocks.append(_splits(report))
    if report.subjects:
        blocks.append(_subjects(report))
    if report.corpus is not None and report.points == "vertices":
        blocks.append(_shared_files(report))
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in report.findings:
        groups.setdefault((finding.severity, finding.kind), []).append(finding)
    if groups:
        blocks.append("\n".join(line for group in groups.values() for line in _remark(group)))
    blocks.append(_verdict(report))
    return "\n".join(printable(line) for line in "\n\n".join(blocks).split("\n"))


def _heading(report: CheckReport) -> str:
    if report.corpus is None:
        return f"{report.root}: not recognised"
    module = f", data module {report.data_module}" if report.data_module else ""
    rate = f"{report.frame_rate:g} frames a second"
    if report.stored_frame_rate not in (None, report.frame_rate):
        rate += f" ({report.stored_frame_rate:g} on disk)"
    read = "headers only" if report.quick else "all files"
    return (
        f"{report.root}: {report.corpus}{module}\n{number(report.n_vertices or 0)} {report.points}, {rate}; {read} read"
    )


def _splits(report: CheckReport) -> str:
    ways = ["way"] if any(row["way"] is not None for row in report.splits) else []
    counts = ["expected", "present", "missing", "frames", "seconds"]
    rows = [
        [
            *(printable(row[way] or "") for way in ways),
            printable(SPLIT_NAMES.get(row["split"], row["split"])),
            *(_figure(row[key]) for key in counts),
        ]
        for row in report.splits
    ]
    return format_table([*ways, "split", *counts], rows, left=1 + len(ways))


def _subjects(report: CheckReport) -> str:
    rows = [
        [
            printable(row["subject"]),
            *(_figure(row[key]) for key in ("clips", "frames", "seconds")),
            "yes" if row["template"] else "no",
            "yes" if row["trained_on"] else "no",
        ]
        for row in report.subjects
    ]
    return format_table(["subject", "clips", "frames", "seconds", "template", "trained on"], rows)


def _shared_files(report: CheckReport) -> str:
    rows = [["templates", _templates(report.templates)], ["mesh", report.mesh or "none"]]
    for name, region in report.regions.items():
        description = "none that can be used"
        if region is not None:
            description = f"{region['source']}, {counted(region['count'], 'vertex', 'vertices')}, hash {region['hash']}"
            if region["count"] == region["circulating_count"]:
                description += ", as many as the list that circulates has"
        rows.append([name.replace("_", " "), description])
    rows.append(["manifest", _manifest(report.manifest)])
    return format_table([], [[printable(cell) for cell in row] for row in rows], left=2)


def _templates(templates: Mapping[str, Any]) -> str:
    if not templates["file"]:
        return "none that can be read"
    description = (
        f"templates.pkl, {counted(len(templates['subjects']), 'subject')}, git blob {str(templates['blob'])[:8]}"
    )
    description += f" ({templates['origin']})" if templates["origin"] else ""
    areas = list((templates["areas"] or {}).values())
    return description + (f", surface areas {min(areas):.6g} to {max(areas):.6g}" if areas else "")


def _manifest(manifest: Mapping[str, Any]) -> str:
    if not manifest["there"]:
        return "none: not made by `facediff data prepare`"
    writer = f"written by facediff {manifest['facediff']}" if manifest["facediff"] else "there"
    wrong = [f"{number(len(manifest[key]))} {key}" for key in ("changed", "missing") if manifest[key]]
    return f"{writer}; files {' and '.join(wrong) if wrong else 'as recorded'}"


def _remark(group: Sequence[Finding]) -> list[str]:
    """Findings of one kind: each of them if they are few, else the first and where the others are."""
    first = group[0]
    label = first.severity.upper() if first.severity != "note" else "note"
    if len(group) <= LISTED:
        return [f"{label:<8} {finding.where}: {finding.message}" for finding in group]
    return [
        f"{label:<8} {number(len(group))} times {first.kind}, the first: {first.where}: {first.message}",
        f"{'':<8} also {few(finding.where for finding in group[1:])}",
    ]


def _verdict(report: CheckReport) -> str:
    counts = {s: sum(finding.severity == s for finding in report.findings) for s in ("error", "warning")}
    summary = ", ".join(counted(count, severity) for severity, count in counts.items() if count)
    if report.sound and not summary:
        return "sound: nothing is wrong with this copy"
    return f"{'sound' if report.sound else 'not sound'}{f': {summary}' if summary else ''}"


def _figure(value: float | None) -> str | None:
    if value is None:
        return None
    return f"{value:.1f}" if isinstance(value, float) else number(value)
