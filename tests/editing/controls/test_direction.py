"""Keys over time: their curves against formulas, their files as round trips, and what is refused."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from facediff.editing.controls.direction import STEP_SECONDS, Direction, Key, curve, read_direction, slopes, text_shares
from facediff.errors import FaceDiffError

LARGER = "expressiveness"
TIMES = np.linspace(-1.0, 8.0, 1801)


def keys(*values: float, kind: str = "smooth", apart: float = 1.0) -> list[Key]:
    return [Key(apart * index, LARGER, value, kind) for index, value in enumerate(values)]  # type: ignore[arg-type]


def test_a_step_keeps_its_value_until_the_next_key() -> None:
    assert curve(keys(1, 3, 0.5, kind="step"), [-1, 0, 0.5, 0.999, 1, 1.5, 2, 9]).tolist() == [
        *[1, 1, 1, 1],
        *[3, 3, 0.5, 0.5],
    ]


def test_linear_keys_are_joined_by_lines() -> None:
    when, values = [0.0, 1.0, 2.5, 3.0], [1.0, 3.0, 0.5, 0.5]
    found = curve([Key(t, LARGER, v, "linear") for t, v in zip(when, values, strict=True)], TIMES)
    np.testing.assert_allclose(found, np.interp(TIMES, when, values), atol=1e-12)


def test_smooth_keys_are_the_cubic_through_their_slopes() -> None:
    made = [Key(0, LARGER, 1, slope=1.0), Key(1, LARGER, 2, slope=-0.5), Key(3, LARGER, 1.5, slope=0.25)]
    expected = CubicHermiteSpline([0, 1, 3], [1, 2, 1.5], [1.0, -0.5, 0.25])
    inside = TIMES[(TIMES >= 0) & (TIMES <= 3)]
    np.testing.assert_allclose(curve(made, inside), expected(inside), atol=1e-12)


def test_slopes_are_those_of_the_neighbours_and_flat_where_the_value_turns() -> None:
    assert slopes(keys(0, 1, 1.5, 1)).tolist() == [0, 0.75, 0, 0]
    assert slopes(keys(0, 0.1, 4)).tolist() == [0, pytest.approx(0.3), 0]


VALUES = st.lists(st.floats(0, 4, allow_subnormal=False), min_size=2, max_size=7)


@settings(max_examples=40, deadline=None)
@given(VALUES, st.floats(0.05, 3))
def test_smooth_curves_never_leave_the_range_of_their_two_keys(values: list[float], apart: float) -> None:
    made = keys(*values, apart=apart)
    for before, after in pairwise(made):
        found = curve(made, np.linspace(before.time, after.time, 50))
        low, high = sorted([float(before.value), float(after.value)])
        assert found.min() >= low - 1e-9
        assert found.max() <= high + 1e-9


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(["step", "linear", "smooth"])), min_size=1))
def test_shares_of_texts_sum_to_one(made: list[tuple[str, str]]) -> None:
    found = Direction([Key(i, "style", text, kind) for i, (text, kind) in enumerate(made)])  # type: ignore[arg-type]
    np.testing.assert_allclose(sum(found.shares("style", TIMES).values()), 1.0, atol=1e-12)
    assert all(share.min() >= 0 for share in text_shares(found.keys, TIMES, eased=True).values())


def test_texts_crossfade() -> None:
    found = Direction([Key(0, "style", "a", "linear"), Key(1, "style", "b"), Key(2, "style", "c", "step")])
    shares = found.shares("style", [0.25, 1.25, 2])
    np.testing.assert_allclose(shares["b"], [0.25, 1 - (3 / 16 - 2 / 64), 0])
    np.testing.assert_allclose(shares["c"], [0, 3 / 16 - 2 / 64, 1])


@pytest.mark.parametrize("kind", ["step", "smooth"])
def test_eased_curves_do_not_pop(kind: str) -> None:
    """At any frame rate, no frame goes further than the steepest 3t² − 2t³ allows."""
    fine = np.arange(0, 3, 0.001)
    found = curve(keys(1, 3, 0.5, kind=kind), fine, eased=True)
    assert np.abs(np.diff(found)).max() <= 1.5 * 2.5 * 0.001 / STEP_SECONDS + 1e-9
    np.testing.assert_allclose(curve(keys(1, 3, 0.5, kind=kind), [0, 1, 2], eased=True), [1, 3, 0.5])


def test_equal_keys_give_their_value_to_the_last_bit() -> None:
    for kind in ("step", "linear", "smooth"):
        assert set(curve(keys(1.1, 1.1, 1.1, kind=kind), TIMES, eased=True).tolist()) == {1.1}


@pytest.mark.parametrize("suffix", [".json", ".csv"])
def test_files_come_back_as_they_were(tmp_path: Path, suffix: str) -> None:
    made = Direction(
        [
            Key(0.1, "style", 'a,b".npy:0.3,F1_e03:-0.7', "linear"),
            Key(1 / 3, "head.yaw", -2.5, slope=1e-7),
            Key(2, "expressivity.upper_face", 0.5, "step"),
        ]
    )
    assert read_direction(made.save(tmp_path / f"keys{suffix}")).keys == made.keys
    assert Direction.parse(made.text(), "text").keys == made.keys


def test_a_table_with_semicolons_is_refused(tmp_path: Path) -> None:
    """As spreadsheets of countries with a decimal comma write it."""
    (tmp_path / "keys.csv").write_text("Time;channel;value\n1;sway;1\n")
    with pytest.raises(FaceDiffError, match="semicolons between its columns"):
        read_direction(tmp_path / "keys.csv")


@pytest.mark.parametrize(
    ("row", "field"),
    [
        ({"time": 0, "channel": "expresiveness", "value": 1}, "channel"),
        ({"time": 0, "channel": "head", "value": 1}, "channel"),
        ({"time": 0, "channel": "head.nod", "value": 1}, "channel"),
        ({"time": 0, "channel": "blinks.left", "value": 1}, "channel"),
        ({"time": 0, "channel": ["sway"], "value": 1}, "channel"),
        ({"time": 0, "channel": LARGER, "value": 4.1}, "value"),
        ({"time": 0, "channel": LARGER, "value": True}, "value"),
        ({"time": 0, "channel": LARGER, "value": "much"}, "value"),
        ({"time": 0, "channel": LARGER}, "value"),
        ({"time": 0, "channel": "style", "value": 3}, "value"),
        ({"time": -1, "channel": LARGER, "value": 1}, "time"),
        ({"time": "1:2", "channel": LARGER, "value": 1}, "time"),
        ({"channel": LARGER, "value": 1}, "time"),
        ({"frame": 1, "channel": LARGER, "value": 1}, "frame"),
        ({"time": 0, "channel": LARGER, "value": 1, "interpolation": "cubic"}, "interpolation"),
        ({"time": 0, "channel": LARGER, "value": 1, "slope": "steep"}, "slope"),
        ({"time": 0, "channel": LARGER, "value": 1, "ease": 1}, "ease"),
        (3, "row 2"),
    ],
)
def test_what_is_wrong_is_named_with_its_file_and_row(tmp_path: Path, row: object, field: str) -> None:
    path = tmp_path / "keys.json"
    path.write_text(json.dumps({"keys": [{"time": 9, "channel": "sway", "value": 1}, row]}))
    with pytest.raises(FaceDiffError) as raised:
        read_direction(path)
    assert [word for word in (str(path), "row 2", field) if word not in str(raised.value)] == []


def test_keys_say_whose_work_they_do(tmp_path: Path) -> None:
    keys = [Key(0, "lids", 1.0), Key(0, "style", "a")]
    made = Direction(keys, instead_of=("acting", "blinks"))
    found = read_direction(made.save(tmp_path / "keys.json"))
    assert found.instead_of == Direction.parse(made.text(), "text").instead_of == ("acting", "blinks")
    finished = found.without_model_channels()
    assert finished is not None
    assert finished.instead_of == ("acting", "blinks")
    assert "instead_of" not in Direction(keys).text()
    with pytest.raises(FaceDiffError, match=r"keys.csv: expected .json"):
        made.save(tmp_path / "keys.csv")
    for wrong in ("acting", ["sway"], [["acting"]], 1):
        with pytest.raises(FaceDiffError, match="x.json: instead_of"):
            Direction.parse({"instead_of": wrong, "keys": made.rows()}, "x.json")
