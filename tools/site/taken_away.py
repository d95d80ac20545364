"""What an earlier version offered in Python and this one does not, by the promise of ``.github/VERSIONS.md``.

    pip install ".[docs]"
    python tools/site/taken_away.py v1.0.0

Griffe compares the source text of both, nothing is imported: names of the modules that the API reference lists, their
methods and attributes, and parameters that went, became required or have another default. The exit status is 1 if there
is anything.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import griffe
import yaml

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))
from hooks import module_of, public_names  # noqa: E402 - next to this file


class _Config(yaml.SafeLoader):
    """Reads mkdocs.yml, whose tags for Python objects are of no interest here."""


_Config.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)


def reference() -> list[str]:
    """The modules of the API reference."""
    config: dict[str, Any] = yaml.load(Path(__file__).with_name("mkdocs.yml").read_text(), _Config)  # noqa: S506 - safe
    return list(config["extra"]["api"])


def taken_away(old: griffe.Module, new: griffe.Module, modules: Sequence[str]) -> Iterator[str]:
    """A line for each thing that the modules of ``old`` offer and ``new`` breaks."""
    offered = set()
    for name in modules:
        module, now = module_of(old, name), module_of(new, name)
        for public in public_names(module):
            if public not in module.members:  # loaded when it is asked for
                continue
            member = module[public]
            offered.add(member.final_target.path if member.is_alias else member.path)
            if public not in now.members:
                yield f"{name}.{public}: is no more"
    for breakage in griffe.find_breaking_changes(old, new):
        place = breakage.obj.canonical_path
        owners = (path for path in offered if place == path or place.startswith(f"{path}."))
        if not breakage.obj.is_module and any(not _private(place[len(path) :]) for path in owners):
            yield breakage.explain(griffe.ExplanationStyle.ONE_LINE)


def _private(rest: str) -> bool:
    return any(part.startswith("_") and part != "__init__" for part in rest.split("."))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("revision", help="of git: the earlier version")
    revision = parser.parse_args(arguments).revision
    old = griffe.load_git("facediff", ref=revision, repo=ROOT, resolve_aliases=True)
    new = griffe.load("facediff", search_paths=[str(ROOT)], resolve_aliases=True)
    assert isinstance(old, griffe.Module)
    assert isinstance(new, griffe.Module)
    lines = sorted({*taken_away(old, new, reference())})
    print("\n".join(lines) or f"nothing that {revision} offered was taken away")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
