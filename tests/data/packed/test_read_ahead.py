"""Reading ahead changes when bytes are asked for, and neither which nor their order; it keeps to its bound."""

from __future__ import annotations

import http.server
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from facediff.data.packed.packing import pack
from facediff.data.packed.read_ahead import THREADS, Answer, ReadAhead
from facediff.data.packed.stores import RemoteStore
from facediff.errors import FaceDiffError
from tests.data.packed.test_stores import TINY, Ranges
from tests.fakes.tiny import Tiny, write_tiny
from tests.fakes.waiting import wait_until


def answers(number: int, made: list[int]) -> Callable[[], Answer]:
    def request() -> Answer:
        made.append(number)
        return [memoryview(bytes([number]) * 100)]

    return request


def test_answers_are_taken_once_and_are_bounded() -> None:
    ahead, made = ReadAhead(most_bytes=300), []
    ahead.expect({number: answers(number, made) for number in range(20)})
    wait_until(lambda: ahead._bytes >= 300)
    time.sleep(0.05)
    assert len(made) < 3 + THREADS
    assert sorted(made) == list(range(len(made)))  # in order
    for number in range(20):
        answer = ahead.take(number)
        assert answer is None or bytes(answer[0]) == bytes([number]) * 100
        assert ahead.take(number) is None
        assert ahead._bytes < 300 + THREADS * 100
    wait_until(lambda: not ahead._running)
    assert ahead._bytes == 0


def test_what_is_no_longer_expected_is_given_up_and_what_failed_is_left_to_the_reader() -> None:
    ahead, made = ReadAhead(), []

    def failing() -> Answer:
        raise FaceDiffError("the server is away")

    ahead.expect({"gone": answers(1, made), "stays": answers(2, made), "bad": failing})
    wait_until(lambda: len(ahead._answers) == 2 and not ahead._running)
    ahead.expect({"stays": answers(2, made), "new": answers(3, made)})
    assert ahead.take("gone") is None
    assert ahead.take("bad") is None
    assert ahead.take("stays") is not None
    wait_until(lambda: "new" in ahead._answers)
    assert sorted(made) == [1, 2, 3]


class Faulty(Ranges):
    """Breaks off in the middle of its first answer to every question, and takes its time for all."""

    questions: ClassVar[Counter[tuple[str, str | None]]] = Counter()

    def do_GET(self) -> None:  # noqa: N802
        question = self.path, self.headers.get("Range")
        type(self).questions[question] += 1
        time.sleep(0.003 * (sum(self.questions.values()) % 4))
        # Readers ask again at once: by turns of the answers, one of several at a time could meet only the broken ones.
        if "motion" in self.path and "/c/" in self.path and self.questions[question] == 1:
            self.send_response(206)
            self.send_header("Content-Length", "100000")
            self.end_headers()
            self.wfile.write(bytes(50))
            self.close_connection = True
            return
        super().do_GET()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    root = tmp_path_factory.mktemp("served")
    pack(write_tiny(root / "corpus", sentences=6), root / "corpus.zarr", corpus=TINY, chunk_seconds=0.2, workers=1)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Faulty, directory=str(root))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield root, f"http://127.0.0.1:{server.server_address[1]}/corpus.zarr"
        server.shutdown()


def batches(root: str, workers: int, state: dict[str, int] | None = None) -> list[Any]:
    loader = Tiny(root=root, num_workers=workers, batch_size=2, window=9).train_dataloader()
    if state is not None:
        loader.load_state_dict(state)  # type: ignore[attr-defined]
    return list(loader)


def are_equal(one: list[Any], other: list[Any]) -> None:
    assert [batch.names for batch in one] == [batch.names for batch in other]
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a.motion, b.motion)
        assert torch.equal(a.audio, b.audio)
        assert torch.equal(a.reference, b.reference)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_slow_server_that_breaks_off_gives_the_same_batches_in_the_same_order(
    served: tuple[Path, str], workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FACEDIFF_PACKED_CACHE_GB", "0")
    Faulty.questions.clear()
    near = batches(str(served[0] / "corpus.zarr"), 0)
    are_equal(near, batches(served[1], workers))
    resumed = batches(served[1], workers, {"epoch": 0, "batches": 2, "seed": 0})
    are_equal(near[2:], resumed)


def test_a_loader_takes_what_was_fetched_for_it(served: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACEDIFF_PACKED_CACHE_GB", "0")
    asked: list[str] = []
    ranges = RemoteStore.ranges

    def recorded(store: RemoteStore, key: str, byte_ranges: Any) -> list[memoryview]:  # noqa: ANN401
        asked.append(threading.current_thread().name)
        return ranges(store, key, byte_ranges)

    monkeypatch.setattr(RemoteStore, "ranges", recorded)
    data = Tiny(root=served[1], batch_size=2, window=9)
    loader = data.train_dataloader()
    asked.clear()
    list(loader)
    assert sum(name == "facediff-read-ahead" for name in asked) > len(asked) / 2


def test_a_server_that_goes_away_is_one_sentence(served: tuple[Path, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FACEDIFF_PACKED_CACHE_GB", "0")
    data = Tiny(root=served[1], batch_size=2, window=9)
    loader = iter(data.train_dataloader())
    next(loader)
    away = FaceDiffError(f"{served[1]}: cannot be read")
    monkeypatch.setattr(RemoteStore, "_fetch", lambda *_: (_ for _ in ()).throw(away))
    with pytest.raises(FaceDiffError, match="cannot be read"):
        list(loader)
