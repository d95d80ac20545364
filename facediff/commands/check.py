"""``facediff data check``: what a folder is, what is there, what is missing and what is wrong in it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data check",
        description="Say what a corpus folder is, what is there, what is missing and what is wrong in it. Nothing is "
        "changed. Exit status: 0 sound (warnings allowed), 1 not sound, 2 wrong usage.",
    )
    made.add_argument("root", type=Path, help="the corpus folder")
    made.add_argument("--corpus", help="what it is: biwi, vocaset, mead3d, puppet, or package.module.Class")
    made.add_argument("--split", help="totals of one way to split the corpus only (3DMEAD: sentence, identity)")
    made.add_argument("--quick", action="store_true", help="read headers only, and compare files by size")
    made.add_argument("--json", action="store_true", help="machine-readable: one object")
    made.add_argument("--workers", type=int, help="processes (default: as many as processors if there is much to read)")
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Check a folder and print the report.

    Returns:
        0 if it is sound, 1 if not.
    """
    args = parser().parse_args(list(arguments))
    from facediff.doctor import check, text

    if args.corpus and "." in args.corpus:
        sys.path.append(os.getcwd())  # a data module of one's own may lie in the working folder
    report = check(
        args.root,
        args.corpus,
        split=args.split,
        quick=args.quick,
        workers=args.workers,
        progress=not (args.json or args.quiet),
    )
    if args.json:
        print(json.dumps(report.state(), indent=2))
    else:
        # A file name may hold letters that the terminal's encoding has not.
        encoding = sys.stdout.encoding or "utf-8"
        print(text(report).encode(encoding, errors="backslashreplace").decode(encoding))
    return 0 if report.sound else 1
