"""Tables as Live Link's importers read them, and the files next to them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from facediff.editing.blendshapes import Weights, timecode, write_live_link, write_weights
from facediff.errors import FaceDiffError


@pytest.fixture
def weights() -> Weights:
    rng = np.random.default_rng(0)
    return Weights(
        names=("jawOpen", "mine", "eyeBlinkLeft", "tongueOut"),
        values=rng.uniform(0, 1, (70, 4)),
        residual_rms_mm=rng.uniform(0, 1, 70),
        residual_max_mm=rng.uniform(1, 2, 70),
        amplitude_mm=2.0,
        frame_rate=30.0,
        still=("tongueOut",),
        metadata={"identity": "Zoë"},
    )


def test_a_table_for_live_link(tmp_path: Path, weights: Weights) -> None:
    write_live_link(tmp_path / "a.csv", weights)
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 70
    assert all(row["BlendShapeCount"] == "61" and len(row) == 63 and None not in row for row in rows)
    assert [float(row["JawOpen"]) for row in rows] == pytest.approx(weights.values[:, 0], abs=1e-8)
    assert [float(row["EyeBlinkLeft"]) for row in rows] == pytest.approx(weights.values[:, 2], abs=1e-8)
    # What has no shape is zero, and said to be absent.
    about = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert len(about["absent"]) == 49
    for name in about["absent"]:
        assert {row[name[0].upper() + name[1:]] for row in rows} == {"0.00000000"}
    assert {float(row[column]) for row in rows for column in row if "Yaw" in column or "Roll" in column[-4:]} == {0.0}
    assert about["not_in_table"] == ["mine"]
    assert about["still"] == ["tongueOut"]
    assert about["residual_rms_mm"] == pytest.approx(weights.residual_rms_mm, abs=1e-6)
    assert about["frame_rate"] == 30.0


def test_a_plain_table(tmp_path: Path, weights: Weights) -> None:
    write_weights(tmp_path / "a.csv", weights)
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", *weights.names, "residual_rms_mm", "residual_max_mm")
    assert table["time"] == pytest.approx(np.arange(70) / 30, abs=1e-6)
    assert table["mine"] == pytest.approx(weights.values[:, 1], abs=1e-8)
    assert table["residual_max_mm"] == pytest.approx(weights.residual_max_mm, abs=1e-6)
    assert json.loads((tmp_path / "a.json").read_text())["not_in_table"] == []


@pytest.mark.parametrize(
    ("frame", "rate", "text"),
    [
        (0, 30, "00:00:00:00.000"),
        (29, 30, "00:00:00:29.000"),
        (30, 30, "00:00:01:00.000"),
        (60 * 60 * 25 + 61 * 25 + 24, 25, "01:01:01:24.000"),
        (61, 60, "00:00:01:01.000"),
        (30, 29.97, "00:00:01:00.000"),
    ],
)
def test_timecodes(frame: int, rate: float, text: str) -> None:
    assert timecode(frame, rate) == text


def test_readers_formula_gives_the_time_back() -> None:
    for frame in range(0, 20_000, 77):
        hours, minutes, seconds, frames = timecode(frame, 60).split(":")
        assert int(hours) * 3600 + int(minutes) * 60 + int(seconds) + float(frames) / 60 == pytest.approx(frame / 60)


def test_both_files_or_none(tmp_path: Path, weights: Weights) -> None:
    (tmp_path / "a.json").mkdir()
    with pytest.raises(FaceDiffError, match=r"a\.json: is a folder"):
        write_live_link(tmp_path / "a.csv", weights)
    assert [file.name for file in tmp_path.iterdir() if file.is_file()] == []
    with pytest.raises(FaceDiffError, match=r"expected a table \.csv"):
        write_live_link(tmp_path / "a.txt", weights)
