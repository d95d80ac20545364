"""Analysis of a study's answers: excluded raters, and preferences with intervals."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError
from facediff.reporting.statistics import binomial_p, holm, share_between_raters, wilson_interval
from facediff.study.answers import Rater, merge, read_answers
from facediff.study.definition import DATABASE, LEFT, RIGHT, Study, Trial, read_study
from facediff.study.design import TRUTH
from facediff.study.store import AnswerStore
from facediff.utils import ranges


@dataclass(frozen=True)
class Checks:
    """A rater's results in the controls; a share is None without such answers."""

    rater: str  # token
    answered: int  # videos
    right: float | None  # share of the answers to the truth against a still face that name the truth
    consistent: float | None  # share of the answers to repeated pairs that name the same condition as before
    one_side: float | None  # share of all answers that name the side that is named more often
    reasons: tuple[str, ...]  # why the rater is not counted


@dataclass(frozen=True)
class Preference:
    """How often a condition was preferred to another one."""

    question: str
    first: str
    second: str
    wins: int  # answers that name the first
    losses: int
    same: int  # answers of no difference; half of them count for each
    share: float  # of the first, from 0 to 1
    interval: tuple[float, float]  # of single answers (Wilson)
    between_raters: tuple[float, float]  # of raters that are drawn again; wider where answers of one rater are alike
    p: float  # of the exact binomial test against one half; answers without difference do not count
    p_corrected: float  # by Holm, for all comparisons of the question

    @property
    def answers(self) -> int:
        """All answers."""
        return self.wins + self.losses + self.same


@dataclass(frozen=True)
class StudyReport:
    """The results of a study."""

    name: str  # the title of its column in tables
    study: Study
    raters: tuple[Rater, ...]
    checks: tuple[Checks, ...]
    preferences: tuple[Preference, ...]
    # By question: share of answers ``left`` in controls of one animation twice, its interval, and their number.
    sides: dict[str, tuple[float, tuple[float, float], int]]
    level: float  # of all intervals
    notes: tuple[str, ...] = ()  # on files that were set aside

    @property
    def counted(self) -> list[Rater]:
        """The raters that count."""
        tokens = {check.rater for check in self.checks if not check.reasons}
        return [rater for rater in self.raters if rater.token in tokens]

    def preference(self, question: str, first: str, second: str) -> Preference | None:
        """The preference of one pair."""
        key = (question, first, second)
        return next((p for p in self.preferences if (p.question, p.first, p.second) == key), None)

    def as_dict(self) -> dict[str, Any]:
        """Everything but the raters, as plain data; intervals that are not known become None."""
        return {
            "study": self.study.id,
            "name": self.name,
            "raters": len(self.raters),
            "counted": len(self.counted),
            "rule": asdict(self.study.rule),
            "level": self.level,
            "checks": [asdict(check) for check in self.checks],
            "preferences": [
                asdict(each)
                | {"answers": each.answers}
                | {"between_raters": [end if math.isfinite(end) else None for end in each.between_raters]}
                for each in self.preferences
            ],
            "sides": {
                question: {"left": share, "interval": interval, "answers": count}
                for question, (share, interval, count) in self.sides.items()
            },
            "notes": self.notes,
        }


def gather_raters(
    folder: Path, study: Study, files: Sequence[Path] = (), ignored: Collection[str] = ()
) -> tuple[list[Rater], list[str]]:
    """All raters of a study, each once, from the server and from downloads; and notes on files that are set aside."""
    stored = AnswerStore(folder / DATABASE, study, read_only=True).raters() if (folder / DATABASE).is_file() else []
    downloaded: list[Rater] = []
    notes: list[str] = []
    for path in answer_files(files):
        try:
            rater = read_answers(path, study, ignored)
        except FaceDiffError as error:
            notes.append(f"set aside: {error}")
            continue
        downloaded += [] if rater is None else [rater]
    return merge([stored, downloaded]), notes


def answer_files(paths: Sequence[Path]) -> list[Path]:
    """Files, and the .json files of folders, each once."""
    files: dict[Path, Path] = {}
    for path in paths:
        inside = sorted(path.glob("*.json")) if path.is_dir() else [path] if path.exists() else []
        if not inside:
            raise FaceDiffError(f"--answers {path}: no .json file; expected answers that raters have downloaded")
        files |= {file.resolve(): file for file in inside if file.resolve() not in files}
    return list(files.values())


def check_rater(rater: Rater, study: Study) -> Checks:
    """A rater's results in the controls, and the reasons to exclude them by the study's rule."""
    rule = study.rule
    first: dict[tuple[str, frozenset[str], str], str | None] = {}
    again: dict[tuple[str, frozenset[str], str], str | None] = {}
    right: list[bool] = []
    sides: Counter[str] = Counter()
    for trial, question, answer in answers_of(rater, study.by_id):
        sides[answer] += 1
        unit = (trial.clip, frozenset((trial.left, trial.right)), question)
        if trial.kind == "still":
            right.append(trial.preferred(answer) == TRUTH)
        elif trial.kind == "pair":
            first[unit] = trial.preferred(answer)
        elif trial.kind == "repeat":
            again[unit] = trial.preferred(answer)
    share_right = _share(right)
    share_consistent = _share([first[unit] == condition for unit, condition in again.items() if unit in first])
    choices = sides[LEFT] + sides[RIGHT]
    one_side = max(sides[LEFT], sides[RIGHT]) / choices if choices else None
    reasons = ["has not finished"] if rule.finished and rater.finished is None else []
    if share_right is not None and share_right < rule.least_right:
        reasons.append(f"named the truth in {share_right:.0%} of the controls, less than {rule.least_right:.0%}")
    if share_consistent is not None and share_consistent < rule.least_consistent:
        reasons.append(
            f"answered repeated pairs alike in {share_consistent:.0%}, less than {rule.least_consistent:.0%}"
        )
    if one_side is not None and one_side > rule.most_on_one_side:
        reasons.append(f"named one side in {one_side:.0%} of all answers, more than {rule.most_on_one_side:.0%}")
    return Checks(rater.token, len(rater.answers), share_right, share_consistent, one_side, tuple(reasons))


def _share(values: Sequence[bool]) -> float | None:
    return sum(values) / len(values) if values else None


def answers_of(rater: Rater, trials: dict[str, Trial]) -> list[tuple[Trial, str, str]]:
    """Trial, question and answer, for every answer of a rater to a trial that the study has."""
    return [
        (trials[answer.trial], question, choice)
        for answer in rater.answers.values()
        if answer.trial in trials
        for question, choice in answer.answers.items()
    ]


@ranges.checked
def analyse(
    study: Study,
    raters: Sequence[Rater],
    *,
    name: str = "study",
    level: ranges.Level = 0.95,
    resamples: ranges.Resamples = 1000,
    seed: ranges.Seed = 0,
    notes: Sequence[str] = (),
) -> StudyReport:
    """Analyse the answers to a study."""
    checks = tuple(check_rater(rater, study) for rater in raters)
    included = [rater for rater, check in zip(raters, checks, strict=True) if not check.reasons]
    preferences: list[Preference] = []
    sides: dict[str, tuple[float, tuple[float, float], int]] = {}
    for question in study.choices:
        preferences += preferences_of(question.name, study, included, level, resamples=resamples, seed=seed)
        answers = [
            answer
            for rater in included
            for trial, name_of_question, answer in answers_of(rater, study.by_id)
            if (trial.kind, name_of_question) == ("same", question.name) and answer in (LEFT, RIGHT)
        ]
        if count := len(answers):
            left = answers.count(LEFT)
            sides[question.name] = left / count, wilson_interval(left, count, level), count
    return StudyReport(name, study, tuple(raters), checks, tuple(preferences), sides, level, tuple(notes))


def preferences_of(
    question: str, study: Study, raters: Sequence[Rater], level: float, *, resamples: int, seed: int
) -> list[Preference]:
    """The preferences of one question, without controls and repeated pairs, in the order of the conditions."""
    order = study.conditions
    # Of each pair, answers (raters, 3) that name the first, the second, or neither.
    tables = {pair: np.zeros((len(raters), 3)) for pair in combinations(order, 2)}
    for row, rater in enumerate(raters):
        for trial, name, answer in answers_of(rater, study.by_id):
            if (trial.kind, name) == ("pair", question):
                first, second = sorted((trial.left, trial.right), key=order.index)
                column = (first, second, None).index(trial.preferred(answer))
                tables[first, second][row, column] += 1
    preferences = []
    for pair, table in tables.items():
        wins, losses, same = map(int, table.sum(0))
        if count := wins + losses + same:
            better = table[:, 0] + table[:, 2] / 2
            preferred = wins + same / 2
            between = share_between_raters(better, table.sum(1), level, resamples=resamples, seed=seed)
            interval, p = wilson_interval(preferred, count, level), binomial_p(wins, wins + losses)
            share = preferred / count
            preferences.append(
                Preference(question, *pair, wins, losses, same, share, interval, between, p, p_corrected=1.0)
            )
    corrected = holm([preference.p for preference in preferences])
    return [replace(preference, p_corrected=p) for preference, p in zip(preferences, corrected, strict=True)]


def analyse_folder(
    folder: Path,
    files: Sequence[Path] = (),
    *,
    name: str | None = None,
    ignored: Collection[str] = (),
    **options: Any,  # noqa: ANN401 - passed on
) -> StudyReport:
    """Analyse the study of a folder: answers of its server, and files that raters have downloaded.

    Files of studies with ``ignored`` ids are passed over; ``name`` is the data set's in tables, else the folder's.
    """
    study = read_study(folder)
    raters, notes = gather_raters(folder, study, files, ignored)
    if not any(rater.answers for rater in raters):
        more = f" ({notes[0]})" if notes else ""
        raise FaceDiffError(
            f"{folder}: has no answers{more}; let raters answer with `facediff study serve`, or give the files that "
            f"they have downloaded with --answers"
        )
    return analyse(study, raters, name=name or folder.resolve().name, notes=notes, **options)
