from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import main


@pytest.mark.slow
def test_the_policy_is_chosen_at_test_time_and_printed(
    checkpoint: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["--trainer.accelerator=cpu", f"--trainer.logger.save_dir={tmp_path}"]
    assert main(["test", "--ckpt_path", str(checkpoint), "--model.unseen_identity=each_seen", *words]) == 0
    assert "unseen speakers: each_seen" in capsys.readouterr().out
    (table,) = tmp_path.rglob("test_scores.csv")
    with table.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["unseen_identity"] for row in rows} == {"each_seen"}
    counts = {(row["split"], row["method"]): int(row["sequences"]) for row in rows}
    assert counts["test_b", "model"] == 2 * counts["test_b", "still"]
    assert main(["test", "--ckpt_path", str(checkpoint), "--model.unseen_identity=adapted", *words]) == 2
    assert "facediff adapt" in capsys.readouterr().err
    assert np.isfinite([float(row["lve"]) for row in rows]).all()
