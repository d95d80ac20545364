"""The picture of a corpus's regions shows them where they are, and names them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from facediff.cli.app import run
from facediff.errors import FaceDiffError
from facediff.metrics import Region

TINY = ["--corpus", "tests.fakes.tiny.Tiny", "--size", "96"]


@pytest.fixture
def root(tiny_root: Path, tmp_path: Path) -> Path:
    return shutil.copytree(tiny_root, tmp_path / "tiny", ignore=shutil.ignore_patterns("wav"))


def tinted(path: Path, channel: int) -> NDArray[np.intp]:
    """Rows of the pixels in which red (0) or blue (2) stands out, the legend left away."""
    picture = np.asarray(Image.open(path)).astype(int)[:-40]
    others = np.delete(picture, channel, axis=2).max(axis=2)
    return np.nonzero(picture[..., channel] > others + 60)[0]


def test_regions_are_coloured_where_they_are(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "regions.png"
    assert run("data regions", [str(root), "-o", str(path), *TINY]) == 0
    lips, upper = tinted(path, 0), tinted(path, 2)
    # The lips are the lower two rows of vertices, the upper face the upper two; both are seen from two sides.
    assert len(lips) > 100
    assert len(upper) > 100
    assert lips.mean() > upper.mean() + 10
    with Image.open(path) as picture:
        assert picture.size[0] == 2 * 96
        assert picture.size[1] > 96 + 40
    printed = capsys.readouterr().out
    assert f"lips (12 vertices, {Region.from_indices('x', range(12)).hash}) from regions/lve.txt" in printed
    assert f"upper_face (12 vertices, {Region.from_indices('x', range(12, 24)).hash}) from regions/fdd.txt" in printed
    assert str(path) in printed


def test_other_sources_and_repeated_indices(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "mine.txt").write_text("18, 19,18,20,18")
    path = tmp_path / "regions.png"
    words = [str(root), "-o", str(path), "--lips", "mine.txt", "--upper-face", "regions/lve.txt", *TINY]
    assert run("data regions", words) == 0
    assert tinted(path, 0).mean() < tinted(path, 2).mean()
    printed = capsys.readouterr().out
    assert "lips (3 vertices, " in printed
    assert "from mine.txt, 2 repeated indices counted once" in printed


def test_a_folder_that_is_no_corpus(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match="not recognised.*--corpus"):
        run("data regions", [str(tmp_path), "-o", str(tmp_path / "regions.png")])
