"""``facediff components``: what can be chosen by name."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    from facediff.registry import KINDS

    made = argparse.ArgumentParser(
        "facediff components", description="List what can be chosen by name; `--model.<kind>=<name>` chooses it."
    )
    made.add_argument("kind", nargs="?", choices=list(KINDS), help="only this kind")
    made.add_argument("--json", action="store_true", help="machine-readable: a list of objects")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Print the components, by kind."""
    from facediff.registry import KINDS

    args = parser().parse_args(list(arguments))
    kinds = [kind for kind in KINDS.values() if args.kind in (None, kind.kind)]
    if args.json:
        rows = [
            {"kind": kind.kind, "name": entry.name, "summary": entry.summary, "class": entry.owner}
            for kind in kinds
            for entry in kind
        ]
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    width = max(len(entry.name) for kind in kinds for entry in kind) + 2
    for kind in kinds:
        print(f"{kind.kind}: {kind.title}")
        for entry in kind:
            print(f"  {entry.name:<{width}}{entry.summary}")
    return 0
