"""Time that passes only while every thread waits: a minute takes a moment, and is the same on a busy machine."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(eq=False)
class _Waiter:
    """A thread that waits, until a time at most."""

    until: float | None
    woken: threading.Event = field(default_factory=threading.Event)


class SimulatedTime:
    """In place of the modules ``time`` and ``threading``, for all threads that something under test starts.

    Whenever no thread is at work, the clock is put to the earliest time that one of them waits for, and that thread
    goes on. All their waiting has to be by this clock: another kind would count as work.
    """

    def __init__(self) -> None:
        self._now = 1000.0
        self._guard = threading.Lock()
        self._working = 1  # the thread that makes the clock
        self._waiters: list[_Waiter] = []

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        waiter = _Waiter(self._now + seconds)
        self.stop(waiter)
        waiter.woken.wait()

    def stop(self, waiter: _Waiter | None = None) -> None:
        """This thread works no more, until its waiter is woken, or for ever."""
        with self._guard:
            self._working -= 1
            if waiter is not None:
                self._waiters.append(waiter)
            timed = [other for other in self._waiters if other.until is not None]
            if not self._working and timed:
                first = min(timed, key=lambda other: other.until or 0.0)
                self._now = max(self._now, first.until or 0.0)
                self._wake(first)

    def wake(self, waiter: _Waiter) -> None:
        with self._guard:
            if waiter in self._waiters:
                self._wake(waiter)

    def _wake(self, waiter: _Waiter) -> None:
        self._waiters.remove(waiter)
        self._working += 1
        waiter.woken.set()

    def begin(self) -> None:
        """One more thread is at work."""
        with self._guard:
            self._working += 1

    # The names of the module.

    def Condition(self) -> _Condition:  # noqa: N802
        return _Condition(self)

    def Event(self) -> _Event:  # noqa: N802
        return _Event(self)

    def Lock(self) -> _Lock:  # noqa: N802
        return _Lock(self)

    def Thread(self, target: Callable[[], object], name: str, daemon: bool) -> _Thread:  # noqa: FBT001, N802
        return _Thread(self, target, name, daemon=daemon)


class _Condition:
    def __init__(self, clock: SimulatedTime) -> None:
        self._clock, self._lock, self._waiters = clock, threading.Lock(), list[_Waiter]()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def wait(self, timeout: float | None = None) -> None:
        waiter = _Waiter(None if timeout is None else self._clock.monotonic() + timeout)
        self._waiters.append(waiter)
        self._clock.stop(waiter)
        self._lock.release()
        waiter.woken.wait()
        self._lock.acquire()
        if waiter in self._waiters:
            self._waiters.remove(waiter)

    def notify(self, count: int = 1) -> None:
        for waiter in self._waiters[:count]:
            self._waiters.remove(waiter)
            self._clock.wake(waiter)


class _Event:
    def __init__(self, clock: SimulatedTime) -> None:
        self._changed, self._is_set = _Condition(clock), False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        with self._changed:
            self._is_set = True
            self._changed.notify(1000)

    def wait(self, timeout: float | None = None) -> bool:
        with self._changed:
            if not self._is_set:
                self._changed.wait(timeout)
            return self._is_set


class _Lock:
    def __init__(self, clock: SimulatedTime) -> None:
        self._changed, self._held = _Condition(clock), False

    def __enter__(self) -> None:
        with self._changed:
            while self._held:
                self._changed.wait()
            self._held = True

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._held = False
            self._changed.notify()


class _Thread:
    def __init__(self, clock: SimulatedTime, target: Callable[[], object], name: str, *, daemon: bool) -> None:
        self._clock, self._target, self._over = clock, target, _Event(clock)
        self._thread = threading.Thread(target=self._run, name=name, daemon=daemon)

    def start(self) -> None:
        self._clock.begin()
        self._thread.start()

    def _run(self) -> None:
        try:
            self._target()
        finally:
            self._over.set()
            self._clock.stop()

    def join(self, timeout: float | None = None) -> None:
        self._over.wait(timeout)
