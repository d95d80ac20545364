"""Command lines that differ from a usual one in some options."""

from __future__ import annotations

import re
from collections.abc import Sequence

OPTION = re.compile(r"--?[a-z]")
ALSO = {"-o": "--output"}


def last_of_each(words: Sequence[str], repeatable: Sequence[str] = ("--method", "--pattern", "--metric")) -> list[str]:
    """A command line in which a later option replaces an earlier one; the command itself refuses an option given twice.

    >>> last_of_each(["x.wav", "--seed", "1", "-o", "a.npy", "--seed", "2"])
    ['x.wav', '-o', 'a.npy', '--seed', '2']
    """
    groups: list[list[str]] = [[]]
    for word in words:
        if OPTION.match(word):
            groups.append([])
        groups[-1].append(word)
    names = [ALSO.get(group[0].partition("=")[0], group[0].partition("=")[0]) if group else "" for group in groups]
    kept = [
        group
        for place, (name, group) in enumerate(zip(names, groups, strict=True))
        if place == 0 or name in repeatable or name not in names[place + 1 :]
    ]
    return [word for group in kept for word in group]
