"""How many optimiser steps the bundled experiments take, computed from their configs alone."""

from __future__ import annotations

import pytest

from tools.training_steps import PUBLISHED, lengths_of, main, share_of_the_first, steps_of


@pytest.mark.parametrize("corpus", PUBLISHED)
def test_bundled_experiments_take_at_least_the_papers_steps(corpus: str) -> None:
    lengths = {name: lengths_of(name, None) for name in (f"{corpus}_paper", corpus)}
    paper, ours = (int(steps_of(name, frames)["steps"]) for name, frames in lengths.items())
    assert paper == 50 * len(lengths[f"{corpus}_paper"])
    assert paper <= ours


def test_the_share_of_the_first_weights_is_the_product_of_the_decays() -> None:
    assert share_of_the_first(2350, 0.999, 1.0) == pytest.approx(0.999**2349)
    assert share_of_the_first(4, 0.999, 10.0) == pytest.approx(2 / 11 * 3 / 12 * 4 / 13)


def test_the_table_has_a_line_for_each_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:]] == [f"{c}{end}" for c in PUBLISHED for end in ("_paper", "")]
