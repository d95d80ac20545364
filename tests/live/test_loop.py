"""The loop by a simulated clock, with a model and receivers that cost what a test says."""

from __future__ import annotations

import threading
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from facediff.errors import FaceDiffError
from facediff.live.frames import LiveFrame
from facediff.live.loop import Backlog, LiveSummary, Loop
from facediff.live.sources import Deliver
from facediff.live.timing import MARGIN
from facediff.speech.audio import samples_for
from tests.fakes.live import AHEAD, FRAME_RATE, HOP, FakeStream, Kept, Spoken, fake_model
from tests.fakes.simulated_time import SimulatedTime

FRAME = 1 / FRAME_RATE


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> SimulatedTime:
    simulated = SimulatedTime()
    for name in ("loop.time", "loop.threading"):
        monkeypatch.setattr(f"facediff.live.{name}", simulated)
    for name in ("timing", "frames"):
        monkeypatch.setattr(f"facediff.live.{name}.monotonic", simulated.monotonic)
    monkeypatch.setattr("tests.fakes.live.time", simulated)
    return simulated


def test_every_frame_leaves_at_its_time(clock: SimulatedTime) -> None:
    kept, reports = Kept(), list[str]()
    loop = Loop(fake_model(), Spoken(0.8), [kept], report=reports.append, every=0.3)
    began = clock.monotonic()
    summary = loop.run()
    assert [frame.index for frame in kept.frames] == list(range(40))
    assert [frame.vertices[0, 0] for frame in kept.frames] == list(range(40))
    assert np.allclose([frame.time for frame in kept.frames], np.arange(40) * FRAME)
    # Bursts of four frames come every 80 ms, but leave one by one, while the delay shrinks by 10 ms a second.
    assert np.allclose(np.diff(kept.times), FRAME, atol=0.001)
    # The first frame of a burst waits for the others and the look-ahead.
    least = (HOP + AHEAD - 1) * FRAME
    assert summary.lag.share(0.5) == pytest.approx(least + 2 * MARGIN, abs=MARGIN)
    assert np.allclose([frame.heard for frame in kept.frames], began + (1 + np.arange(40)) * FRAME)
    assert (summary.frames, summary.dropped, summary.lost) == (40, 0, 0)
    assert summary.receivers == {"kept:": "40 frames"}
    assert reports
    assert all("lag" in sentence for sentence in [*reports, *summary.sentences()[:1]])


def test_slow_receiver_gets_fewer_frames_and_never_older_ones() -> None:
    kept = Kept(seconds=2.5 * FRAME)
    summary = Loop(fake_model(), Spoken(0.8), [kept], report=str).run()
    numbers = [frame.index for frame in kept.frames]
    assert numbers == sorted({*numbers})
    assert summary.dropped == 40 - len(numbers) > 10
    assert kept.frames[-1].dropped > 5
    assert summary.lag.worst < (HOP + AHEAD) * FRAME + 2 * HOP * FRAME + 0.5


def test_slow_model_drops_speech_says_so_once_and_keeps_its_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facediff.live.loop.RECENT", 0.5)
    kept, reports = Kept(), list[str]()
    loop = Loop(fake_model(partial(FakeStream, 2.5)), Spoken(2.4), [kept], report=reports.append)
    summary = loop.run()
    assert len([sentence for sentence in reports if "--steps" in sentence]) == 1
    assert 0.2 < summary.lost < 1.6
    numbers = np.array([frame.index for frame in kept.frames])
    assert (np.diff(numbers) > 0).all()
    assert summary.frames + summary.dropped == pytest.approx(120 - summary.lost * FRAME_RATE, abs=1)
    # Numbers count speech that was dropped, so that a frame's time is that of the speech.
    assert numbers[-1] == 119
    assert summary.lag.worst < 2.0


@pytest.mark.parametrize(("cost", "lost"), [(0.7, False), (4.0, True)])
def test_frames_are_left_out_before_speech_is_dropped(
    cost: float, *, lost: bool, clock: SimulatedTime, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model and a receiver that share one processor: fewer frames give a model of 0.7 s a second its time."""
    processor, spared = clock.Lock(), list[bool]()

    class Shared(FakeStream):
        def feed(self, samples: np.ndarray) -> np.ndarray:
            with processor:
                return super().feed(samples)

    class Busy(Kept):
        def send(self, frame: LiveFrame) -> None:
            with processor:
                clock.sleep(0.8 * FRAME)
            super().send(frame)

    loop = Loop(fake_model(partial(Shared, cost)), Spoken(2.4), [Busy()], report=str)
    drop = loop._backlog._drop

    def dropping(least: int) -> None:
        spared.append(loop._thinning.at_most)
        drop(least)

    monkeypatch.setattr(loop._backlog, "_drop", dropping)
    summary = loop.run()
    assert (summary.lost > 0) == lost == bool(spared)
    assert all(spared)
    assert summary.dropped > 5


def test_one_long_window_is_not_blamed_on_the_model(clock: SimulatedTime, monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the process is stopped for a while: frames are left out then, and counted alike in both reports."""

    class Stopped(FakeStream):
        def feed(self, samples: np.ndarray) -> np.ndarray:
            if self.heard < 8_000 <= self.heard + len(samples):
                clock.sleep(1.2)
            return super().feed(samples)

    monkeypatch.setattr("facediff.live.loop.RECENT", 0.5)
    reports = list[str]()
    loop = Loop(fake_model(Stopped), Spoken(2.4), [Kept()], report=reports.append, every=0.2)
    summary = loop.run()
    assert not [sentence for sentence in reports if "--steps" in sentence]
    assert summary.lost == 0
    assert summary.dropped > 5
    assert f"{summary.dropped} frames dropped" in reports[-1]
    assert "1 frame of 0.0 s" in LiveSummary(frames=1).sentences()[0]


def test_click_is_in_the_frame_in_which_it_was_spoken(clock: SimulatedTime) -> None:
    """Of a face that follows the level of the sound: the time at which its frame leaves is that of the click, late by
    what a frame lasts, and the margin.
    """

    class Clicks(Spoken):
        def run(self, deliver: Deliver, stopped: threading.Event) -> None:
            places = (20, 41, 67)
            for piece in range(100):
                clock.sleep(0.01)
                if piece in places:
                    clicked.append(clock.monotonic())
                deliver(np.full(160, float(piece in places), np.float32), clock.monotonic())

    class Level(FakeStream):
        def feed(self, samples: np.ndarray) -> np.ndarray:
            self.heard += len(samples)
            self.levels = np.concatenate([getattr(self, "levels", np.zeros(0)), samples])
            made = np.zeros((len(self.levels) // 320, 4, 3), np.float32)
            made[:, 0, 0] = self.levels[: 320 * len(made)].reshape(-1, 320).max(1)
            self.levels = self.levels[320 * len(made) :]
            self.made += len(made)
            return made

    kept, clicked = Kept(), list[float]()
    Loop(fake_model(Level), Clicks(1.0), [kept], report=str).run()
    loud = [place for place, frame in enumerate(kept.frames) if frame.vertices[0, 0] > 0.5]
    assert [kept.frames[place].index for place in loud] == [10, 20, 33]
    lags = np.array([kept.times[place] for place in loud]) - clicked
    assert (lags >= 0).all()
    assert lags.max() < FRAME + 2 * MARGIN + 0.001
    heard = np.array([kept.frames[place].heard for place in loud])
    assert np.abs(heard - clicked).max() < FRAME


def test_speech_weights_and_the_end_reach_the_receivers() -> None:
    kept, solved = Kept(weights=True), list[float]()

    def solve(offsets: np.ndarray) -> np.ndarray:
        solved.append(float(offsets[0, 0]))
        return offsets[:1, 0] / 100

    loop = Loop(fake_model(), Spoken(30.0), [kept], hearing=True, solve=solve, seconds=0.3, report=str)
    assert loop.run().speech == pytest.approx(0.3)
    assert sum(len(samples) for samples, _ in kept.speech) == 4800
    assert np.allclose([start for _, start in kept.speech], np.arange(30) * 0.01)
    assert solved == list(range(15))  # once a frame, in order
    weights = [float(frame.weights[0]) for frame in kept.frames if frame.weights is not None]
    assert weights == pytest.approx(np.arange(15) / 100)


class Turning(FakeStream):
    """The same frames by a head that turns, about an axis of its own in each frame, and shifts."""

    def _frames(self, count: int) -> np.ndarray:
        first = self.made
        plain = super()._frames(count)
        turns = np.random.default_rng(first).normal(size=(count, 3))
        self.heads = np.concatenate([turns, np.full((count, 3), 0.5)], axis=1)
        return np.asarray([Rotation.from_rotvec(turn).apply(frame) + 0.5 for turn, frame in zip(turns, plain)])  # noqa: B905


def test_weights_are_those_of_a_head_that_does_not_move() -> None:
    kept, solved = Kept(weights=True), list[np.ndarray]()

    def solve(offsets: np.ndarray) -> np.ndarray:
        solved.append(offsets)
        return offsets[:1, 0]

    Loop(fake_model(Turning), Spoken(0.3), [kept], solve=solve, report=str).run()
    expected = np.zeros((15, 4, 3))
    expected[:, 0, 0] = np.arange(15)
    np.testing.assert_allclose(solved, expected, atol=1e-5)
    for frame, still in zip(kept.frames, expected, strict=True):
        assert frame.head is not None
        moved = Rotation.from_rotvec(frame.head[:3]).apply(still) + frame.head[3:]
        np.testing.assert_allclose(frame.vertices, moved, atol=1e-5)


def test_no_frame_comes_without_weights_where_the_delay_grows_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    kept, asked = Kept(weights=True), list[int]()

    def late(_loop: Loop, frame: LiveFrame) -> bool:
        asked.append(frame.index)
        return frame.index == 5 and asked.count(5) == 1  # not any more when it is due

    monkeypatch.setattr(Loop, "_late", late)
    Loop(fake_model(), Spoken(0.3), [kept], solve=lambda offsets: offsets[:1, 0], report=str).run()
    assert len(kept.frames) >= 14
    assert all(frame.weights is not None for frame in kept.frames)


def test_receiver_that_fails_does_not_stop_the_others() -> None:
    failing, kept, reports = Kept(error=RuntimeError("gone")), Kept(), list[str]()
    Loop(fake_model(), Spoken(0.3), [failing, kept], report=reports.append).run()
    assert len(kept.frames) == len(failing.frames) == 15
    assert len([sentence for sentence in reports if "gone" in sentence]) == 1


def test_interrupt_ends_with_a_summary(clock: SimulatedTime) -> None:
    kept = Kept(error=KeyboardInterrupt())
    began = clock.monotonic()
    summary = Loop(fake_model(), Spoken(30.0), [kept], report=str).run()
    assert clock.monotonic() - began < 1
    assert summary.receivers == {"kept:": "3 frames"}


def test_error_of_the_source_or_the_model_is_raised() -> None:
    class Broken(FakeStream):
        def feed(self, samples: np.ndarray) -> np.ndarray:
            raise FaceDiffError("model: broken")

    kept = Kept()
    with pytest.raises(FaceDiffError, match="unplugged"):
        Loop(fake_model(), Spoken(0.4, error=FaceDiffError("unplugged")), [kept], report=str).run()
    assert len(kept.frames) == 20  # what was heard is finished
    with pytest.raises(FaceDiffError, match="broken"):
        Loop(fake_model(Broken), Spoken(30.0), [kept], report=str).run()


@pytest.mark.parametrize("frame_rate", [25.0, 29.97, 60.0])
def test_backlog_drops_whole_frames_without_an_error_that_adds_up(frame_rate: float) -> None:
    backlog, put, taken = Backlog(frame_rate, 0.5), 0, 0
    rng = np.random.default_rng(0)
    for _ in range(300):
        count = int(rng.integers(1, 2000))
        backlog.put(np.arange(put, put + count, dtype=np.float32))
        put += count
        if rng.random() < 0.3:
            found = backlog.take(0.05)
            assert found is not None
            samples, dropped = found
            # Samples are numbered: what is missing before these is exactly what the dropped frames last.
            assert samples[0] == taken + samples_for(dropped, frame_rate)
            assert (np.diff(samples) == 1).all()
            taken += len(samples)
    assert backlog.dropped > 100
    backlog.end()
    while backlog.take(0.05) is not None:
        pass


def test_lag_stays_through_a_pause() -> None:
    kept = Kept()
    loop = Loop(fake_model(), Spoken(40.0, pauses={1500: 1.0}), [kept], report=str)
    loop.run()
    lags = np.array(kept.times) - [frame.heard for frame in kept.frames]
    assert abs(np.median(lags[-250:]) - np.median(lags[250:750])) < 0.001
