"""Parses the command lines of `fit` and `test`, and with a third less computing in a process that parses many."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import pytest
import yaml
from jsonargparse._postponed_annotations import TypeCheckingVisitor


def parse_imports_once() -> None:
    """Let the parser read a module's imports for types once.

    It parses the source of a component's module again for each of its arguments, which takes a third of the processor
    time of a miniature training. In one process these imports stay the same.
    """
    imports: dict[str, dict[str, object]] = {}
    update_aliases = TypeCheckingVisitor.update_aliases

    def update_aliases_once(
        visitor: TypeCheckingVisitor, source: str, module: str, aliases: dict[str, object], logger: object = None
    ) -> None:
        if module not in imports:
            names = dict(aliases)
            update_aliases(visitor, source, module, names, logger)
            imports[module] = {name: names[name] for name in names if names[name] is not aliases.get(name)}
        aliases.update(imports[module])

    TypeCheckingVisitor.update_aliases = update_aliases_once


def printed_config(*words: str) -> dict[str, Any]:
    """A config as `facediff fit` composes it."""
    from facediff.cli.app import main

    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit, match="0"):
        main(["fit", *words, "--print_config"])
    return dict(yaml.safe_load(printed.getvalue()))
