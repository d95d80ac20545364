from __future__ import annotations

import gc
import os
import signal
import sys

import pytest
from jaxtyping import install_import_hook

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["WANDB_MODE"] = "offline"
os.environ["WANDB_SILENT"] = "true"
os.environ["FACEDIFF_TRACEBACK"] = "1"  # unexpected errors fail a test as what they are

# Where no bytecode is to be written, as in many containers, all tests would be compiled anew each time, and the package
# by each of the hundreds of processes that they start. Nobody means this folder, which git ignores, by that.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A shell that starts the tests in the background lets them, and all that they start, ignore Ctrl-C, which some test.
signal.signal(signal.SIGINT, signal.default_int_handler)


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
