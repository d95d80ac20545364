"""The answers of raters, checked where they enter: from a file or over the network."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from facediff.errors import FaceDiffError
from facediff.study.definition import Language, Study, Trial
from facediff.utils.limits import check_format, quoted
from facediff.utils.plain_files import load_json
from facediff.utils.ranges import Range
from facediff.utils.records import Text, read_record

FORMAT = "facediff answers 1"
MOST_RATERS = 1_000_000
LONGEST_COMMENT = 2000

Token = Annotated[str, Text(r"[0-9a-f]{32}", "32 hexadecimal digits")]
Time = Annotated[
    str, Text(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?(Z|\+00:00)?", "a time such as 2026-05-01T12:00:00Z")
]
Code = Annotated[str, Text(expected="at most 40 characters", longest=40)]
Comments = Mapping[str, Annotated[str, Text(expected=f"at most {LONGEST_COMMENT} characters", longest=LONGEST_COMMENT)]]


@dataclass(frozen=True)
class Answer:
    """A rater's answers to one video."""

    trial: str  # the trial's id
    answers: Mapping[str, str]
    seconds: Annotated[float, Range(0, 1e7)]  # from when the video was shown to when the answers were given
    plays: Annotated[int, Range(0, 1_000_000)]  # how often the video was played
    at: Time  # when, in UTC


@dataclass(frozen=True)
class Rater:
    """A rater and all of their answers."""

    token: str  # a random number
    number: int  # chooses the schedule
    language: str
    code: str  # given by the people who run the study, or empty
    started: str  # when, in UTC
    finished: str | None = None  # when; None if the rater has not finished
    answers: Mapping[str, Answer] = field(default_factory=dict)  # by trial, in the order in which they were given
    comments: Mapping[str, str] = field(default_factory=dict)  # texts by question


@dataclass(frozen=True)
class AnswerFile:
    """The page's file of a rater."""

    rater: Token
    number: Annotated[int, Range(0, 10**9)]
    language: Language
    started: Time
    trials: tuple[Answer, ...]
    code: Code = ""
    finished: Time | None = None
    comments: Comments = field(default_factory=dict)


@dataclass(frozen=True)
class Registration:
    """The page's message when a rater begins."""

    rater: Token
    language: Language
    agreed: Literal[True]
    code: Code = ""


@dataclass(frozen=True)
class RatingsEnd:
    """The page's message when a rater ends."""

    rater: Token
    comments: Comments = field(default_factory=dict)


def read_answers(path: Path, study: Study, ignored: Collection[str] = ()) -> Rater | None:
    """The answers that a rater has downloaded; None if they belong to an ignored study, given by its id."""
    content = load_json(path, remedy="expected a file that the study's page has made")
    if isinstance(content, dict) and content.get("study") in ignored:
        return None
    return check_rater(content, study, path)


def check_rater(content: object, study: Study, source: object) -> Rater:
    """A rater's file as :class:`Rater`; see :func:`read_answers`."""
    check_format(source, content.get("format") if isinstance(content, dict) else None, FORMAT)
    check_study(content, study, source)
    read = read_record(AnswerFile, content, source, strict=False)
    answers: dict[str, Answer] = {}
    for answer in read.trials:
        check_answer(answer, study, read.number, source)
        answers.setdefault(answer.trial, answer)  # the first of repeated answers counts
    end = read.finished if len(answers) >= len(study.trials_of(read.number)) else None
    comments = check_comments(read.comments, study, source)
    return Rater(read.rater, read.number, read.language, clean(read.code), read.started, end, answers, comments)


def check_study(content: object, study: Study, source: object) -> None:
    """Refuse answers to another study."""
    stated = content.get("study") if isinstance(content, dict) else None
    if stated != study.id:
        raise FaceDiffError(f"{source}: study is {quoted(stated)}; expected {study.id}, of which the page was made")


def check_answer(answer: Answer, study: Study, number: int, source: object) -> None:
    """Refuse answers that the study does not ask of a rater of that number."""
    trial = next((trial for trial in study.trials_of(number) if trial.id == answer.trial), None)
    allowed = {} if trial is None else questions_of(study, trial)
    fits = answer.answers.keys() == allowed.keys() and all(answer.answers[name] in allowed[name] for name in allowed)
    if not allowed or not fits:
        questions = "; ".join(f"{name}: {' or '.join(answers)}" for name, answers in allowed.items())
        entry = f"{quoted(answer.trial)} with answers {quoted(dict(answer.answers))}"
        raise FaceDiffError(f"{source}: trial is {entry}; expected {questions or 'a trial of this rater'}")


def questions_of(study: Study, trial: Trial) -> dict[str, Sequence[str]]:
    """The allowed answers to each question about a trial."""
    return {
        question.name: question.answers
        for question in study.choices
        if not question.reference or trial.reference is not None
    }


def check_comments(comments: Mapping[str, str], study: Study, source: object) -> dict[str, str]:
    """Free texts by question; empty ones are left out."""
    fields = {question.name for question in study.questions if question.kind == "text"}
    if not comments.keys() <= fields:
        expected = ", ".join(sorted(fields)) or "none"
        raise FaceDiffError(f"{source}: comments are {quoted(dict(comments))}; expected texts for {expected}")
    return {name: cleaned for name, text in comments.items() if (cleaned := clean(text))}


def clean(text: str) -> str:
    """A text from elsewhere without characters that control a terminal, or that no file can hold."""
    return "".join(
        letter if letter == "\n" or (letter.isprintable() and not "\ud800" <= letter <= "\udfff") else " "
        for letter in text.replace("\r\n", "\n")
    ).strip()


def merge(groups: Iterable[Iterable[Rater]]) -> list[Rater]:
    """Raters of several sources, each once: answers that a later source has in addition are added to the first."""
    raters: dict[str, Rater] = {}
    for rater in (rater for group in groups for rater in group):
        earlier = raters.get(rater.token)
        if earlier is None:
            raters[rater.token] = rater
            continue
        raters[rater.token] = replace(
            earlier,
            answers={**rater.answers, **earlier.answers},
            comments={**rater.comments, **earlier.comments},
            finished=earlier.finished or rater.finished,
        )
    return sorted(raters.values(), key=lambda rater: (rater.started, rater.token))
