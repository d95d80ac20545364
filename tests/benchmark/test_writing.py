"""Reports: what is marked, what is said of papers' figures, and names that mean something to LaTeX or HTML."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from facediff.benchmark import report_of
from facediff.benchmark.outline import read_outline, read_results, write_outline
from facediff.benchmark.results import read_result
from facediff.benchmark.tables import BenchmarkReport
from facediff.benchmark.writing import (
    BEGIN,
    END,
    Scale,
    document,
    latex_tables,
    replace_block,
    text,
    write_report,
)
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.reporting.documents import html_page, markdown
from facediff.reporting.statistics import Interval
from tests.fakes.benchmark import outline, results


def made(*, seeds: int = 3, effects: Sequence[float] = (0.0, 0.6, 1.2)) -> BenchmarkReport:
    return report_of(outline(seeds=seeds), results(seeds=seeds, effects=effects, of_runs=0.01), resamples=200)


def test_means_and_deviations_are_over_seeds_and_intervals_over_sentences() -> None:
    found = results(effects=(0.0, 0.6, 1.2), of_runs=0.01)
    (table,) = report_of(outline(), found, resamples=500).tables
    row = table.row("method_1")
    runs = [each.scores[0]["lve"] for each in found if each.row == "method_1"]
    assert row.scores["lve"].mean == pytest.approx(np.mean(runs))
    assert row.scores["lve"].deviation == pytest.approx(np.std(runs, ddof=1))
    interval = row.intervals["lve"]
    assert interval is not None
    # Sentences differ by 0.3, runs by 0.01: an interval over sentences is the wider one.
    assert interval.high - interval.low > 3 * float(row.scores["lve"].deviation or 0)
    assert [each.marks.get("lve") for each in table.rows] == ["best", "second", None, None]
    assert table.row("still").reference
    assert row.significant("lve", 0.95)


def test_the_order_of_cells_changes_nothing() -> None:
    found = results(effects=(0.0, 0.6, 1.2))
    assert document(report_of(outline(), found, resamples=50)) == document(
        report_of(outline(), sorted(found, key=lambda each: (each.seed, each.row)), resamples=50)
    )


def test_a_single_seed_is_said_and_nothing_is_marked() -> None:
    report = made(seeds=1)
    (table,) = report.tables
    assert not any(row.marks for row in table.rows)
    assert not any(row.significant("lve", 0.95) for row in table.rows if not row.reference)
    assert "a single training run" in table.notes[0]


def test_a_method_that_a_still_face_beats_is_noted() -> None:
    report = made(effects=(9.0, 9.6, 10.2))
    assert any("no method is better than this reference: still face" in note for note in report.tables[0].notes)


def test_a_sub_sample_is_named_wherever_a_table_is_printed() -> None:
    found = results()
    some = [
        dataclasses.replace(result, scores=[{**row, "test_share": 0.125} for row in result.scores]) for result in found
    ]
    for tested, named in ((found, False), (some, True)):
        report = report_of(outline(), tested, resamples=50)
        printed = (text(report), latex_tables(report), markdown(document(report)))
        assert [re.search(r"a sub-sample of 12\.5 \\?%", each) is not None for each in printed] == [named] * 3


def test_the_mean_of_samples_is_a_row_that_others_are_compared_with() -> None:
    """Of the methods that draw samples alone; a method is found by the mean's name where it has none."""
    nan = float("nan")
    found = results(effects=(0.0, 0.2, 1.2), of_runs=0.01, further={"sample_mean": (-0.5, nan, nan)})
    for baseline, chosen in (("method_0.mean", "method_0.mean"), ("method_1.mean", "method_1")):
        (table,) = report_of(outline(baseline=baseline), found, resamples=100).tables
        assert [row.name for row in table.rows] == ["method_0", "method_0.mean", "method_1", "method_2", "still"]
        assert table.baseline == chosen
        gap = table.row("method_2").differences["lve"][0].value
        assert gap == pytest.approx(table.row("method_2").scores["lve"].mean - table.row(chosen).scores["lve"].mean)
        assert not table.row("method_0.mean").reference
        assert table.row("method_0.mean").marks == {"lve": "best", "fdd": "best"}


def test_a_method_that_ignores_its_speech_is_named() -> None:
    """Each method's own and shuffled speech are compared in the same training runs."""
    found = results(effects=(0.0, 0.6, 1.2), of_runs=0.2, further={"shuffled": (0.1, 0.0, -0.1)})
    for seeds in (1, 3):
        some = [result for result in found if result.seed is not None and result.seed < seeds]
        (table,) = report_of(outline(references=("still", "shuffled")), some, resamples=100).tables
        assert [row.label for row in table.rows if row.reference] == [
            *("still face", "Method 0, shuffled speech", "Method 1, shuffled speech", "Method 2, shuffled speech")
        ]
        said = "by lve, another sentence's speech gives equal scores: Method 1, Method 2"
        assert said in table.notes


def test_all_forms_are_written_and_hold_the_same_numbers(tmp_path: Path) -> None:
    report = made()
    files = write_report(report, tmp_path)
    assert {path.suffix for path in files} == {".md", ".tex", ".html", ".csv"}
    mean = report.tables[0].row("method_0").scores["lve"].mean
    with (tmp_path / "made.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    (row,) = [each for each in rows if (each["row"], each["score"]) == ("method_0", "lve")]
    assert float(row["mean"]) == mean
    assert row["mark"] == "best"
    for form in (markdown(document(report)), latex_tables(report), html_page("", document(report)), text(report)):
        assert f"{mean:.3f}" in form
    tex = latex_tables(report)
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 1
    assert all(f"\\{rule}rule" in tex for rule in ("top", "mid", "bottom"))
    assert rf"\textbf{{{mean:.3f}" in tex
    # A table that leaves its page still says what it is of.
    assert row["synthetic"] == "True"
    assert "Synthetic data." in tex


@pytest.mark.parametrize(
    ("halves", "deviations", "shown"),
    [
        ((0.8e-6, 2e-6), (), "3.42 [2.62, 4.22]"),
        ((0.031e-6,), (), "3.417 [3.386, 3.448]"),
        ((0.8e-6,), (None, 0.0, 0.004e-6), "3.417 [2.617, 4.217]"),
        ((), (), "3.4170"),
    ],
)
def test_decimals_end_where_intervals_and_deviations_do(
    halves: Sequence[float], deviations: Sequence[float | None], shown: str
) -> None:
    intervals = [Interval(3.417e-6 - half, 3.417e-6 + half) for half in halves]
    scale = Scale.of([3.417e-6, 8e-6], [None, *intervals], deviations)
    assert " ".join([scale.number(3.417e-6), *map(scale.interval, intervals[:1])]) == shown


def test_the_page_needs_no_network_and_shows_hostile_names_as_they_are() -> None:
    evil = '<script>alert("x")</script> & \\input{x} | _a_ %'
    found = dataclasses.replace(outline(), rows={name: (evil, "") for name in outline().rows}, title=evil)
    report = report_of(found, results(), resamples=20)

    class Tags(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            assert tag != "script"
            assert not any(name in ("src", "href") or name.startswith("on") for name, _ in attrs)

    whole = html_page(evil, document(report))
    Tags().feed(whole)
    assert not re.search("https?:", re.sub(r"http://www\.w3\.org/(2000/svg|1999/xlink)", "", whole))
    assert r"\textbackslash{}input\{x\}" in latex_tables(report)
    assert "\\<script\\>" in markdown(document(report))
    assert "\\|" in markdown(document(report))


def test_the_block_of_a_page_is_replaced_and_the_rest_stays(tmp_path: Path) -> None:
    file = tmp_path / "page.md"
    begin, end = BEGIN.format(name="made"), END.format(name="made")
    file.write_text(f"# Title\n\n{begin}\nwas here\n{end}\n\nlast\n")
    replace_block(file, made())
    once = file.read_text()
    assert once.startswith(f"# Title\n\n{begin}\n")
    assert once.endswith(f"{end}\n\nlast\n")
    assert "was here" not in once
    replace_block(file, made())
    assert file.read_text() == once
    windows = once.replace("\n", "\r\n").encode()
    file.write_bytes(windows.replace(b"last", b"the last"))
    replace_block(file, made())
    assert file.read_bytes() == windows.replace(b"last", b"the last")
    file.write_text("nothing\n")
    with pytest.raises(FaceDiffError, match="made"):
        replace_block(file, made())


def test_the_command_writes_a_report_from_results_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_outline(tmp_path, outline())
    for result in results(effects=(0.0, 0.6, 1.2), of_runs=0.01)[1:]:
        result.write(tmp_path)
    assert main(["benchmark", "report", str(tmp_path), "--bootstrap", "50", "--baseline", "method_1"]) == 0
    printed = capsys.readouterr().out
    assert "method_0-tiny-seed0" in printed  # the cell that has no result yet
    assert (tmp_path / "report" / "made.html").is_file()
    found, missing = read_results(tmp_path, read_outline(tmp_path))
    assert (len(found), len(missing)) == (8, 1)
    assert main(["benchmark", "report", str(tmp_path), "--baseline", "nobody"]) == 2
    assert "nobody" in capsys.readouterr().err
    assert main(["benchmark", "report", str(tmp_path / "none")]) == 2
    assert str(tmp_path / "none") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("scores", 0, "frames"), -1),
        (("scores", 0, "frames"), 10**15),
        (("scores", 0, "sequences"), -3),
        (("sequences", 0, "frames"), -1),
        (("provenance", "parameters"), -1),
        (("measured", "fit", "seconds"), -1.0),
        (("measured", "fit", "memory"), float("-1e9")),
    ],
)
def test_counts_that_no_run_has_are_refused(place: tuple[str | int, ...], value: float, tmp_path: Path) -> None:
    path = next(iter(results(effects=(0.0,), of_runs=0.01))).write(tmp_path)
    content = json.loads(path.read_text())
    holder = content
    for key in place[:-1]:
        holder = holder.setdefault(key, {}) if isinstance(holder, dict) else holder[key]
    assert read_result(path) is not None
    holder[place[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(FaceDiffError, match=path.name):
        read_result(path)
