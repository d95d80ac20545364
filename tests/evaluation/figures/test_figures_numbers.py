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
    find_phoneme,
    frame_at,
    pick_frames,
    read_phonemes,
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
