"""``facediff data prepare``: from the raw distribution of a data set to a folder that facediff trains on."""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Literal, get_args, get_origin, get_type_hints

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.prepare.job import Plan
    from facediff.prepare.runner import Report

CORPORA = ("biwi", "vocaset", "mead3d")
"""Modules of :mod:`facediff.prepare`; each has a ``plan(raw, *, …)`` whose keyword parameters are its options."""
SHOWN = 20
"""Lines of a list on the screen; the whole list is in the manifest."""


def parser() -> argparse.ArgumentParser:
    """Options of the command: those that all corpora have, and each one's own."""
    made = argparse.ArgumentParser(
        "facediff data prepare",
        description="Write a corpus folder from a data set as its authors distribute it. A run that was stopped is "
        "taken up where it was by the same command.",
    )
    corpora = made.add_subparsers(dest="corpus", required=True, metavar="corpus")
    for name in CORPORA:
        module = importlib.import_module(f"facediff.prepare.{name}")
        title = (module.__doc__ or "").partition("\n")[0]
        corpus = corpora.add_parser(name, help=title, description=title)
        corpus.add_argument("raw", type=Path, help="the raw data set, unpacked")
        corpus.add_argument("out", type=Path, help="folder to write: a new one, or one that this command has begun")
        for parameter in own_options(module.plan):
            _add_option(corpus, parameter, get_type_hints(module.plan)[parameter.name], _meanings(module.plan))
        corpus.add_argument("--workers", type=int, help="processes (default: as many as processors)")
        corpus.add_argument("--quiet", action="store_true", help="no progress bars")
    return made


def own_options(plan: Callable[..., Plan]) -> list[inspect.Parameter]:
    """Keyword parameters of a corpus's ``plan``: each is an option of the command line, beside the common ones."""
    found = inspect.signature(plan).parameters.values()
    return [option for option in found if option.kind is option.KEYWORD_ONLY and option.name != "quiet"]


def _meanings(plan: Callable[..., Plan]) -> dict[str, str]:
    """What the docstring says of each parameter."""
    text = inspect.getdoc(plan) or ""
    entries = re.findall(r"^ {4}(\w+): ((?:.+\n)(?: {8}.+\n)*)", text.partition("Args:\n")[2] + "\n", re.MULTILINE)
    return {name: " ".join(meaning.split()).replace("``", "").replace("%", "%%") for name, meaning in entries}


def _add_option(
    parser: argparse.ArgumentParser, parameter: inspect.Parameter, kind: object, meanings: dict[str, str]
) -> None:
    """An option of the parameter's name, type, default and meaning."""
    needed = parameter.default is parameter.empty
    default = None if needed else parameter.default
    told = "" if default is None or isinstance(default, bool) else f" (default: {default})"
    flag, meaning = f"--{parameter.name.replace('_', '-')}", meanings.get(parameter.name, "") + told
    if isinstance(kind, UnionType):
        kind = next(choice for choice in get_args(kind) if choice is not type(None))
    if kind is bool:
        action = argparse.BooleanOptionalAction
        parser.add_argument(flag, dest=parameter.name, action=action, default=default, help=meaning)
    elif get_origin(kind) is Literal:
        values = get_args(kind)
        parser.add_argument(
            flag,
            dest=parameter.name,
            type=type(values[0]),
            choices=values,
            default=default,
            required=needed,
            help=meaning,
        )
    else:
        read = _names if get_origin(kind) in (Sequence, list, tuple) else kind
        parser.add_argument(flag, dest=parameter.name, type=read, default=default, required=needed, help=meaning)  # type: ignore[arg-type]


def _names(words: str) -> list[str]:
    """Words separated by commas."""
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
    plan = importlib.import_module(f"facediff.prepare.{args.corpus}").plan
    options = {option.name: getattr(args, option.name) for option in own_options(plan)}
    if "quiet" in inspect.signature(plan).parameters:  # scanning takes long enough for a progress bar
        options["quiet"] = args.quiet
    made: Plan = plan(args.raw, **options)
    return made


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
