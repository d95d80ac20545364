"""TextGrids in every form that aligners write, and what is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.speech.phonemes import closed_times, closures, read_alignment

LONG = """File type = "ooTextFile"
Object class = "TextGrid"

xmin = 0
xmax = 0.9
tiers? <exists>
size = 3
item []:
    item [1]:
        class = "IntervalTier"
        name = "words"
        xmin = 0
        xmax = 0.9
        intervals: size = 1
        intervals [1]:
            xmin = 0
            xmax = 0.9
            text = "say ""map"" 5"
    item [2]:
        class = "TextTier"
        name = "clicks"
        xmin = 0
        xmax = 0.9
        points: size = 1
        points [1]:
            number = 0.4
            mark = "x"
    item [3]:
        class = "IntervalTier"
        name = "Anna - phones"
        xmin = 0
        xmax = 0.9
        intervals: size = 4
        intervals [1]:
            xmin = 0
            xmax = 0.2
            text = "sil"
        intervals [2]:
            xmin = 0.2
            xmax = 0.35
            text = "M"
        intervals [3]:
            xmin = 0.35
            xmax = 0.6
            text = "AE1"
        intervals [4]:
            xmin = 0.6
            xmax = 0.9
            text = "p\u02b0"
"""
SHORT = """File type = "ooTextFile"
Object class = "TextGrid"

0
0.9
<exists>
1
"IntervalTier"
"phones"
0
0.9
4
0
0.2
""
0.2
0.35
"m"
0.35
0.6
"\u00e6"
0.6
0.9
"p"
"""


@pytest.mark.parametrize("text", [LONG, SHORT], ids=["long", "short"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_textgrid_gives_the_phonemes_with_their_times(text: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.TextGrid"
    path.write_text(text, encoding=encoding)
    found = read_alignment(path)
    assert [(each.start, each.end) for each in found] == [(0, 0.2), (0.2, 0.35), (0.35, 0.6), (0.6, 0.9)]
    assert [found[0].ipa, found[1].ipa, found[3].ipa] == ["", "m", "p"]
    assert closed_times(found) == [(0.2, 0.35), (0.6, 0.9)]
    assert closures(found, 100.0) == [(20, 35), (60, 90)]


def test_table_with_arpabet_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("start,end,ipa\n0,0.1,B\n0.1,0.2,\u02c8b\n0.2,0.3,AA0\n0.3,0.4,sp\n", encoding="utf-8")
    found = read_alignment(path)
    assert closed_times(found) == [(0, 0.1), (0.1, 0.2)]
    assert found[3].ipa == ""


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        LONG.replace("phones", "morphs"),
        LONG.replace("xmax = 0.35", "xmax = nan"),
        SHORT.replace("0.35\n0.6", "0.6\n0.35"),
        SHORT[: len(SHORT) // 2],
        SHORT.replace('"m"', "5"),
        SHORT.replace("ooTextFile", "ooBinary"),
    ],
)
def test_what_is_no_textgrid_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.TextGrid"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FaceDiffError, match=r"odd\.TextGrid"):
        read_alignment(path)
