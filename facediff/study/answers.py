"""What raters answer: checked before anything is done with it, whether it comes from a file or over the network."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError
from facediff.study.definition import LANGUAGE, Study, Trial
from facediff.utils.limits import check_format, check_number, quoted
from facediff.utils.plain_files import parse_json

FORMAT = "facediff answers 1"
TOKEN = re.compile(r"[0-9a-f]{32}")
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,6})?(Z|\+00:00)?")
MOST_RATERS = 1_000_000
LONGEST_COMMENT = 2000
LONGEST_CODE = 40
LARGEST_FILE = 2**20
"""Bytes of a file of one rater's answers."""


@dataclass(frozen=True)
class Answer:
    """A rater's answers to one video.

    Attributes:
        trial: the trial's id.
        answers: the answer to each question: ``left``, ``right`` or ``same``.
        seconds: from when the video was shown to when the answers were given.
        plays: how often the video was played.
        at: when, in UTC.
    """

    trial: str
    answers: Mapping[str, str]
    seconds: float
    plays: int
    at: str


@dataclass(frozen=True)
class Rater:
    """A rater and all of their answers.

    Attributes:
        token: a random number.
        number: chooses the schedule.
        language: of the page.
        code: given by the people who run the study, or empty.
        started: when, in UTC.
        finished: when; None if the rater has not finished.
        answers: by trial, in the order in which they were given.
        comments: texts by question.
    """

    token: str
    number: int
    language: str
    code: str
    started: str
    finished: str | None = None
    answers: Mapping[str, Answer] = field(default_factory=dict)
    comments: Mapping[str, str] = field(default_factory=dict)


def read_answers(path: Path, study: Study, others: Collection[str] = ()) -> Rater | None:
    """The answers that a rater has downloaded; None if they belong to one of ``others``, ids of other studies."""
    remedy = "expected a file that the study's page has made"
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise FaceDiffError(f"{path}: has {size} bytes, more than {LARGEST_FILE}; {remedy}")
        if not path.is_file():
            raise FaceDiffError(f"{path}: is no regular file; {remedy}")
        content = parse_json(path.read_bytes(), path, remedy=remedy)
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror or error}); {remedy}") from error
    if isinstance(content, dict) and content.get("study") in others:
        return None
    return check_rater(content, study, path)


def check_rater(content: object, study: Study, source: object) -> Rater:
    """A rater's file as :class:`Rater`; see :func:`read_answers`."""
    if not isinstance(content, dict):
        raise FaceDiffError(f"{source}: holds no object; expected a file that the study's page has made")
    check_format(source, content.get("format"), FORMAT)
    check_study(content, study, source)
    number = int(check_number(source, "number", content.get("number"), 0, 10**9, whole=True))
    rater = Rater(
        token=check_token(content, source),
        number=number,
        language=check_language(content, source),
        code=clean(content.get("code", ""), "code", source, LONGEST_CODE),
        started=_time(content.get("started"), "started", source),
        finished=None if content.get("finished") is None else _time(content["finished"], "finished", source),
        comments=check_comments(content.get("comments", {}), study, source),
    )
    trials = content.get("trials")
    if not isinstance(trials, list) or len(trials) > len(study.trials):
        raise FaceDiffError(f"{source}: trials are {quoted(trials)}; expected a list of at most {len(study.trials)}")
    answers: dict[str, Answer] = {}
    for entry in trials:
        answer = check_answer(entry, study, number, source)
        answers.setdefault(answer.trial, answer)  # what was submitted twice counts once, as first given
    if rater.finished is not None and len(answers) < len(study.trials_of(number)):
        rater = replace(rater, finished=None)
    return replace(rater, answers=answers)


def check_study(content: Mapping[str, Any], study: Study, source: object) -> None:
    """Refuse answers to another study."""
    if content.get("study") != study.id:
        raise FaceDiffError(
            f"{source}: study is {quoted(content.get('study'))}; expected {study.id}, of which the page was made"
        )


def check_token(content: Mapping[str, Any], source: object) -> str:
    """The rater's token."""
    token = content.get("rater")
    if not isinstance(token, str) or not TOKEN.fullmatch(token):
        raise FaceDiffError(f"{source}: rater is {quoted(token)}; expected 32 hexadecimal digits")
    return token


def check_language(content: Mapping[str, Any], source: object) -> str:
    """The language of the page."""
    language = content.get("language")
    if not isinstance(language, str) or not LANGUAGE.fullmatch(language):
        raise FaceDiffError(f"{source}: language is {quoted(language)}; expected a code such as en")
    return language


def check_answer(content: object, study: Study, number: int, source: object) -> Answer:
    """One video's answers.

    Args:
        content: plain data from elsewhere.
        study: what was asked.
        number: of the rater, whose schedule must hold the trial.
        source: for messages.
    """
    if not isinstance(content, dict):
        raise FaceDiffError(f"{source}: an answer is {quoted(content)}; expected an object")
    name = content.get("trial")
    trial = study.by_id.get(name) if isinstance(name, str) else None
    if trial is None or all(shown.id != trial.id for shown in study.trials_of(number)):
        raise FaceDiffError(f"{source}: trial is {quoted(name)}; expected one that this rater is asked about")
    answers = content.get("answers")
    asked = asked_of(study, trial)
    if not isinstance(answers, dict) or set(answers) != set(asked):
        raise FaceDiffError(f"{source}: answers are {quoted(answers)}; expected one each to {', '.join(asked)}")
    for question, answer in answers.items():
        if answer not in asked[question]:
            raise FaceDiffError(
                f"{source}: the answer to {question} is {quoted(answer)}; expected {' or '.join(asked[question])}"
            )
    return Answer(
        trial.id,
        {question: str(answers[question]) for question in asked},
        check_number(source, "seconds", content.get("seconds"), 0, 1e7),
        int(check_number(source, "plays", content.get("plays"), 0, 1e6, whole=True)),
        _time(content.get("at"), "at", source),
    )


def asked_of(study: Study, trial: Trial) -> dict[str, Sequence[str]]:
    """The answers to each question that is asked of a trial."""
    return {
        question.name: question.answers
        for question in study.choices
        if not question.reference or trial.reference is not None
    }


def check_comments(content: object, study: Study, source: object) -> dict[str, str]:
    """Free texts by question; empty ones are left out."""
    fields = [question.name for question in study.questions if question.kind == "text"]
    if not isinstance(content, dict) or not set(content) <= set(fields):
        raise FaceDiffError(
            f"{source}: comments are {quoted(content)}; expected texts for {', '.join(fields) or 'none'}"
        )
    texts = {name: clean(text, f"comments.{name}", source, LONGEST_COMMENT) for name, text in content.items()}
    return {name: text for name, text in texts.items() if text}


def clean(text: object, name: str, source: object, longest: int) -> str:
    """A text from elsewhere without characters that control a terminal, or that no file can hold."""
    if not isinstance(text, str) or len(text) > longest:
        what = quoted(text) if not isinstance(text, str) else f"{len(text)} characters long"
        raise FaceDiffError(f"{source}: {name} is {what}; expected a text of at most {longest} characters")
    return "".join(
        letter if letter == "\n" or (letter.isprintable() and not "\ud800" <= letter <= "\udfff") else " "
        for letter in text.replace("\r\n", "\n")
    ).strip()


def _time(text: object, name: str, source: object) -> str:
    if not isinstance(text, str) or not TIME.fullmatch(text):
        raise FaceDiffError(f"{source}: {name} is {quoted(text)}; expected a time such as 2026-05-01T12:00:00Z")
    return text


def merge(groups: Iterable[Iterable[Rater]]) -> list[Rater]:
    """Raters of several sources, each once: what one source has of a rater in addition is added to the first."""
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
