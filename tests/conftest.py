from __future__ import annotations

import gc
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from jaxtyping import install_import_hook

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["WANDB_MODE"] = "offline"
os.environ["WANDB_SILENT"] = "true"
os.environ["FACEDIFF_TRACEBACK"] = "1"  # unexpected errors fail a test as what they are
os.environ.setdefault("OMP_NUM_THREADS", "1")  # also of commands that tests start: the other core has tests of its own

# Where no bytecode is to be written, as in many containers, all tests would be compiled anew each time, and the package
# by each of the hundreds of processes that they start. Nobody means this folder, which git ignores, by that.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C, which some test.
signal.signal(signal.SIGINT, signal.default_int_handler)


# Thousands of small files are written whole and waited for, which takes a fifth of the tests' time on a disk. Not where
# programs cannot be run from memory, or memory is small, as in containers by default.
MEMORY = Path("/dev/shm")  # noqa: S108 - pytest makes a folder of its own there
if "TMPDIR" not in os.environ and MEMORY.is_dir() and os.access(MEMORY, os.W_OK):
    runs_programs = not os.statvfs(MEMORY).f_flag & os.ST_NOEXEC
    if runs_programs and shutil.disk_usage(MEMORY).free > 8 * 2**30:
        os.environ["TMPDIR"] = tempfile.tempdir = str(MEMORY)


# The shapes in the signatures of the mathematics are checked in tests only; the hook must come before the imports, also
# those of the conftest.py of folders that are named on the command line, which are read before pytest_configure.
SHAPED = "audio_encoders speaker_encoders mesh_encoders fusions decoders layers losses samplers folding losses_fused"
SHAPED += " motion_space deepspeech"
install_import_hook([f"facediff.models.{module}" for module in SHAPED.split()], "beartype.beartype")


def pytest_configure(config: pytest.Config) -> None:
    """What takes seconds to import is for the processes that run tests, not for the one that hands them out."""
    handed_out = config.getoption("numprocesses", None) and not config.option.collectonly
    if handed_out and not hasattr(config, "workerinput"):
        return
    config.pluginmanager.import_plugin("tests.fakes.fixtures")


def pytest_collection_finish() -> None:
    """What was imported stays: the collector would look through it again and again, a twentieth of the tests' time."""
    gc.collect()
    gc.freeze()
