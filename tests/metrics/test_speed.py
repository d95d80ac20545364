"""Real-time factor: a ratio of sums, measured around what computes."""

from __future__ import annotations

import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.metrics import (
    RealTimeFactor,
    device_name,
    real_time_factor,
)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0.1, 100)), min_size=1, max_size=9))
def test_the_factor_is_a_ratio_of_sums(times: list[tuple[float, float]]) -> None:
    expected = sum(took for took, _ in times) / sum(spoken for _, spoken in times)
    metric = RealTimeFactor("one core")
    for took, spoken in times:
        metric.update(took, spoken)
    assert metric.compute().item() == pytest.approx(expected)
    took, spoken = torch.tensor(times, dtype=torch.float64).unbind(1)
    assert real_time_factor(took, spoken).item() == pytest.approx(expected)


def test_measuring_takes_the_time_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.5, 20.0, 90.0])
    monkeypatch.setattr("facediff.metrics.speed.time.perf_counter", lambda: next(clock))
    metric = RealTimeFactor(device_name("cpu"))
    with metric.measure(speech=5.0):
        pass
    with pytest.raises(RuntimeError, match="inside"), metric.measure(speech=1.0):
        raise RuntimeError("inside")
    assert metric.compute().item() == 0.5
    assert f"on {device_name('cpu')} [1]" in metric.describe()
    assert "thread" in device_name("cpu")


def test_times_that_are_none_are_refused() -> None:
    metric = RealTimeFactor("one core")
    for took, spoken in ((-1.0, 1.0), (1.0, 0.0), (float("nan"), 1.0), (1.0, float("inf"))):
        with pytest.raises(ValueError, match="must be positive seconds"):
            metric.update(took, spoken)
    with pytest.raises(ValueError, match="must be positive seconds"):
        metric.update(torch.ones(2), 1.0)
    with pytest.raises(ValueError, match="has no clip"):
        metric.compute()
    metric.update(1.0, 4.0)
    metric.half()
    assert pickle.loads(pickle.dumps(metric)).compute().item() == 0.25  # noqa: S301
