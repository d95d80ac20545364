"""The report as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from facediff.data.check.findings import Finding, Report, counted, few, grouped, number

LISTED = 4
"""Findings of a kind that are told one by one; of more, only the first is."""

SPLIT_NAMES = {"test_a": "test A", "test_b": "test B", "none": "(style references only)"}


def text(report: Report) -> str:
    """The report, a line for each thing; whatever in it could steer a terminal is spelled out."""
    lines = [*_heading(report)]
    if report.splits:
        lines += ["", *_splits(report)]
    if report.subjects:
        lines += ["", *_subjects(report)]
    if report.corpus is not None:
        lines += ["", *_shared(report)]
    if report.findings:
        lines += ["", *(line for group in grouped(report.findings) for line in _remark(group))]
    return "\n".join(printable(line) for line in [*lines, "", _verdict(report)])


def printable(line: str) -> str:
    r"""A line in which characters that do not print are spelled out: names of files may hold anything.

    >>> printable("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)


def _heading(report: Report) -> list[str]:
    if report.corpus is None:
        what = f"raw distribution of {report.raw}" if report.raw else "not recognised"
        return [f"{report.root}: {what}"]
    module = f", data module {report.data_module}" if report.data_module else ""
    rate = f"{report.frame_rate:g} frames a second"
    if report.stored_frame_rate != report.frame_rate:
        rate += f" ({report.stored_frame_rate:g} on disk)"
    return [
        f"{report.root}: {report.corpus}{module}",
        f"{number(report.n_vertices or 0)} vertices, {rate}; {'headers only' if report.quick else 'all files'} read",
    ]


def _splits(report: Report) -> list[str]:
    with_way = any(row["way"] is not None for row in report.splits)
    head = [*(["way"] if with_way else []), "split", "expected", "present", "missing", "frames", "seconds"]
    rows = [
        [
            *([row["way"] or ""] if with_way else []),
            SPLIT_NAMES.get(row["split"], row["split"]),
            *(_figure(row[key]) for key in ("expected", "present", "missing", "frames", "seconds")),
        ]
        for row in report.splits
    ]
    return _columns(head, rows, left=2 if with_way else 1)


def _subjects(report: Report) -> list[str]:
    rows = [
        [
            row["subject"],
            *(_figure(row[key]) for key in ("clips", "frames", "seconds")),
            "yes" if row["template"] else "no",
            "yes" if row["trained_on"] else "no",
        ]
        for row in report.subjects
    ]
    return _columns(["subject", "clips", "frames", "seconds", "template", "trained on"], rows, left=1)


def _shared(report: Report) -> list[str]:
    templates = report.templates
    told = "none that can be read"
    if templates["file"]:
        told = f"templates.pkl, {counted(len(templates['subjects']), 'subject')}, git blob {str(templates['blob'])[:8]}"
        told += f" ({templates['origin']})" if templates["origin"] else ""
        areas = list((templates["areas"] or {}).values())
        told += f", surface areas {min(areas):.6g} to {max(areas):.6g}" if areas else ""
    rows = [["templates", told], ["mesh", report.mesh or "none"]]
    for name, region in report.regions.items():
        region_told = "none that can be used"
        if region is not None:
            region_told = f"{region['source']}, {counted(region['count'], 'vertex', 'vertices')}, hash {region['hash']}"
            if region["count"] == region["circulating_count"]:
                region_told += ", as many as the list that circulates has"
        rows.append([name.replace("_", " "), region_told])
    rows.append(["manifest", _manifest(report.manifest)])
    width = max(len(row[0]) for row in rows)
    return [f"{name:<{width}}  {what}" for name, what in rows]


def _manifest(manifest: Mapping[str, Any]) -> str:
    if not manifest["there"]:
        return "none: not made by `facediff data prepare`"
    writer = f"written by facediff {manifest['facediff']}" if manifest["facediff"] else "there"
    wrong = [f"{number(len(manifest[key]))} {key}" for key in ("changed", "missing") if manifest[key]]
    return f"{writer}; files {' and '.join(wrong) if wrong else 'as recorded'}"


def _remark(group: Sequence[Finding]) -> list[str]:
    """Findings of one kind: each of them if they are few, else the first and the places of the others."""
    first = group[0]
    label = first.severity.upper() if first.severity != "note" else "note"
    if len(group) <= LISTED:
        return [f"{label:<8} {finding.where}: {finding.message}" for finding in group]
    return [
        f"{label:<8} {number(len(group))} times {first.kind}, the first: {first.where}: {first.message}",
        f"{'':<8} also {few(finding.where for finding in group[1:])}",
    ]


def _verdict(report: Report) -> str:
    counts = {s: sum(f.severity == s for f in report.findings) for s in ("error", "warning")}
    told = ", ".join(counted(count, severity) for severity, count in counts.items() if count)
    if report.sound and not told:
        return "sound: nothing is wrong with this copy"
    return f"{'sound' if report.sound else 'not sound'}{f': {told}' if told else ''}"


def _figure(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if isinstance(value, float) else number(value)


def _columns(head: Sequence[str], rows: Iterable[Sequence[str]], *, left: int) -> list[str]:
    table = [list(head), *map(list, rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(head))]
    return [
        "  ".join(
            f"{cell:<{width}}" if i < left else f"{cell:>{width}}"
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    ]
