"""The numbers behind figures against plain NumPy, and what makes them refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from facediff.errors import FaceDiffError
from facediff.evaluation.figures import (
    FigureData,
    Moment,
    choose_scalars,
    find_metrics,
    find_phoneme,
    frame_at,
    pick_frames,
    read_curves,
    read_phonemes,
    smooth,
)

CLIPS = ["A_e06", "A_e07", "B_e06"]
Array = NDArray[np.float64]
Read = Callable[[str, str], Array]
NAMES = ["truth", "ours", "theirs"]


def test_a_time_picks_the_frame_on_the_screen(own_material: FigureData, read: Read) -> None:
    # At 25 frames a second frame 3 is shown from 0.12 s to 0.16 s.
    assert [frame_at(time, 25) for time in (0.0, 0.0399, 0.04, 0.12, 0.1599, 0.16)] == [0, 0, 1, 3, 3, 4]
    picked = pick_frames(own_material, "A_e06", [Moment(0.13), Moment(0.0)])
    assert list(picked) == NAMES
    for name, faces in picked.items():
        np.testing.assert_array_equal(faces[0], read(name, "A_e06")[3])
        np.testing.assert_array_equal(faces[1], read(name, "A_e06")[0])


TABLE = (
    "start,end,ipa,viseme\n0,0.10,,SIL\n0.10,0.20,m,PP\n0.20,0.30,ˈɑː,AA\n0.30,0.36,f,FF\n"
    "0.36,0.42,ɑ,AA\n0.42,0.5,m,PP\n0.5,0.6,ˌaʊ,AA+UH\n"
)


def test_a_phoneme_is_found_at_its_middle(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(TABLE, encoding="utf-8")
    phonemes = read_phonemes(tmp_path / "p.csv")
    wanted = {
        "m": 0.15,
        "m:2": 0.46,
        "f": 0.33,
        "ɑː": 0.25,
        "ɑ": 0.39,
        "ˈɑː": 0.25,
        "aʊ": 0.55,
        "FF": 0.33,
        "AA:3": 0.55,
    }
    for name, middle in wanted.items():
        assert find_phoneme(name, phonemes, "A_e06").middle == pytest.approx(middle), name
    with pytest.raises(FaceDiffError, match="not so often"):
        find_phoneme("m:3", phonemes, "A_e06")
    with pytest.raises(FaceDiffError, match=r'"z": not spoken, or not so often, in clip A_e06: known are m, ɑː, f'):
        find_phoneme("z", phonemes, "A_e06")
    assert Moment(0.15, phonemes[1]).heading.large == "/m/"
    assert Moment(0.15, replace(phonemes[1], word="map")).heading.large == "/m/ map"


CSV = "epoch,lr,step,train/loss,val/lve\n,0.1,0,,\n0,,0,4.0,\n0,,9,2.0,\n0,,9,,0.5\n1,,19,nan,\n1,,19,,0.25\n"


def test_curves_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text(CSV)
    curves = read_curves(find_metrics(tmp_path))
    assert set(curves) == {"lr", "train/loss", "val/lve"}
    np.testing.assert_array_equal(curves["train/loss"].at, [0, 9, 19])
    np.testing.assert_array_equal(curves["train/loss"].values, [4, 2, np.nan])
    np.testing.assert_array_equal(curves["val/lve"].values, [0.5, 0.25])
    by_epoch = read_curves(tmp_path / "metrics.csv", "epoch")
    np.testing.assert_array_equal(by_epoch["val/lve"].at, [0, 1])
    np.testing.assert_array_equal(by_epoch["train/loss"].values, [2, np.nan])  # the epoch's last
    runs = {"one": curves, "two": curves}
    assert choose_scalars(runs, None) == ["train/loss", "val/lve"]
    with pytest.raises(FaceDiffError, match=r'--scalar: one: there is no scalar "val/lvee".*did you mean "val/lve"'):
        choose_scalars(runs, ["val/lvee"])
    with pytest.raises(FaceDiffError, match="known are lr"):
        choose_scalars({"one": {"lr": curves["lr"]}}, None)


def test_smoothing_is_the_weighted_mean_of_the_past() -> None:
    values = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    for place, found in enumerate(smooth(values, 0.7)):
        weights = 0.7 ** np.arange(place, -1, -1)
        assert found == pytest.approx((weights * values[: place + 1]).sum() / weights.sum())
    np.testing.assert_array_equal(smooth(values, 0.0), values)
    np.testing.assert_allclose(smooth(np.array([2.0, np.nan, 2.0]), 0.9), [2, np.nan, 2])
