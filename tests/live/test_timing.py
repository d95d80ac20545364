"""Clocks of a live performance: against arrivals that are known, and NumPy's percentiles."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.live.timing import MARGIN, Lags, Pacer, SpokenClock


def test_clock_ignores_late_blocks_and_follows_a_drifting_sound_card() -> None:
    rng = np.random.default_rng(0)
    clock, drift = SpokenClock(), 1.0005  # seconds of this machine for each second of the sound card
    for block in range(1, 20_000):
        moment = block * 0.01
        late = 0.03 * rng.random() * (block % 7 != 0)  # every seventh block comes in time
        clock.arrived(moment, 1000 + drift * moment + late)
        if block > 100:
            # Over the five seconds that are remembered, the drift is 2.5 ms.
            assert abs(clock.spoken(moment) - (1000 + drift * moment)) < 0.003


def test_clock_begins_again_after_a_pause_and_keeps_what_was_before() -> None:
    clock = SpokenClock()
    for block in range(1, 101):
        clock.arrived(block * 0.01, 50 + block * 0.01)
    for block in range(101, 201):
        clock.arrived(block * 0.01, 53 + block * 0.01)  # three seconds without a sample
    assert clock.spoken(0.5) == pytest.approx(50.5)
    assert clock.spoken(1.5) == pytest.approx(54.5)


def test_delay_is_what_bursts_need() -> None:
    pacer = Pacer(hop=0.4)
    for burst in range(100):
        pacer.ready(burst * 0.4, burst * 0.4 + 0.6)
        assert pacer.delay is not None
        assert 0.6 + MARGIN <= pacer.delay + 1e-9 <= 0.6 + 2 * MARGIN + 2e-9
    assert pacer.due(7.0) == pytest.approx(7.6 + MARGIN)


def test_delay_grows_by_a_hop_at_most_and_shrinks_slowly() -> None:
    pacer = Pacer(hop=0.2)
    now, needs = 0.0, [0.5] * 10 + [2.0] + [0.5] * 100
    delays = []
    for need in needs:
        now += 0.2
        pacer.ready(now - need, now)
        delays.append(pacer.delay or 0.0)
    assert max(delays) == pytest.approx(0.7)
    assert min(np.diff(delays)) >= -0.03 * 0.2 - 1e-9  # 3 % of the time that passed
    assert min(np.diff(delays[-50:])) >= -0.01 * 0.2 - 1e-9  # 1 % once little is left
    assert delays[-1] < 0.6


def test_delay_recovers_from_a_time_in_which_the_machine_was_busy() -> None:
    pacer, now = Pacer(hop=0.2), 0.0
    for need in [0.5] * 10 + [4.0] * 100 + [0.5] * 250:  # twenty seconds, and then fifty
        now += 0.2
        pacer.ready(now - need, now)
        if need == 4.0:
            longest = pacer.delay or 0.0
    assert 4.0 < longest < 4.1
    assert pacer.delay is not None
    assert pacer.delay < 0.7


def test_lags_are_percentiles() -> None:
    values = np.random.default_rng(1).gamma(3.0, 0.1, 5000)
    lags = Lags()
    for value in values:
        lags.add(float(value))
    assert lags.worst == pytest.approx(values.max())
    for share in (0.5, 0.95, 0.99):
        assert lags.share(share) == pytest.approx(np.quantile(values, share), abs=0.002)
    assert np.isnan(Lags().share(0.5))
    assert str(Lags()) == "none"
