"""The benchmark of the published methods, at toy size."""

from __future__ import annotations

from pathlib import Path

import pytest

from facediff import registry
from facediff.models.published.base import PublishedModel
from tests.fakes.processes import run

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "published_methods.py"


@pytest.mark.slow
def test_every_method_is_timed_at_both_sizes_and_the_table_is_markdown() -> None:
    done = run(SCRIPT, "--toy", "--seconds", "0.5", "--steps", "2")
    assert done.returncode == 0, done.stderr
    head, line, *rows = [[cell.strip() for cell in row.strip("|").split("|")] for row in done.stdout.splitlines()]
    assert set(line) == {"---"}
    found = [dict(zip(head, row, strict=True)) for row in rows]
    published = {name for name in registry.model.names() if issubclass(registry.model.get(name), PublishedModel)}
    layouts = {"EmoTalk": "arkit", "LamAudio2Expression": "arkit", "UniTalker": "arkit"}
    layouts |= {"DiffPoseTalk": "flame_diffposetalk", "ARTalk": "flame_artalk"}
    assert {(row["method"].strip("`"), row["faces"]) for row in found} == {
        (name, faces) for name in published for faces in ([layouts[name]] if name in layouts else ("VOCASET", "BIWI"))
    }
    literal = {(row["method"], row["faces"]): float(row["seconds"]) for row in found if row["way"] == "literal"}
    assert literal
    for row in found:
        assert float(row["real-time factor"]) == pytest.approx(2 * float(row["seconds"]), abs=0.02)
        if ratio := row["times as fast as literal"]:
            whole = literal[row["method"], row["faces"]]
            # Both are printed to hundredths of a second, the ratio to a tenth.
            low, high = (whole + sign * 0.005 for sign in (-1, 1))
            seconds = float(row["seconds"])
            assert low / (seconds + 0.005) - 0.05 <= float(ratio) <= high / max(seconds - 0.005, 1e-9) + 0.05
