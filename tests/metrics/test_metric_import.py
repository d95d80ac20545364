"""Importing the metrics brings torch and torchmetrics, and nothing else that is heavy."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
import torchmetrics
before = set(sys.modules)
import facediff.metrics
print(*sorted(set(sys.modules) - before))
# torchmetrics itself takes transformers, matplotlib and others along where they are installed, but not these.
assert not {name.split(".")[0] for name in before} & {"lightning", "jsonargparse", "diffusers", "jaxtyping"}
"""


def test_nothing_heavy_is_imported() -> None:
    run = subprocess.run(  # noqa: S603
        [sys.executable, "-W", "error", "-c", PROGRAM], capture_output=True, text=True, check=True, timeout=120
    )
    loaded = run.stdout.split()
    ours = {name for name in loaded if name.startswith("facediff")}
    others = {name.split(".")[0] for name in set(loaded) - ours}
    rest = {name for name in ours if not name.startswith("facediff.metrics")}
    utils = {"facediff.utils", "facediff.utils.hints", "facediff.utils.lazy", "facediff.utils.limits"}
    utils |= {"facediff.version"}
    assert rest == {"facediff", "facediff.errors", "facediff.registry", *utils}
    assert others <= set(sys.stdlib_module_names), others
