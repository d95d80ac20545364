"""Tables as Live Link's importers read them, and the files next to them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from facediff.editing.blendshapes import Weights, live_link_values, write_live_link, write_weights
from facediff.spaces.arkit import ARKIT
from facediff.spaces.files import read_parameters


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
    assert [float(row["JawOpen"]) for row in rows] == pytest.approx(weights.values[:, 0], abs=1e-7)
    assert [float(row["EyeBlinkLeft"]) for row in rows] == pytest.approx(weights.values[:, 2], abs=1e-7)
    # What has no shape is zero, and said to be absent.
    about = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert len(about["absent"]) == 49
    for name in about["absent"]:
        assert {row[name[0].upper() + name[1:]] for row in rows} == {"0.0"}
    assert {float(row[column]) for row in rows for column in row if "Yaw" in column or "Roll" in column[-4:]} == {0.0}
    assert about["not_in_table"] == ["mine"]
    assert about["still"] == ["tongueOut"]
    assert about["residual_rms_mm"] == pytest.approx(weights.residual_rms_mm, abs=1e-6)
    assert about["frame_rate"] == 30.0


def test_a_table_reads_as_it_was_written(tmp_path: Path) -> None:
    """Weights, a head's turn and the eyes' own rotations, through the reader of recordings."""
    rng = np.random.default_rng(1)
    values = rng.uniform(0, 1, (70, len(ARKIT)))
    head = rng.normal(0, 0.3, (70, 3))
    weights = Weights(ARKIT, values, np.zeros(70), np.zeros(70), 1.0, 25.0, head=head, eyes=rng.normal(0, 0.2, (70, 6)))
    write_live_link(tmp_path / "a.csv", weights)
    clip = read_parameters(tmp_path / "a.csv")
    assert clip.frame_rate == 25.0
    assert np.array_equal(clip.values, live_link_values(weights)[0])
    assert np.array_equal(clip.values[:, : len(ARKIT)], values.astype(np.float32))
    assert clip.values[:, 55:] == pytest.approx(weights.eyes, abs=1e-7)
    matrices = Rotation.from_rotvec(head).as_matrix()
    assert Rotation.from_euler("YXZ", clip.values[:, 52:55]).as_matrix() == pytest.approx(matrices, abs=1e-6)


def test_eyes_turn_as_their_weights_say(tmp_path: Path, weights: Weights) -> None:
    """Eye columns against a row of a real take, whose eyes look down, and to the left and up by signs."""
    looking = replace(weights, names=("jawOpen", "eyeLookDownLeft", "eyeLookOutLeft", "eyeLookInRight"), still=())
    looking.values[0, 1:] = 0.4569, 0.0, 0.0
    looking.values[1, 1:] = 0.0, 0.2, 0.2
    write_live_link(tmp_path / "a.csv", looking)
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[0]["LeftEyePitch"]) == pytest.approx(0.2796, abs=0.005)
    assert float(rows[0]["LeftEyeYaw"]) == 0.0
    assert float(rows[1]["LeftEyeYaw"]) == float(rows[1]["RightEyeYaw"]) == pytest.approx(-0.12, abs=1e-6)
    assert json.loads((tmp_path / "a.json").read_text())["rotations_absent"] == ["head"]


def test_a_plain_table(tmp_path: Path, weights: Weights) -> None:
    write_weights(tmp_path / "a.csv", weights)
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert table.dtype.names == ("time", *weights.names, "residual_rms_mm", "residual_max_mm")
    assert table["time"] == pytest.approx(np.arange(70) / 30, abs=1e-6)
    assert table["mine"] == pytest.approx(weights.values[:, 1], abs=1e-8)
    assert table["residual_max_mm"] == pytest.approx(weights.residual_max_mm, abs=1e-6)
    assert json.loads((tmp_path / "a.json").read_text())["not_in_table"] == []


def read_like_unreal(path: Path, *, infers: bool) -> tuple[list[float], list[dict[str, str]]]:
    """Times and rows as the importer of Unreal Engine has them.

    Its first versions take the frames as sixtieths; the later ones infer 30 frames a second unless a frame number
    exceeds 30.
    """
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    codes = [[float(part) for part in row["Timecode"].split(":")] for row in rows]
    rate = 60 if not infers or any(code[3] > 30 for code in codes) else 30
    return [code[0] * 3600 + code[1] * 60 + code[2] + code[3] / rate for code in codes], rows


@pytest.mark.parametrize("infers", [False, True])
@pytest.mark.parametrize("rate", [24.0, 25.0, 29.97, 30.0, 50.0, 60.0, 120.0])
@pytest.mark.parametrize("frames", [1, 5, 16, 31, 32, 400])
def test_unreal_reads_every_frame_at_its_time(
    tmp_path: Path, weights: Weights, infers: bool, rate: float, frames: int
) -> None:
    made = replace(weights, values=np.resize(weights.values, (frames, 4)), frame_rate=rate)
    write_live_link(tmp_path / "a.csv", made)
    times, rows = read_like_unreal(tmp_path / "a.csv", infers=infers)
    assert times[:frames] == pytest.approx(np.arange(frames) / rate, abs=1e-4)
    # A table that would be taken for one of 30 frames a second is held until it cannot be.
    assert len(rows) - frames == json.loads((tmp_path / "a.json").read_text())["rows_held"] <= 1
    assert {row["JawOpen"] for row in rows[frames - 1 :]} == {rows[frames - 1]["JawOpen"]}
