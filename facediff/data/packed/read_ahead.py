"""Requests to a far store, made before their answers are needed."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Mapping
from threading import Condition, Thread
from typing import Any

THREADS = 4
"""Requests at a time: between them they hide the round trip of each."""
MOST_BYTES = 64 << 20
"""Bytes that wait to be used: nothing more is asked for until some of them are taken."""

Answer = list[memoryview]


class ReadAhead:
    """Makes requests in the order in which their answers will be needed, within a bound.

    It changes when bytes are asked for, never which: what is not there yet, or failed, the reader asks for itself, and
    meets the error itself.

    Args:
        most_bytes: of answers that were not taken yet.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self.most_bytes = most_bytes
        self._reset()

    def _reset(self) -> None:
        self._changed = Condition()
        self._waiting: dict[Hashable, Callable[[], Answer]] = {}
        self._running: set[Hashable] = set()
        self._answers: dict[Hashable, Answer] = {}
        self._bytes = 0
        self._threads: list[Thread] = []
        self._process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out threads and answers, which belong to their process."""
        return {"most_bytes": self.most_bytes}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start empty."""
        self.__init__(**state)  # type: ignore[misc]

    def expect(self, requests: Mapping[Hashable, Callable[[], Answer]]) -> None:
        """Make these requests, in their order; those of earlier calls that are not among them are given up."""
        if self._process != os.getpid():  # a fork has none of the threads, and perhaps a lock that one of them held
            self._reset()
        with self._changed:
            for key in self._answers.keys() - requests.keys():
                self._bytes -= _size(self._answers.pop(key))
            self._waiting = {
                key: request
                for key, request in requests.items()
                if key not in self._answers and key not in self._running
            }
            self._changed.notify_all()
            missing = min(THREADS, len(self._waiting)) - len(self._threads)
            # A daemon: a slow server must not hold up the end of the process.
            threads = [Thread(target=self._work, name="facediff-read-ahead", daemon=True) for _ in range(missing)]
            self._threads += threads
        for thread in threads:
            thread.start()

    def take(self, key: Hashable) -> Answer | None:
        """The answer to a request, once: waits for one that is under way; None if there is none."""
        if self._process != os.getpid():
            return None
        with self._changed:
            self._waiting.pop(key, None)
            while key in self._running:
                self._changed.wait()
            answer = self._answers.pop(key, None)
            if answer is not None:
                self._bytes -= _size(answer)
                self._changed.notify_all()
            return answer

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._waiting or self._bytes >= self.most_bytes:
                    self._changed.wait()
                key = next(iter(self._waiting))
                request = self._waiting.pop(key)
                self._running.add(key)
            answer: Answer | None = None  # and that of a thread that is ended
            try:
                answer = request()
            except Exception:  # noqa: BLE001 - whatever it is, the reader asks again and meets it
                answer = None
            finally:
                with self._changed:
                    self._running.discard(key)
                    if answer is not None:
                        self._answers[key] = answer
                        self._bytes += _size(answer)
                    self._changed.notify_all()


def _size(answer: Answer) -> int:
    return sum(len(part) for part in answer)
