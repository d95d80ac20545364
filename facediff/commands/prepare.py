"""``facediff data prepare``: from the raw distribution of a data set to a folder that facediff trains on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.prepare.job import Plan
    from facediff.prepare.runner import Report

SHOWN = 20
"""Lines of a list on the screen; the whole list is in the manifest."""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data prepare",
        description="Write a corpus folder from a data set as its authors distribute it. A run that was stopped is "
        "taken up where it was by the same command.",
    )
    corpora = made.add_subparsers(dest="corpus", required=True, metavar="corpus")
    _add_biwi(corpora)
    _add_vocaset(corpora)
    return made


def _add_corpus(
    corpora: argparse._SubParsersAction[argparse.ArgumentParser], name: str, title: str
) -> argparse.ArgumentParser:
    """A corpus with the options that all of them have."""
    made = corpora.add_parser(name, help=title, description=title)
    made.add_argument("raw", type=Path, help="the raw data set, unpacked")
    made.add_argument("out", type=Path, help="folder to write: a new one, or one that this command has begun")
    made.add_argument("--dtype", choices=["float32", "float64"], default="float32", help="of the motion on disk")
    made.add_argument("--workers", type=int, help="processes (default: as many as processors)")
    made.add_argument("--quiet", action="store_true", help="no progress bars")
    return made


def _add_biwi(corpora: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    made = _add_corpus(corpora, "biwi", "BIWI, B3D(AC)^2: .vl frames, rigid scans, wav or flv")
    made.add_argument(
        "--normalise",
        choices=["codetalker", "none"],
        default="codetalker",
        help="codetalker: turned, centred and scaled frame by frame, as published work has it; none: raw mm",
    )
    made.add_argument("--subjects", type=_names, help="only these, e.g. F2,F3,M5 (default: all that are there)")
    made.add_argument("--regions", type=Path, help="folder with lve.txt and fdd.txt (default: regions/ of RAW)")


def _add_vocaset(corpora: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    made = _add_corpus(corpora, "vocaset", "VOCASET: data_verts.npy and its pickles")
    made.add_argument(
        "--frame-rate", type=int, choices=[30, 60], default=30, help="30 (default), or 60 for other projects' loaders"
    )
    made.add_argument(
        "--decimate",
        choices=["every_second", "filtered"],
        default="every_second",
        help="how 60 becomes 30: every second frame, as published work has it, or low-pass filtered",
    )
    made.add_argument("--regions", type=Path, help="folder with lists of vertices (default: regions/ of RAW)")


def _names(words: str) -> list[str]:
    return [word for word in words.replace(",", " ").split() if word]


def run(name: str, arguments: Sequence[str]) -> int:
    """Prepare a data set and say what came of it.

    Returns:
        0, or 1 if a clip could not be written.
    """
    args = parser().parse_args(list(arguments))
    from facediff.prepare.runner import prepare

    _keep_apart(args.raw, args.out)
    try:
        report = prepare(make_plan(args), args.out, workers=args.workers, quiet=args.quiet)
    except KeyboardInterrupt:
        print(f"\nstopped; the same command goes on where {args.out} was left", file=sys.stderr)
        raise
    print("\n".join(describe(report)))
    return 0 if report.sound else 1


def make_plan(args: argparse.Namespace) -> Plan:
    """The plan that the arguments ask for."""
    if args.corpus == "biwi":
        from facediff.prepare import biwi

        return biwi.plan(
            args.raw, normalise=args.normalise, dtype=args.dtype, subjects=args.subjects, regions=args.regions
        )
    from facediff.prepare import vocaset

    return vocaset.plan(
        args.raw, frame_rate=args.frame_rate, decimate=args.decimate, dtype=args.dtype, regions=args.regions
    )


def describe(report: Report) -> list[str]:
    """The report as lines for the screen."""
    totals = report.totals
    lines = [
        f"{report.out}: {totals['clips']} clips, {totals['frames']} frames, {totals['seconds'] / 60:.1f} min, "
        f"{totals['bytes'] / 1e9:.2f} GB; {report.written} written now"
    ]
    for title, entries in (("missing", report.missing), ("failed", report.failed)):
        if entries:
            listed = grouped(entries)
            lines += [f"{title}: {len(entries)}", *(f"  {line}" for line in listed[:SHOWN])]
            if len(listed) > SHOWN:
                lines.append(f"  … and more, see {report.out / 'manifest.json'}")
    lines += [f"note: {note}" for note in report.notes[:SHOWN]]
    if len(report.notes) > SHOWN:
        lines.append(f"note: … and {len(report.notes) - SHOWN} more, see {report.out / 'manifest.json'}")
    lines.append(f"Next: facediff data check {report.out}")
    return lines


def grouped(entries: dict[str, str]) -> list[str]:
    """A line for each entry, but one line for clips of a subject whose texts differ in the clip's name only."""
    groups: dict[tuple[str, str], list[str]] = {}
    for key, text in entries.items():
        subject, _, sentence = key.rpartition("_")
        common = text.replace(key, "").replace(sentence, "") if subject else text
        groups.setdefault((subject or key, common), []).append(key)
    return [
        f"{keys[0]}{f' … {keys[-1]} ({len(keys)} in all)' if len(keys) > 1 else ''}: {entries[keys[0]]}"
        for keys in groups.values()
    ]


def _keep_apart(raw: Path, out: Path) -> None:
    """What is written must not be found as raw data by the next run."""
    source, target = raw.resolve(), out.resolve()
    if target == source or source in target.parents:
        raise FaceDiffError(f"{out}: lies in the raw folder {raw}; choose a folder outside it to write to")
