"""What a study is: its questions, trials, schedules and its rule of exclusion, as ``study.json`` states them.

The file is the key of the study: it says which method is on which side, so that raters get the page only.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, get_args

from facediff.errors import FaceDiffError, choices
from facediff.study.design import TRUTH, Kind
from facediff.utils import ranges
from facediff.utils.limits import check_format, check_number, quoted
from facediff.utils.plain_files import load_json, parse_json, write_json
from facediff.utils.ranges import Range

FORMAT = "facediff study 1"
STUDY_FILE, PAGE_FOLDER, VIDEO_FOLDER, DATABASE = "study.json", "page", "videos", "answers.sqlite"
"""What is in the folder of a study."""

NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
TOKEN = re.compile(r"[0-9a-f]{16}")
LANGUAGE = re.compile(r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})?")
LONGEST_TEXT = 20_000
LEFT, RIGHT, SAME = "left", "right", "same"
"""Answers to a question of the kind ``choice``; the last one only where it allows no difference."""

Texts = Mapping[str, str]
"""A text by language."""


@dataclass(frozen=True)
class Question:
    """What a rater is asked.

    Attributes:
        name: its name in answers and tables.
        text: the question, by language.
        kind: ``choice``, left or right, asked of every video; or ``text``, asked once at the end, and optional.
        reference: whether a video of the same speaker's truth, saying something else, is shown with it.
        no_difference: whether a third answer says that there is no difference.
    """

    name: str
    text: Texts
    kind: str = "choice"
    reference: bool = False
    no_difference: bool = False

    @property
    def answers(self) -> tuple[str, ...]:
        """The answers to a choice."""
        return (LEFT, SAME, RIGHT) if self.no_difference else (LEFT, RIGHT)


@dataclass(frozen=True)
class Rule:
    """Whose answers are not counted; fixed when the study is made.

    Attributes:
        least_right: share of the answers to controls of the truth against a still face that name the truth.
        least_consistent: share of the answers to repeated pairs that name the same method both times.
        most_on_one_side: share of all answers that name the same side.
        finished: whether only raters count who answered everything.
    """

    least_right: Annotated[float, Range(0, 1)] = 0.8
    least_consistent: Annotated[float, Range(0, 1)] = 0.0
    most_on_one_side: Annotated[float, Range(0.5, 1)] = 0.9
    finished: bool = True

    def __post_init__(self) -> None:
        ranges.check_fields(self)


@dataclass(frozen=True)
class Trial:
    """A video that raters are asked about.

    Attributes:
        id: its name in answers, which says nothing about what it shows.
        kind: ``pair``, or a control: ``still``, ``same`` or ``repeat`` (see :class:`facediff.study.design.Showing`).
        clip: the clip's name.
        left: condition on the left.
        right: condition on the right.
        video: name of the video.
        reference: name of the reference's video; None without one.
    """

    id: str
    kind: Kind
    clip: str
    left: str
    right: str
    video: str
    reference: str | None = None

    def chosen(self, answer: str) -> str | None:
        """The condition that an answer names; None for no difference."""
        return {LEFT: self.left, RIGHT: self.right}.get(answer)


@dataclass(frozen=True)
class Study:
    """A study, as its file states it.

    Attributes:
        title: shown above everything, by language.
        consent: what raters agree to, by language.
        languages: the page's languages; the first is the default.
        methods: the methods; the first is the one that the others are compared with.
        questions: what is asked, in order.
        rule: whose answers are not counted.
        trials: all videos that are asked about.
        schedules: for rater after rater, the numbers of the trials in order.
        seed: of the design.
        remark: stands below every video, such as that the corpus is synthetic.
        details: what else is known: options and files.
        version: of facediff.
    """

    title: Texts
    consent: Texts
    languages: tuple[str, ...]
    methods: tuple[str, ...]
    questions: tuple[Question, ...]
    rule: Rule
    trials: tuple[Trial, ...]
    schedules: tuple[tuple[int, ...], ...]
    seed: int = 0
    remark: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)
    version: str = ""

    @cached_property
    def id(self) -> str:
        """Follows from all that raters see and answer, so that answers to another study are noticed."""
        content = self.as_dict() | {"details": {}, "version": ""}
        text = json.dumps(content, sort_keys=True, ensure_ascii=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def by_id(self) -> dict[str, Trial]:
        """Trials by id."""
        return {trial.id: trial for trial in self.trials}

    @property
    def conditions(self) -> list[str]:
        """The methods, and the truth if it is compared."""
        compared = {name for trial in self.trials if trial.kind == "pair" for name in (trial.left, trial.right)}
        return [*self.methods, *([TRUTH] if TRUTH in compared else [])]

    @property
    def choices(self) -> list[Question]:
        """The questions that are asked of every video."""
        return [question for question in self.questions if question.kind == "choice"]

    def trials_of(self, rater: int) -> list[Trial]:
        """What a rater sees, in order.

        Args:
            rater: the rater's number, from 0.
        """
        return [self.trials[index] for index in self.schedules[rater % len(self.schedules)]]

    def videos(self) -> list[str]:
        """Names of all videos."""
        named = [name for trial in self.trials for name in (trial.video, trial.reference) if name]
        return sorted(set(named))

    def as_dict(self) -> dict[str, Any]:
        """The content of the file, without the id."""
        content: dict[str, Any] = parse_json(json.dumps(asdict(self)), STUDY_FILE)
        return content

    def write(self, folder: Path) -> None:
        """Write ``study.json``, whole or not at all."""
        write_json(folder / STUDY_FILE, {"format": FORMAT, "id": self.id, **self.as_dict()})


def read_study(folder: Path) -> Study:
    """Read the study of a folder that ``facediff study make`` has finished."""
    path = folder / STUDY_FILE
    remedy = "expected a folder that `facediff study make` has finished"
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; {remedy}")
    content = load_json(path, remedy=remedy)
    if not isinstance(content, dict):
        raise FaceDiffError(f"{path}: holds no object; {remedy}")
    check_format(path, content.get("format"), FORMAT)
    read = _Reader(path)
    questions = [
        Question(
            read.text(entry, "name", NAME),
            read.texts(entry.get("text"), "text"),
            read.one_of(entry, "kind", ("choice", "text")),
            entry.get("reference") is True,
            entry.get("no_difference") is True,
        )
        for entry in read.objects(content, "questions")
    ]
    trials = [
        Trial(
            read.text(entry, "id", TOKEN),
            read.one_of(entry, "kind", get_args(Kind)),  # type: ignore[arg-type]
            read.text(entry, "clip"),
            read.text(entry, "left"),
            read.text(entry, "right"),
            read.video(entry, "video"),
            None if entry.get("reference") is None else read.video(entry, "reference"),
        )
        for entry in read.objects(content, "trials")
    ]
    schedules = content.get("schedules")
    if not isinstance(schedules, list) or not all(isinstance(row, list) and row for row in schedules) or not schedules:
        raise FaceDiffError(f"{path}: schedules are no lists of numbers of trials; {remedy}")
    rows = [
        tuple(
            int(check_number(path, "schedules", number, 0, len(trials) - 1, whole=True, remedy=remedy))
            for number in row
        )
        for row in schedules
    ]
    if len({trial.id for trial in trials}) < len(trials) or len({question.name for question in questions}) < len(
        questions
    ):
        raise FaceDiffError(f"{path}: names a trial or a question twice; {remedy}")
    if not any(question.kind == "choice" for question in questions):
        raise FaceDiffError(f"{path}: questions ask for no choice; {remedy}")
    study = Study(
        title=read.texts(content.get("title"), "title"),
        consent=read.texts(content.get("consent"), "consent"),
        languages=tuple(read.names(content, "languages", LANGUAGE)),
        methods=tuple(read.names(content, "methods")),
        questions=tuple(questions),
        rule=make_rule(content.get("rule"), path),
        trials=tuple(trials),
        schedules=tuple(rows),
        seed=int(check_number(path, "seed", content.get("seed"), 0, 2**62, whole=True, remedy=remedy)),
        remark=read.text(content, "remark"),
        details=content["details"] if isinstance(content.get("details"), dict) else {},
        version=read.text(content, "version"),
    )
    if content.get("id") != study.id:
        raise FaceDiffError(
            f"{path}: has been changed since the study was made, so that answers may not belong to it; make the "
            f"study again in a new folder"
        )
    return study


def make_rule(content: object, source: object) -> Rule:
    """The rule that a file states; fields that it omits have their defaults."""
    if content is None:
        return Rule()
    if not isinstance(content, dict):
        raise FaceDiffError(f"{source}: rule is {quoted(content)}; expected fields such as least_right: 0.8")
    defaults = asdict(Rule())
    values: dict[str, Any] = {}
    for name, value in content.items():
        if name not in defaults:
            raise FaceDiffError(f'{source}: rule has no field "{name}": {choices(str(name), defaults)}')
        if name == "finished":
            if not isinstance(value, bool):
                raise FaceDiffError(f"{source}: rule.finished is {quoted(value)}; expected true or false")
            values[name] = value
        else:
            low = 0.5 if name == "most_on_one_side" else 0.0
            values[name] = check_number(source, f"rule.{name}", value, low, 1.0)
    return replace(Rule(), **values)


class _Reader:
    """Reads the fields of a study's file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def refuse(self, name: str, value: object, expected: str) -> FaceDiffError:
        return FaceDiffError(f"{self.path}: {name} is {quoted(value)}; expected {expected}; make the study again")

    def objects(self, content: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
        value = content.get(name)
        if not isinstance(value, list) or not value or not all(isinstance(entry, dict) for entry in value):
            raise self.refuse(name, value, "a list of objects")
        return value

    def text(self, content: Mapping[str, Any], name: str, pattern: re.Pattern[str] | None = None) -> str:
        value = content.get(name)
        if not isinstance(value, str) or len(value) > LONGEST_TEXT or (pattern and not pattern.fullmatch(value)):
            raise self.refuse(name, value, "a text" if pattern is None else f"a text like {pattern.pattern}")
        return value

    def video(self, content: Mapping[str, Any], name: str) -> str:
        return self.text(content, name, re.compile(r"[0-9a-f]{16}\.(mp4|webm)"))

    def one_of(self, content: Mapping[str, Any], name: str, allowed: Sequence[str]) -> str:
        value = content.get(name)
        if value not in allowed:
            raise self.refuse(name, value, f"one of {', '.join(allowed)}")
        return str(value)

    def names(self, content: Mapping[str, Any], name: str, pattern: re.Pattern[str] | None = None) -> list[str]:
        value = content.get(name)
        if not isinstance(value, list) or not value:
            raise self.refuse(name, value, "a list of names")
        return [self.text({name: entry}, name, pattern) for entry in value]

    def texts(self, value: object, name: str) -> dict[str, str]:
        if not isinstance(value, dict) or not value:
            raise self.refuse(name, value, "a text by language")
        for language in value:
            if not LANGUAGE.fullmatch(language):
                raise self.refuse(name, language, "codes of languages")
        return {language: self.text(value, language) for language in value}
