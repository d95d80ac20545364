"""TextGrids in every form that aligners write, and what is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from facediff.errors import FaceDiffError, Note
from facediff.speech.phonemes import closed_times, closing, closures, read_alignment, read_phonemes

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
@pytest.mark.filterwarnings("ignore::facediff.errors.Note")
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_textgrid_gives_the_phonemes_with_their_times(text: str, encoding: str, tmp_path: Path) -> None:
    path = tmp_path / "a.TextGrid"
    path.write_text(text, encoding=encoding)
    found = read_alignment(path)
    assert [(each.start, each.end) for each in found] == [(0, 0.2), (0.2, 0.35), (0.35, 0.6), (0.6, 0.9)]
    assert [found[0].ipa, found[1].ipa, found[3].ipa] == ["", "m", "p"]
    assert closed_times(found) == [(0.2, 0.35), (0.6, 0.9)]
    assert closures(found, 100.0) == [(20, 35), (60, 90)]


@pytest.mark.filterwarnings("ignore::facediff.errors.Note")
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


OLD_SHORT = SHORT.replace(
    'File type = "ooTextFile"\nObject class = "TextGrid"', 'File type = "ooTextFile short"\n"TextGrid"'
)
COMMENTED = LONG.replace('text = "M"', 'text = "M" ! the lips "close" 5').replace(
    "xmin = 0\n", "xmin = 0 ! seconds\n", 1
)


@pytest.mark.parametrize("text", [OLD_SHORT, COMMENTED, COMMENTED.replace("\n", "\r\n"), OLD_SHORT.replace("\n", " ")])
@pytest.mark.filterwarnings("ignore::facediff.errors.Note")
def test_other_forms_that_praat_reads_are_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.TextGrid"
    path.write_bytes(text.encode())
    assert closed_times(read_alignment(path)) == [(0.2, 0.35), (0.6, 0.9)]
    path.write_bytes(
        text.replace("say", "s\u00e4y").replace("\u00e6", "\u00e4").replace("\u02b0", "").encode("latin-1")
    )
    assert closed_times(read_alignment(path)) == [(0.2, 0.35), (0.6, 0.9)]


@pytest.mark.parametrize("count", ["1e999", "9" * 5000, "-1e400", "1e15"])
def test_a_count_that_no_file_holds_is_named(count: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.TextGrid"
    for text in (LONG.replace("size = 4", f"size = {count}"), SHORT.replace("<exists>\n1", f"<exists>\n{count}")):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(FaceDiffError, match=r"odd\.TextGrid"):
            read_alignment(path)


# Labels of each set with the p, b or m for which the lips close.
SETS: dict[str, dict[str, str]] = {
    "Kaldi": {"P_B": "p", "M_I": "m", "AA1_I": "", "B_E": "b", "SIL_S": "", "P_S": "p", "IY0_E": "", "SPN": ""},
    "Kaldi without stress": {"P": "p", "M": "m", "AA": "", "B": "b", "SIL": "", "F": ""},
    "MFA": {"pʰ": "p", "pʲ": "p", "bʲ": "b", "mʲ": "m", "m̩": "m", "pʷ": "p", "ɱ": "", "b": "b", "ɑː": "", "p͈": "p"},
    "MFA, ARPAbet": {"P": "p", "B": "b", "M": "m", "AE1": "", "W": "", "ER0": ""},
    "TIMIT": {"pcl": "p", "p": "p", "bcl": "b", "b": "b", "em": "m", "m": "m", "dcl": "", "epi": "", "h#": ""},
    "Buckeye": {"p": "p", "b": "b", "em": "m", "m": "m", "tq": "", "nx": "", "ahn": "", "SIL": "", "{B_TRANS}": ""},
    "X-SAMPA": {
        "p_h": "p", "m": "m", "A:": "", "b_0": "b", "p_}": "p", "p:": "p", "pf": "p", "m=": "m", "M": "", "B": "",
        '"p': "p", "%b": "b", "b_<": "b", "k_p": "p", "p\\": "", "B\\": "b", "p'": "p", "m_0": "m", "P": "",
    },
    "SAMPA, German": {"p": "p", "pf": "p", "OY": "", "I": "", "@": "", "b": "b", "6": "", "m": "m", "Y": ""},
    "IPA": {
        "ˈp": "p", "k͡p": "p", "ɡ͡b": "b", "ŋ͡m": "m", "ᵐb": "b", "p͡f": "p", "p͜f": "p", "b̥": "b", "m̥": "m", "pʼ": "p",
        "ɓ": "b", "ʙ": "b", "ɸ": "", "β": "", "p̚": "p", "mː": "m", "b̤": "b", "ʘ": "p", "u": "", "ã": "", "t͡s": "",
    },
    "Japanese, Julius": {"py": "p", "by": "b", "my": "m", "p": "p", "N": "", "ch": "", "u": ""},
    "Hindi": {"ph": "p", "bh": "b", "p": "p", "kh": ""},
}  # fmt: skip


@pytest.mark.parametrize("name", SETS)
def test_labels_of_a_set_close_the_lips(name: str, tmp_path: Path) -> None:
    labels = SETS[name]
    assert dict(zip(labels, [found or "" for found in closing([*labels])], strict=True)) == labels
    rows = [f'{i},{i + 1},"{label.replace(chr(34), 2 * chr(34))}"' for i, label in enumerate(labels)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["start,end,ipa", *rows]), encoding="utf-8")
    closed = [(i, i + 1) for i, found in enumerate(labels.values()) if found]
    with pytest.warns(Note, match=rf"{len(closed)} of \d+ labels close the lips"):
        found = read_alignment(path)
    assert closed_times(found) == closed_times(read_phonemes(path)) == closed


@pytest.mark.parametrize("row", ["-0.5,1,m", "2,1,m", "0,inf,m", "0,nan,m"])
def test_times_that_no_phoneme_has_are_refused(row: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"start,end,ipa\n{row}\n", encoding="utf-8")
    with pytest.raises(FaceDiffError, match="starts below 0"):
        read_phonemes(path)


def test_an_alignment_without_closures_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("start,end,ipa\n0,1,a\n1,2,sil\n2,3,t\n", encoding="utf-8")
    with pytest.warns(Note, match="0 of 2 labels close the lips; expected p, b and m"):
        read_alignment(path)
