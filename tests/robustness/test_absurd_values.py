"""Numbers without meaning (NaN, 1e30, indices of no vertex) are refused before they become a result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.animation import metres_per_unit, write_archive
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from tests.fakes.clicks import clicks


@pytest.fixture
def archive(tmp_path: Path) -> dict[str, Any]:
    write_archive(tmp_path / "good.npz", clicks())
    return dict(np.load(tmp_path / "good.npz"))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("suffix", ["npy", "npz", "obj", "glb", "mdd", "pc2", "html"])
def test_no_format_is_written_of_absurd_motion(
    value: float, suffix: str, archive: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive["vertices"][-1, -1, -1] = value
    np.savez(tmp_path / "bad.npz", **archive)
    assert main(["export", str(tmp_path / "bad.npz"), "-o", str(tmp_path / f"out.{suffix}")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"good.npz", "bad.npz"}


@pytest.mark.parametrize("unit", ["1e-300", "1e300", "0", "-1", "nan", "inf", "parsec", "", "1e-46"])
def test_units_that_single_precision_does_not_hold_are_refused(
    unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(FaceDiffError, match="unit"):
        metres_per_unit(unit)
    write_archive(tmp_path / "good.npz", clicks())
    command = ["export", str(tmp_path / "good.npz"), "-o", str(tmp_path / "out.npy"), "--output-unit", unit]
    assert main(command) == 2
    assert "unit" in capsys.readouterr().err
    assert not (tmp_path / "out.npy").exists()


def test_scores_of_absurd_motion_are_not_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Squares of 1e30 are infinite in single precision: the scores would be, too."""
    for folder, factor in (("truth", 1.0), ("pred", 1e30)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "A_s1.npy", np.float32(factor) * np.ones((5, 4, 3), np.float32))
    folders = [str(tmp_path / folder) for folder in ("pred", "truth")]
    assert main(["evaluate", *folders, "--lips", "all", "--protocol", "meshtalk"]) == 2
    assert "A_s1" in capsys.readouterr().err
