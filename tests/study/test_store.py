"""Answers are stored once and whole, by several writers at a time; a kill loses nothing that was acknowledged."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.study.answers import Answer
from facediff.study.store import AnswerStore, FullError
from tests.fakes.study import SCORES, simulate, small_study, write_answers

TOKEN = "0123456789abcdef" * 2


def test_what_is_stored_comes_back(tmp_path: Path) -> None:
    study = small_study()
    store = write_answers(tmp_path, study, 5)
    expected = simulate(study, SCORES, 5)
    found = store.raters()
    assert [(r.token, r.number, r.language, r.code, dict(r.answers)) for r in found] == [
        (r.token, r.number, r.language, r.code, dict(r.answers)) for r in expected
    ]
    assert all(rater.finished for rater in found)
    assert {path.name for path in tmp_path.iterdir()} == {"answers.sqlite"}  # nothing is open


def test_raters_at_the_same_time_get_numbers_of_their_own_and_lose_nothing(tmp_path: Path) -> None:
    study = small_study()
    store = AnswerStore(tmp_path / "a.sqlite", study)
    raters = simulate(study, SCORES, 12, seed=3)

    def answer(index: int) -> int:
        token = raters[index].token
        number = store.register(token, "en", "")
        for trial in study.trials_of(number):
            store.save(token, Answer(trial.id, {"realism": "left", "style": "left"}, 1.0, 1, "2026-01-01T00:00:00Z"))
        assert store.finish(token, {})
        return number

    with ThreadPoolExecutor(6) as pool:
        assert sorted(pool.map(answer, range(12))) == list(range(12))
    assert all(len(rater.answers) == len(study.trials_of(rater.number)) for rater in store.raters())


WRITER = """
import sys
from pathlib import Path
from facediff.study.answers import Answer
from facediff.study.store import AnswerStore
from tests.fakes.study import small_study
study = small_study(clips=40)
store = AnswerStore(Path(sys.argv[1]), study)
store.register("0" * 32, "en", "")
for trial in study.trials_of(0):
    store.save("0" * 32, Answer(trial.id, {"realism": "left", "style": "left"}, 1.0, 1, "2026-01-01T00:00:00Z"))
    print(trial.id, flush=True)
print("all", flush=True)
sys.stdin.read()
"""


def test_a_kill_loses_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    words = [sys.executable, "-c", WRITER, str(tmp_path / "a.sqlite")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = [process.stdout.readline().strip() for _ in range(15)]
        os.kill(process.pid, signal.SIGKILL)
        said += process.stdout.read().split()
    (rater,) = AnswerStore(tmp_path / "a.sqlite", small_study(clips=40)).raters()
    assert {each for each in said if each and each != "all"} <= set(rater.answers)


def test_a_full_study_other_studies_and_damaged_files_are_refused(tmp_path: Path) -> None:
    study = small_study()
    store = AnswerStore(tmp_path / "a.sqlite", study, most_raters=1)
    AnswerStore(tmp_path / "a.sqlite", small_study(seed=1))  # nobody has answered yet
    store = AnswerStore(tmp_path / "a.sqlite", study, most_raters=1)
    store.register(TOKEN, "en", "")
    assert store.register(TOKEN, "en", "") == 0
    with pytest.raises(FullError):
        store.register("f" * 32, "en", "")
    for read_only in (False, True):
        with pytest.raises(FaceDiffError, match=r"a\.sqlite"):
            AnswerStore(tmp_path / "a.sqlite", small_study(seed=1), read_only=read_only)
    (tmp_path / "b.sqlite").write_bytes(b"no database at all " * 100)
    for read_only in (False, True):
        with pytest.raises(FaceDiffError, match=r"b\.sqlite"):
            AnswerStore(tmp_path / "b.sqlite", study, read_only=read_only)
    with closing(sqlite3.connect(tmp_path / "a.sqlite")) as database:
        assert database.execute("PRAGMA journal_mode").fetchone() == ("wal",)
