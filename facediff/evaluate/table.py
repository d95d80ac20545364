"""An evaluation as text for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from facediff.evaluate.report import Interval, MethodResult, Report

SHOWN = 5
"""Names that are listed before the rest is counted."""


def text(report: Report) -> str:
    """Scores by protocol, comparisons, and what was cut, skipped or missing."""
    lines = [
        f"truth {report.truth}" + (f", every {report.truth_stride}. frame" if report.truth_stride > 1 else ""),
        f"mesh of {report.n_vertices} vertices; conditions: {report.identity}",
    ]
    for part, region in report.regions().items():
        again = f", {region['duplicates']} repeated in the source" if region["duplicates"] else ""
        lines.append(
            f"{part.replace('_', ' ')} {region['name']}: {region['count']} vertices, hash {region['hash']}{again}"
        )
    lines += report.remarks
    for name in report.protocols:
        lines += ["", f"protocol {name}", *_scores(report, name), *_comparisons(report, name)]
    if any(score.interval for method in report.methods for score in method.scores):
        lines += [
            "",
            f"[…]: {report.level:.0%} intervals, {report.resamples} bootstrap resamples of the sequences, "
            f"seed {report.seed}",
        ]
    left_out = _left_out(report)
    lines += ["", *(left_out or ["everything there was scored; nothing was cut, skipped or missing"])]
    for definition in report.protocols.values():
        lines += ["", definition]
    return "\n".join(lines)


def _scores(report: Report, protocol: str) -> list[str]:
    rows = []
    for method in report.methods:
        scores = [score for score in method.scores if score.protocol == protocol]
        cells = [f"{score.value:.4e}{_interval(score.interval)}" for score in scores]
        rows.append([method.name, *cells, str(scores[0].frames), str(scores[0].sequences)])
    metrics = [score.metric for score in report.methods[0].scores if score.protocol == protocol]
    return _align([["", *metrics, "frames", "sequences"], *rows])


def _comparisons(report: Report, protocol: str) -> list[str]:
    """Differences from the first method; a star where the interval leaves zero out."""
    rows: dict[str, list[str]] = {}
    counts: dict[str, int] = {}
    for found in report.comparisons:
        if found.protocol == protocol:
            sure = found.interval is not None and (found.interval.low > 0 or found.interval.high < 0)
            cell = f"{found.difference:+.4e}{_interval(found.interval, '+')}{'*' if sure else ''}"
            rows.setdefault(found.method, []).append(cell)
            counts[found.method] = found.sequences
    if not rows:
        return []
    metrics = [score.metric for score in report.methods[0].scores if score.protocol == protocol]
    body = [[f"{method} − {report.methods[0].name}", *cells, str(counts[method])] for method, cells in rows.items()]
    head = "difference, over the sequences that both have (*: the interval leaves out 0)"
    return [head, *_align([["", *metrics, "sequences"], *body])]


def _interval(interval: Interval | None, sign: str = "") -> str:
    return "" if interval is None else f" [{interval.low:{sign}.3e}, {interval.high:{sign}.3e}]"


def _align(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(len(row[place]) for row in rows) for place in range(len(rows[0]))]
    return [
        "  ".join(
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _left_out(report: Report) -> list[str]:
    """What was cut, skipped or missing."""
    lines = []
    if report.unnamed_truths:
        lines.append(f"truths whose names do not fit: {_names(report.unnamed_truths)}")
    for method in report.methods:
        lines += [f"{method.name}: {line}" for line in _method(method)]
    shared = {clip for method in report.methods[:1] for clip in _clips(method)}
    if any(_clips(method) != shared for method in report.methods):
        lines.append("the methods were not scored on the same sequences: compare the differences, not the scores")
    return lines


def _clips(method: MethodResult) -> set[str]:
    return {sequence.clip for sequence in method.sequences}


def _method(method: MethodResult) -> list[str]:
    missing = method.missing
    cut = [
        f"{each.clip} (prediction {each.cut_prediction}, truth {each.cut_truth})"
        for each in method.sequences
        if each.cut_prediction or each.cut_truth
    ]
    listed = {
        "frames cut": cut,
        "clips without a prediction": missing.without_prediction,
        "predictions without a truth": missing.without_truth,
        "predictions under other conditions": missing.unused,
        "files whose names do not fit": missing.unnamed,
    }
    lines = [f"{what}: {_names(names)}" for what, names in listed.items() if names]
    unusable = [f"{clip} is left out: {reason}" for clip, reason in missing.unusable.items()]
    more = [f"{len(unusable) - SHOWN} more are left out (--json lists all)"] if len(unusable) > SHOWN else []
    return lines + unusable[:SHOWN] + more


def _names(names: Iterable[str]) -> str:
    """How many, and the first few."""
    found = list(names)
    more = f" and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    return f"{len(found)}: {', '.join(found[:SHOWN])}{more}"
