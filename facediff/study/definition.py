"""The definition of a study: questions, trials, schedules and the rule of exclusion, as in ``study.json``.

The file is the key of the study: it says which method is on which side, so that raters get the page only.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from facediff.errors import FaceDiffError
from facediff.study.design import TRUTH, Kind
from facediff.utils import ranges
from facediff.utils.limits import check_format
from facediff.utils.plain_files import load_json, parse_json, write_json
from facediff.utils.ranges import Range
from facediff.utils.records import Items, Text, read_record

FORMAT = "facediff study 1"
STUDY_FILE, PAGE_FOLDER, VIDEO_FOLDER, DATABASE = "study.json", "page", "videos", "answers.sqlite"
"""Files and folders of a study."""

Name = Annotated[str, Text(r"[a-z][a-z0-9_]{0,39}", "small letters, digits and underscores")]
Language = Annotated[str, Text(r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})?", "a code such as en")]
Line = Annotated[str, Text()]
Video = Annotated[str, Text(r"[0-9a-f]{16}\.(mp4|webm)", "the name of a video")]
LEFT, RIGHT, SAME = "left", "right", "same"
"""Answers to a question of the kind ``choice``; the last one only where it allows no difference."""

Texts = Mapping[Language, Line]
"""A text by language."""


@dataclass(frozen=True)
class Question:
    """A question to raters.

    Attributes:
        name: its name in answers and tables.
        text: the question, by language.
        kind: ``choice``, left or right, asked of every video; or ``text``, asked once at the end, and optional.
        reference: whether a video of the same speaker's truth, saying something else, is shown with it.
        no_difference: whether a third answer says that there is no difference.
    """

    name: Name
    text: Texts
    kind: Literal["choice", "text"] = "choice"
    reference: bool = False
    no_difference: bool = False

    @property
    def answers(self) -> tuple[str, ...]:
        """The answers to a choice."""
        return (LEFT, SAME, RIGHT) if self.no_difference else (LEFT, RIGHT)


@dataclass(frozen=True)
class Rule:
    """The rule of exclusion of raters; fixed when the study is made.

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


@dataclass(frozen=True)
class Trial:
    """A video that raters are asked about."""

    # Its name in answers, which does not reveal its conditions
    id: Annotated[str, Text(r"[0-9a-f]{16}", "16 hexadecimal digits")]
    kind: Kind  # ``pair``, or a control: ``still``, ``same`` or ``repeat`` (see :class:`facediff.study.design.Showing`)
    clip: Line
    left: Line  # condition on the left
    right: Line  # condition on the right
    video: Video  # name of the video
    reference: Video | None = None  # name of the reference's video; None without one

    def preferred(self, answer: str) -> str | None:
        """The condition that an answer names; None for no difference."""
        return {LEFT: self.left, RIGHT: self.right}.get(answer)


@dataclass(frozen=True)
class Study:
    """A study, as its file states it."""

    title: Texts
    consent: Texts  # text by language
    languages: Annotated[tuple[Language, ...], Items(1)]  # the page's languages; the first is the default
    # The methods; the first is the one that the others are compared with
    methods: Annotated[tuple[Line, ...], Items(1)]
    questions: tuple[Question, ...]  # the questions, in order
    rule: Rule
    trials: tuple[Trial, ...]  # all videos that are asked about
    # For rater after rater, the numbers of the trials in order
    schedules: tuple[tuple[Annotated[int, Range(0)], ...], ...]
    seed: ranges.Seed = 0  # of the design
    remark: Line = ""  # stands below every video, such as that the corpus is synthetic
    details: Mapping[str, Any] = field(default_factory=dict)  # options and files
    version: Line = ""

    @cached_property
    def id(self) -> str:
        """Hash of everything that raters see and answer, so that answers to another study are noticed."""
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
        """The trials of a rater, numbered from 0, in order."""
        return [self.trials[index] for index in self.schedules[rater % len(self.schedules)]]

    def videos(self) -> list[str]:
        """Names of all videos."""
        return sorted({name for trial in self.trials for name in (trial.video, trial.reference) if name})

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
    content = load_json(path, remedy=remedy)
    check_format(path, content.get("format") if isinstance(content, dict) else None, FORMAT)
    study = read_record(Study, content, path, remedy=remedy, strict=False)
    last = len(study.trials) - 1
    problem = ""
    if content.get("id") != study.id:
        problem = "was changed after the study was made, and answers may not belong to it; make the study again"
    if not study.choices or not study.schedules or not all(row and max(row) <= last for row in study.schedules):
        problem = f"has no choice, or lacks trials of its schedules; {remedy}"
    if problem:
        raise FaceDiffError(f"{path}: {problem}")
    return study
