"""What worker processes of the check import."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_worker_processes_import_nothing_heavy() -> None:
    program = "import sys, facediff.data.check.clip; assert not {'torch', 'lightning', 'trimesh'} & set(sys.modules)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert run.returncode == 0, run.stderr
