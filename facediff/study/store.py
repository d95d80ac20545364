"""Answers in an SQLite file: several raters at the same time, nothing lost by a crash, nothing stored twice."""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import quote

from facediff.errors import FaceDiffError
from facediff.study.answers import MOST_RATERS, Answer, Rater
from facediff.study.definition import Study
from facediff.utils.plain_files import parse_json

WAIT = 30.0
"""Seconds that a writer waits for another one."""
SCHEMA = """
CREATE TABLE IF NOT EXISTS study (id TEXT PRIMARY KEY) STRICT;
CREATE TABLE IF NOT EXISTS raters (
    token TEXT PRIMARY KEY, number INTEGER NOT NULL UNIQUE, language TEXT NOT NULL, code TEXT NOT NULL,
    started TEXT NOT NULL, finished TEXT
) STRICT;
CREATE TABLE IF NOT EXISTS answers (
    rater TEXT NOT NULL REFERENCES raters, trial TEXT NOT NULL, answers TEXT NOT NULL, seconds REAL NOT NULL,
    plays INTEGER NOT NULL, at TEXT NOT NULL, PRIMARY KEY (rater, trial)
) STRICT;
CREATE TABLE IF NOT EXISTS comments (
    rater TEXT NOT NULL REFERENCES raters, question TEXT NOT NULL, text TEXT NOT NULL, PRIMARY KEY (rater, question)
) STRICT;
"""


class FullError(FaceDiffError):
    """There are as many raters as the study takes."""


class AnswerStore:
    """The answers to a study.

    Every call opens the file anew, so that a store may be used from several threads and processes. Transactions are
    written to disk before a call returns; a writer waits for another one.

    Args:
        read_only: whether nothing is written, not even an empty file.
    """

    def __init__(self, path: Path, study: Study, *, most_raters: int = MOST_RATERS, read_only: bool = False) -> None:
        self.path, self.study, self.most_raters, self.read_only = path, study, most_raters, read_only
        if read_only:
            self._refuse_other(study_of(path))
            return
        with self._open() as database:
            database.execute("PRAGMA journal_mode = WAL")
            database.executescript(SCHEMA)
            database.execute("BEGIN IMMEDIATE")
            studies = [row[0] for row in database.execute("SELECT id FROM study")]
            if database.execute("SELECT 1 FROM raters LIMIT 1").fetchone():
                self._refuse_other(next(iter(studies), None))
            database.execute("DELETE FROM study")
            database.execute("INSERT INTO study VALUES (?)", (study.id,))
            database.execute("COMMIT")

    def _refuse_other(self, stored: str | None) -> None:
        if stored not in (None, self.study.id):
            raise FaceDiffError(f"{self.path}: holds answers to another study, {stored}; move it to another folder")

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        with _opened(self.path, read_only=self.read_only) as database:
            database.execute("PRAGMA foreign_keys = ON")
            database.execute("PRAGMA synchronous = FULL")
            yield database

    @contextmanager
    def _write(self) -> Iterator[sqlite3.Connection]:
        with self._open() as database, database:  # commits, or rolls back after an error
            database.execute("BEGIN IMMEDIATE")  # a lock from the first statement on
            yield database

    def register(self, token: str, language: str, code: str) -> int:
        """The number of a rater, the next free one for a new rater; FullError if the study takes no more."""
        with self._write() as database:
            row = database.execute("SELECT number FROM raters WHERE token = ?", (token,)).fetchone()
            if row is not None:
                return int(row[0])
            number = int(database.execute("SELECT coalesce(max(number) + 1, 0) FROM raters").fetchone()[0])
            if number >= self.most_raters:
                raise FullError(f"the study has its {self.most_raters} raters; thank you all the same")
            database.execute("INSERT INTO raters VALUES (?, ?, ?, ?, ?, NULL)", (token, number, language, code, _now()))
            return number

    def number(self, token: str) -> int | None:
        """The number of a rater; None if the rater is not known."""
        with self._open() as database:
            row = database.execute("SELECT number FROM raters WHERE token = ?", (token,)).fetchone()
            return None if row is None else int(row[0])

    def save(self, token: str, answer: Answer) -> bool:
        """Store a known rater's answers to a trial; False if there were some already, which stay."""
        with self._write() as database:
            cursor = database.execute(
                "INSERT INTO answers VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT DO NOTHING",
                (token, answer.trial, json.dumps(dict(answer.answers)), answer.seconds, answer.plays, answer.at),
            )
            return cursor.rowcount > 0

    def finish(self, token: str, comments: Mapping[str, str]) -> bool:
        """Store a rater's comments, and that the rater has finished; False if answers are missing.

        The first stored answer stays.
        """
        with self._write() as database:
            number = int(database.execute("SELECT number FROM raters WHERE token = ?", (token,)).fetchone()[0])
            answered = {row[0] for row in database.execute("SELECT trial FROM answers WHERE rater = ?", (token,))}
            if not {trial.id for trial in self.study.trials_of(number)} <= answered:
                return False
            for question, text in comments.items():
                database.execute(
                    "INSERT INTO comments VALUES (?, ?, ?) ON CONFLICT DO NOTHING", (token, question, text)
                )
            database.execute("UPDATE raters SET finished = coalesce(finished, ?) WHERE token = ?", (_now(), token))
            return True

    def raters(self) -> list[Rater]:
        """All raters with their answers, by number."""
        with self._open() as database:
            database.execute("BEGIN")  # one moment for all tables
            answers: dict[str, dict[str, Answer]] = {}
            for rater, trial, stored, seconds, plays, at in database.execute(
                "SELECT rater, trial, answers, seconds, plays, at FROM answers ORDER BY at, trial"
            ):
                answers.setdefault(rater, {})[trial] = Answer(trial, parse_json(stored, self.path), seconds, plays, at)
            comments: dict[str, dict[str, str]] = {}
            for rater, question, text in database.execute("SELECT rater, question, text FROM comments"):
                comments.setdefault(rater, {})[question] = text
            rows: list[tuple[str, int, str, str, str, str | None]] = list(
                database.execute("SELECT token, number, language, code, started, finished FROM raters ORDER BY number")
            )
        return [Rater(*row, answers.get(row[0], {}), comments.get(row[0], {})) for row in rows]


def study_of(path: Path) -> str | None:
    """The id of the study of a file of answers; None if it holds none."""
    with _opened(path, read_only=True) as database:
        row = database.execute("SELECT id FROM study").fetchone()
        return None if row is None else str(row[0])


def count_raters(path: Path) -> int:
    """How many raters a file holds."""
    with _opened(path, read_only=True) as database:
        return int(database.execute("SELECT count(*) FROM raters").fetchone()[0])


@contextmanager
def _opened(path: Path, *, read_only: bool) -> Iterator[sqlite3.Connection]:
    """A connection; SQLite's errors become a sentence that names the file."""
    name: str = str(path)
    if read_only:
        # Reading needs a file of locks next to the database, unless it cannot be written.
        still = not os.access(path.parent, os.W_OK) and not path.with_name(f"{path.name}-wal").exists()
        name = f"file:{quote(str(path.absolute()))}?mode=ro{'&immutable=1' if still else ''}"
    try:
        with closing(sqlite3.connect(name, timeout=WAIT, isolation_level=None, uri=read_only)) as database:
            yield database
    except sqlite3.Error as error:
        raise FaceDiffError(
            f"{path}: cannot be used ({error}); expected the answers of `facediff study serve`, in a folder that has "
            f"room and may be written to"
        ) from error


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
