"""``facediff components``: the list of everything that can be chosen by name."""

from __future__ import annotations

import inspect
import json as json_format
from typing import TYPE_CHECKING, Annotated

from facediff.cli.parsing import plain_text
from facediff.cli.process import tell
from facediff.errors import check_known
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.registry import Entry


def components(kind: Annotated[str | None, Option(metavar="KIND")] = None, *, json: bool = False) -> None:
    """List everything that can be chosen by name: components of models, models, corpora, metrics and export formats.

    Args:
        kind: only this kind, with the options of each entry
        json: machine-readable: a list of objects
    """
    from facediff.registry import KINDS

    check_known("components", "kind", [kind] if kind else [], KINDS)
    kinds = [entry_kind for entry_kind in KINDS.values() if kind in (None, entry_kind.kind)]
    bundled = bundled_models() if kind in (None, "model") else []
    if json:
        rows = [
            {"kind": entry_kind.kind, "name": entry.name, "summary": entry.summary, "class": entry.owner}
            for entry_kind in kinds
            for entry in entry_kind
        ]
        tell(*json_format.dumps(rows + bundled, indent=2, allow_nan=False).split("\n"))
        return
    width = max((len(entry.name) for entry_kind in kinds for entry in entry_kind), default=0) + 2
    for entry_kind in kinds:
        tell(f"{entry_kind.kind}: {entry_kind.title}")
        for entry in entry_kind:
            tell(f"  {entry.name:<{width}}{plain_text(entry.summary)}")
            if kind is not None:
                for line in options_of(entry):
                    tell(f"      {line}")
    if bundled:
        tell("bundled_model: trained models that come with facediff and animate without --checkpoint")
        tell(*(f"  {row['name']:<{width}}{row['summary']}" for row in bundled))


def bundled_models() -> list[dict[str, str]]:
    """The trained models in the package, as rows of the list."""
    from facediff.runtime.folder import read_folder
    from facediff.utils.hub import BUNDLED, is_exported

    if not is_exported(BUNDLED):
        return []
    about, _ = read_folder(BUNDLED)
    kind = "synthetic speech and faces" if about.synthetic else "recordings of people"
    summary = f"{about.model} of the corpus {about.corpus}: {kind}, {len(about.faces)} faces"
    return [{"kind": "bundled_model", "name": BUNDLED.name, "summary": summary, "class": about.model}]


def options_of(entry: Entry) -> list[str]:
    """The options of an entry, a line each: name, default, meaning."""
    import docstring_parser

    if not inspect.isclass(entry.implementation):
        return []
    meanings: dict[str, str] = {}
    for base in reversed(inspect.getmro(entry.implementation)):  # a class describes only options of its own
        text = base.__doc__ or ""
        if (init := vars(base).get("__init__")) is not None and "Args:" in (init.__doc__ or ""):
            text = init.__doc__  # of a constructor that takes the options of a dataclass
        parsed = docstring_parser.parse(text, docstring_parser.DocstringStyle.GOOGLE)
        meanings |= {option.arg_name: plain_text(option.description or "") for option in parsed.params}
    lines = []
    for name, parameter in inspect.signature(entry.implementation).parameters.items():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        default = "" if parameter.default is parameter.empty else f" = {parameter.default!r}"
        lines.append(f"{name}{default}: {meanings.get(name, '')}".rstrip(": "))
    return lines
