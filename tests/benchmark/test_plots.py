"""Plots of benchmarks: what is drawn, and what there is nothing to draw of."""

from __future__ import annotations

from dataclasses import replace

from facediff.benchmark import report_of
from facediff.benchmark.plots import curves_plot, mean_curve, plots_of, scatter_plot, speed_plot
from tests.fakes.benchmark import outline, results


def test_curves_are_means_over_runs_and_as_long_as_the_shortest() -> None:
    first, second = results(rows=1, seeds=2)
    longer = {"step": [10.0, 20.0, 40.0, 50.0], "val/lve": [5.0, None, 3.0, 1.0]}
    points = mean_curve([first, replace(second, curve=longer)], "step")
    assert points == [(10.0, 4.0), (20.0, 2.0), (35.0, 2.0)]
    assert mean_curve([first, replace(second, problem="failed")], "step")[-1] == (30.0, 1.0)
    assert mean_curve([replace(first, curve={"step": [1.0]})], "step") == []


def test_what_has_no_numbers_has_no_plot() -> None:
    report = report_of(outline(), results(), resamples=0)
    (table,) = report.tables
    drawings = plots_of(table, report)
    assert set(drawings) == {"steps", "time", "sentences", "speed"}
    assert all("Method 1" in drawing.svg for drawing in drawings.values())
    assert "Method 0" not in drawings["sentences"].svg.replace("lve of Method 0", "")  # all others against it
    alone = replace(table, rows=table.rows[:1])
    assert scatter_plot(alone) is None
    assert speed_plot(alone) is None
    idle = [replace(result, curve={}) for result in report.results]
    assert set(plots_of(table, replace(report, results=idle))) == {"sentences", "speed"}


def test_rows_of_one_label_are_all_drawn_and_named_also_with_an_underscore() -> None:
    named = replace(outline(), rows={name: ("_same", "") for name in outline().rows})
    report = report_of(named, results(), resamples=0)
    (table,) = report.tables
    drawings = [curves_plot(table, report, "step"), scatter_plot(table), speed_plot(table)]
    assert [drawing and drawing.svg.count("> _same<") for drawing in drawings] == [3, 2, 3]
