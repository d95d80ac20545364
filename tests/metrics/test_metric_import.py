"""Importing the metrics brings torch and torchmetrics, and nothing of the rest of the package."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
import torchmetrics
before = set(sys.modules)
import facediff.metrics
print(*sorted({name for name in set(sys.modules) - before}))
"""


def test_nothing_heavy_is_imported() -> None:
    run = subprocess.run(  # noqa: S603
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=120
    )
    ours = {name for name in run.stdout.split() if name.startswith("facediff")}
    others = {name.split(".")[0] for name in set(run.stdout.split()) - ours}
    assert {name for name in ours if not name.startswith("facediff.metrics")} == {"facediff"}
    assert others <= set(sys.stdlib_module_names), others
