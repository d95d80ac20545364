"""Every reader obeys the law of :mod:`tests.robustness.mutations` on a fixed seed; the long run is a command there."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.robustness.mutations import READERS, run


@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_read_or_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    law = run(name, 25, 1, tmp_path)
    assert law.broken == []
    assert sum(law.counts.values()) >= 25
