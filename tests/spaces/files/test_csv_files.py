"""Recordings of Live Link Face and tables of Audio2Face: read, written and read again."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError, Note
from facediff.spaces import layout
from facediff.spaces.arkit import ARKIT, ROTATIONS, live_link_name
from facediff.spaces.files import ParameterClip, even, read_parameters, write_parameters
from facediff.spaces.files.csv_files import SIXTIETHS, fields_of, timecode
from facediff.spaces.rotations import convert, matrices

# The first rows of a real take have such steps: two sixtieths less a thousandth now and then.
CODES = ("13:13:04:31.652", "13:13:04:33.651", "13:13:04:35.651", "13:13:04:41.650", "13:13:04:43.650")
VALUES = np.random.default_rng(0).random((5, 61)).round(10)
VALUES[2, 3] = 1.0531234567  # as files have them


def write_take(path: Path, codes: tuple[str, ...] = CODES, *, count: str = "BlendShapeCount", wide: int = 61) -> Path:
    names = [*map(live_link_name, ARKIT), *ROTATIONS][:wide]
    rows = [
        f"{code},{wide}," + ",".join(f"{v:.10f}" for v in row[:wide]) for code, row in zip(codes, VALUES, strict=True)
    ]
    path.write_text("\n".join([f"Timecode,{count}," + ",".join(names), *rows]) + "\n")
    return path


@pytest.mark.parametrize("count", ["BlendShapeCount", "BlendshapeCount"])
def test_read_live_link_takes_the_rate_from_the_timecode(tmp_path: Path, count: str) -> None:
    clip = read_parameters(write_take(tmp_path / "take.csv", count=count))
    assert clip.frame_rate == 30.0
    assert clip.dropped == 2
    assert np.array_equal(clip.values[:, :52], VALUES[:, :52].astype(np.float32))
    # Yaw and roll turn the other way in the app's mirrored frame.
    assert np.array_equal(clip.values[:, 52:], (VALUES[:, 52:] * np.tile([-1, 1, -1], 3)).astype(np.float32))
    assert clip.values.max() > 1
    assert clip.space == layout("live_link")
    whole = even(clip)
    assert len(whole.values) == 7
    assert np.abs(whole.values[2, :52] - VALUES[2, :52]).max() < 0.002
    assert np.abs(whole.values[3, :52] - (2 * VALUES[2] + VALUES[3])[:52] / 3).max() < 0.002


def test_read_live_link_has_the_eyes_of_a_right_handed_face(tmp_path: Path) -> None:
    """A row of a real take: the eyes look to the face's left and up."""
    names = [*map(live_link_name, ARKIT), *ROTATIONS]
    shown = {
        "EyeLookOutLeft": 0.1079,
        "EyeLookInRight": 0.2143,
        "EyeLookUpLeft": 0.3423,
        "LeftEyeYaw": -0.1294,
        "LeftEyePitch": -0.1497,
        "LeftEyeRoll": 0.0195,
    }
    row = ",".join(str(shown.get(name, 0.0)) for name in names)
    lines = ["Timecode,BlendShapeCount," + ",".join(names), *(f"12:28:00:{k:02d}.068,61,{row}" for k in (1, 3))]
    (tmp_path / "take.csv").write_text("\n".join(lines))
    clip = read_parameters(tmp_path / "take.csv")
    turn = next(turn for turn in clip.space.rotations if turn.joint == "left_eye")
    quaternion = convert(clip.values[:1, list(turn.channels)], turn.form, "quaternion")
    looks = matrices(quaternion)[0] @ [0, 0, 1]
    assert looks[0] > 0.1  # +x is the face's left
    assert looks[1] > 0.1


def test_live_link_written_and_read_again_is_the_same(tmp_path: Path) -> None:
    clip = read_parameters(write_take(tmp_path / "take.csv"))
    write_parameters(tmp_path / "again.csv", clip)
    again = read_parameters(tmp_path / "again.csv")
    assert np.array_equal(again.values, clip.values)
    assert clip.times is not None
    assert again.times is not None
    assert np.array_equal(again.times, clip.times)
    assert [line.split(",")[0] for line in (tmp_path / "again.csv").read_text().splitlines()[1:]] == list(CODES)


def test_read_live_link_without_rotations_declares_them_absent(tmp_path: Path) -> None:
    clip = read_parameters(write_take(tmp_path / "take.csv", wide=52))
    assert clip.space.absent == ROTATIONS
    assert not clip.values[:, 52:].any()


def test_timecodes_of_all_times() -> None:
    for seconds in np.random.default_rng(1).integers(0, 86_400 * 60_000, 200) / 60_000:
        back = fields_of(timecode(seconds))
        assert back is not None
        assert abs(back[0] + back[1] / SIXTIETHS - seconds) < 1e-9
    for text in ("00:00:60:00.0", "00:60:00:00.0", "24:00:00:00.0", "00:00:00:60.0", "00:00:00"):
        assert fields_of(text) is None
    assert fields_of("23:59:59:59.999") == (86_399, 59.999)


def test_a_row_a_second_is_read_at_its_rate(tmp_path: Path) -> None:
    codes = tuple(f"00:00:0{second}:00.000" for second in range(5))
    assert read_parameters(write_take(tmp_path / "take.csv", codes)).frame_rate == 1.0


@pytest.mark.parametrize("name", ["JawOpen", "EyeBlinkLeft", "MouthClose"])
def test_a_table_without_a_weight_is_refused(name: str, tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.csv")
    rows = [line.split(",") for line in path.read_text().splitlines()]
    at = rows[0].index(name)
    path.write_text("\n".join(",".join(row[:at] + row[at + 1 :]) for row in rows))
    with pytest.raises(FaceDiffError, match=name[1:]):
        read_parameters(path)
    path.write_text("timeCode,blendShapes\n0,1\n")
    with pytest.raises(FaceDiffError, match="has no columns"):
        read_parameters(path)


def test_read_live_link_goes_on_after_midnight(tmp_path: Path) -> None:
    codes = ("23:59:59:56.000", "23:59:59:58.000", "00:00:00:00.000", "00:00:00:02.000", "00:00:00:04.000")
    clip = read_parameters(write_take(tmp_path / "take.csv", codes))
    assert clip.times is not None
    assert np.allclose(clip.times, np.arange(5) / 30)


def test_read_live_link_counts_the_rows_without_a_face(tmp_path: Path) -> None:
    lines = write_take(tmp_path / "take.csv").read_text().splitlines()
    lines[2] = f"{CODES[1]},61" + 61 * ","
    lines[4] = lines[4].replace(CODES[3], CODES[0])
    (tmp_path / "take.csv").write_text("\n".join(lines))
    with pytest.raises(FaceDiffError, match="row 5 is no later"):
        read_parameters(tmp_path / "take.csv")


def test_audio2face_is_read_by_its_names(tmp_path: Path) -> None:
    space = layout("audio2face")
    values = np.random.default_rng(2).random((4, 52)).astype(np.float32)
    header = "timeCode," + ",".join(f"blendShapes.{name[:1].upper()}{name[1:]}" for name in space.channels[:-1])
    rows = [f"{time / 30}," + ",".join(map(str, row[:-1])) for time, row in enumerate(values)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    clip = read_parameters(tmp_path / "a.csv")
    assert clip.frame_rate == 30.0
    assert clip.space.absent == ("tongueOut",)
    # Its mouthClose closes the lips of an open jaw, as Apple's jawOpen and mouthClose do together.
    values[:, space.index("jawOpen")] += values[:, space.index("mouthClose")]
    assert np.array_equal(clip.values[:, :-1], values[:, :-1])


def test_every_arkit_order_reaches_a_live_link_table(tmp_path: Path) -> None:
    for name in ("arkit", "arkit_51", "audio2face", "mediapipe"):
        space = layout(name)
        values = np.random.default_rng(3).random((3, len(space.channels))).astype(np.float32)
        write_parameters(tmp_path / "t.csv", ParameterClip("t", values, space, 30.0))
        read = read_parameters(tmp_path / "t.csv")
        for column, channel in enumerate(space.channels):
            if channel != "_neutral":
                assert np.array_equal(read.values[:, read.space.index(channel)], values[:, column]), (name, channel)
    flame = ParameterClip("f", np.zeros((3, 106), np.float32), layout("flame_artalk"), 25.0)
    with pytest.raises(FaceDiffError, match="flame"):
        write_parameters(tmp_path / "t.csv", replace(flame, name="g"))


def coded(rows: int, rate: int, counted: float, first: int = 0) -> list[str]:
    """Timecodes of rows at a rate, with the last field in parts of a second; ``first`` is the first row's number."""
    codes = []
    for row in range(first, first + rows):
        second, frame = divmod(row % (24 * 3600 * rate), rate)
        codes.append(f"{second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}:{frame * counted / rate:06.3f}")
    return codes


def write_sine(path: Path, codes: list[str], rate: int) -> np.ndarray:
    names = [*map(live_link_name, ARKIT), *ROTATIONS]
    values = np.zeros((len(codes), 61))
    values[:, names.index("JawOpen")] = 0.3 + 0.3 * np.sin(np.pi * np.arange(len(codes)) / rate)
    rows = [f"{code},61," + ",".join(f"{value:.8f}" for value in row) for code, row in zip(codes, values, strict=True)]
    path.write_text("\n".join([",".join(["Timecode", "BlendShapeCount", *names]), *rows]))
    return values[:, names.index("JawOpen")]


@pytest.mark.parametrize("first", [0, 1, 17, -30])
@pytest.mark.parametrize("rate", [24, 25, 30, 48, 50, 60])
def test_timecodes_that_count_frames_are_read_at_their_rate(rate: int, first: int, tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    jaw = write_sine(path, coded(2 * rate + 6, rate, rate, first), rate)
    with pytest.warns(Note, match=f"counts frames, {rate} a second") if rate < 60 else nullcontext():
        clip = read_parameters(path)
    assert clip.frame_rate == rate
    assert clip.dropped == 0
    found = even(clip)
    np.testing.assert_allclose(found.values[:, found.space.index("jawOpen")], jaw, atol=1e-6)


@pytest.mark.parametrize("rate", [24, 25, 30, 48, 50, 60])
def test_timecodes_of_sixtieths_stay_sixtieths(rate: int, tmp_path: Path) -> None:
    jaw = write_sine(tmp_path / "take.csv", coded(2 * rate + 6, rate, 60, 7), rate)
    clip = read_parameters(tmp_path / "take.csv")
    assert clip.frame_rate == rate
    np.testing.assert_allclose(even(clip).values[:, clip.space.index("jawOpen")], jaw, atol=1e-3)


def test_frames_that_are_counted_may_be_dropped(tmp_path: Path) -> None:
    codes = [code for number, code in enumerate(coded(96, 30, 30)) if number % 7]
    codes[20] = codes[20].removesuffix(".000") + ".020"  # parts of a frame
    write_sine(tmp_path / "take.csv", codes, 30)
    with pytest.warns(Note, match="30 a second"):
        clip = read_parameters(tmp_path / "take.csv")
    assert (clip.frame_rate, clip.dropped) == (30.0, 13)


@pytest.mark.parametrize("form", ["live link", "audio2face", "beat"])
def test_a_gap_of_hours_is_refused_by_its_row(form: str, tmp_path: Path) -> None:
    path = tmp_path / ("take.json" if form == "beat" else "take.csv")
    if form == "live link":
        write_sine(path, [*coded(9, 60, 60), "13:00:00:00.000"], 60)
    elif form == "audio2face":
        names = [f"blendShapes.{name}" for name in layout("audio2face").channels]
        rows = [f"{time}," + ",".join("0" * len(names)) for time in (0, 1 / 60, 2 / 60, 99_000)]
        path.write_text("\n".join([",".join(["timeCode", *names]), *rows]))
    else:
        frames = [{"weights": [0.0] * 52, "time": time} for time in (0.0, 0.01, 21_599.0)]
        path.write_text(json.dumps({"names": list(ARKIT), "frames": frames, "metadata": {"fps": 138}}))
    where = {"live link": "row 11", "audio2face": "row 5", "beat": "frame 2"}[form]
    with pytest.raises(FaceDiffError, match=rf"{where} comes \d+ s after"):
        read_parameters(path)


def test_a_take_that_begins_without_a_face_begins_with_its_sound(tmp_path: Path) -> None:
    write_sine(path := tmp_path / "take.csv", coded(12, 60, 60), 60)
    expected = read_parameters(path)
    header, *rows = path.read_text().splitlines()
    blank = [",".join([*row.split(",")[:2], *[""] * (row.count(",") - 1)]) for row in rows[:3]]
    path.write_text("\n".join([header, *blank, *rows[3:]]))
    found = even(read_parameters(path))
    assert found.start == expected.start
    np.testing.assert_allclose(found.values[3:], even(expected).values[3:], atol=1e-6)
    np.testing.assert_allclose(found.values[:3], found.values[[3] * 3], atol=1e-6)


@pytest.mark.parametrize("column", ["JawOpen", "jawopen", "Timecode", "timecode ", " BlendShapeCount"])
def test_a_column_twice_is_refused(column: str, tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.csv")
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([f"{header},{column}", *(f"{row},0" for row in rows)]))
    with pytest.raises(FaceDiffError, match="twice"):
        read_parameters(path)


@pytest.mark.parametrize("form", ["sep=,\n{}", "\ufeff{}", "\ufeffsep=,\r\n{}", "tabs", "blanks", "case"])
def test_live_link_tables_are_read_as_people_save_them(form: str, tmp_path: Path) -> None:
    path = write_take(tmp_path / "take.csv")
    expected = read_parameters(path)
    text = path.read_text()
    changes = {"tabs": text.replace(",", "\t"), "blanks": text.replace(",", " , "), "case": text.upper()}
    path.write_text(changes.get(form) or form.format(text), encoding="utf-8")
    found = read_parameters(path)
    np.testing.assert_array_equal(found.values, expected.values)
    assert found.frame_rate == expected.frame_rate
