"""The one error that facediff shows to people as a plain sentence instead of a traceback."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def choices(name: str, known: Iterable[str]) -> str:
    """What follows "there is no …": the nearest of the known names, then all of them."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f'did you mean "{near[0]}"? ' if near else ""
    return f"{hint}known are {', '.join(names)}"


class FaceDiffError(Exception):
    """Something that the user can put right: a file, an argument or an installation.

    The message names the file or the field, says what was expected and what to do next. The command line
    prints it without a traceback and exits with code 2.
    """


class MissingExtraError(FaceDiffError):
    """A feature was used whose optional packages are not installed.

    Args:
        package: import name of what is missing.
        extra: the extra of facediff that brings it.
        feature: what needs it, in words.
    """

    def __init__(self, package: str, extra: str, feature: str) -> None:
        self.arguments = package, extra, feature
        super().__init__(
            f'{feature} needs the package "{package}", which is not installed: run  pip install "facediff[{extra}]"'
        )

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str]]:
        """Pickling, by which worker processes hand errors over, must not call the class with the message alone."""
        return type(self), self.arguments
