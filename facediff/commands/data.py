"""``facediff data``: making, checking and importing corpora."""

from __future__ import annotations

import importlib
from collections.abc import Sequence

from facediff.errors import FaceDiffError, choices

COMMANDS = {
    "prepare": ("facediff.commands.prepare", "make a corpus folder from a raw distribution: biwi, vocaset, mead3d"),
    "check": ("facediff.commands.check", "say what a folder is, what is missing and what is wrong in it"),
    "regions": ("facediff.commands.regions", "draw a corpus's lips and upper face on its mesh"),
    "import-person": ("facediff.commands.import_person", "make a person's reconstructed video a corpus entry"),
}


def usage() -> str:
    """The help text."""
    lines = ["usage: facediff data <command> [options]", "", "commands:"]
    lines += [f"  {name:<16}{text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join([*lines, "", "`facediff data <command> --help` tells a command's options"])


def run(name: str, arguments: Sequence[str]) -> int:
    """Find the subcommand and hand over.

    Raises:
        FaceDiffError: if there is no such subcommand.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    command, *rest = arguments
    if command not in COMMANDS:
        raise FaceDiffError(f'there is no command "data {command}": {choices(command, COMMANDS)}')
    status: int = importlib.import_module(COMMANDS[command][0]).run(f"data {command}", rest)
    return status
