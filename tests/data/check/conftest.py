from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.data.check import small
from tests.fakes import biwi, tiny, vocaset


@pytest.fixture(scope="session")
def fakes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fakes")
    tiny.write_tiny(folder / "tiny")
    biwi.write_biwi(folder / "biwi")
    vocaset.write_vocaset(folder / "vocaset")
    small.write_small_mead(folder / "mead")
    return folder


@pytest.fixture
def copies(fakes: Path, tmp_path: Path) -> Path:
    return shutil.copytree(fakes, tmp_path / "copies")
