"""What the files of the project say agrees: versions, Pythons, extras and what a source distribution holds."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import facediff

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINNED = {re.split("==", line)[0] for line in (ROOT / "tools" / "constraints.txt").read_text().splitlines() if line}


def read(path: str) -> Any:  # noqa: ANN401 - what YAML holds
    # Not the safe loader's `on: true`: GitHub reads the key `on` as a word.
    return yaml.load((ROOT / path).read_text(), Loader=yaml.BaseLoader)  # noqa: S506 - which makes strings only


def test_the_citation_is_of_this_version_and_licence() -> None:
    citation = read("CITATION.cff")
    assert citation["version"] == facediff.__version__
    assert citation["license"] == PROJECT["project"]["license"]
    assert {reference["doi"] for reference in citation["references"]} <= set(
        re.findall(r"doi\s*=\s*\{(\S+?)\}", (ROOT / "README.md").read_text())
    )


def test_the_pythons_that_are_tested_are_those_that_are_claimed() -> None:
    (job,) = read(".github/workflows/checks.yml")["jobs"].values()
    named = [found[1] for line in PROJECT["project"]["classifiers"] if (found := re.search(r":: (3\.\d+)$", line))]
    assert job["strategy"]["matrix"]["python"] == named
    assert PROJECT["project"]["requires-python"] == f">={named[0]}"
    assert job["steps"][-1]["run"] == ".ci/run"
    assert read(".github/workflows/release.yml")["jobs"]["packages"]["strategy"]["matrix"]["python"] == named


@pytest.mark.parametrize("extra", ["metrics", "train", "render", "prepare", "mesh", "figures", "live", "serve", "docs"])
def test_what_an_extra_needs_is_pinned(extra: str) -> None:
    needs = [re.split(r"[\[<>=]", need)[0] for need in PROJECT["project"]["optional-dependencies"][extra]]
    assert [need for need in needs if need not in {"facediff", *PINNED}] == []


def test_the_source_distribution_holds_what_there_is() -> None:
    included = set(PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"])
    assert [name for name in sorted(included) if not (ROOT / name).exists()] == []
    ours = {
        "configs",
        "docs",
        "facediff",
        "tests",
        "tools",
        ".ci",
        ".github",
        "README.md",
        "CITATION.cff",
        "SECURITY.md",
    }
    assert ours <= included
    assert (ROOT / "facediff" / "py.typed").exists()
