"""Checking packed corpora."""

from __future__ import annotations

import json
from pathlib import Path

from facediff.data.check import check
from tests.data.packed.damage import TINY


def test_the_check_understands_packed_corpora(corpus: Path, packed: Path) -> None:
    plain, other = check(corpus, TINY), check(packed, TINY)
    assert other.sound
    assert (other.splits, other.subjects, other.regions) == (plain.splits, plain.subjects, plain.regions)
    assert {finding.kind for finding in other.findings} - {finding.kind for finding in plain.findings} == {"packed"}
    assert str(packed) in json.dumps(other.state())
