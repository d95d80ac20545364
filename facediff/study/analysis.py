"""Analysis of a study's answers: excluded raters, preferences with intervals, and agreement."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np

from facediff.errors import FaceDiffError
from facediff.reporting.statistics import (
    Array,
    binomial_interval,
    binomial_p,
    holm,
    share_between_raters,
    wilson_interval,
)
from facediff.study.answers import Rater, merge, read_answers
from facediff.study.definition import DATABASE, LEFT, RIGHT, Study, Trial, read_study
from facediff.study.design import TRUTH
from facediff.study.rating_statistics import alpha_interval, bradley_terry, is_connected, krippendorff_alpha
from facediff.study.store import AnswerStore
from facediff.utils import ranges

Interval = Literal["wilson", "binomial"]


@dataclass(frozen=True)
class Checks:
    """A rater's results in the controls.

    Attributes:
        rater: the rater's token.
        answered: videos that the rater has answered.
        right: share of the answers to the truth against a still face that name the truth; None without any.
        consistent: share of the answers to repeated pairs that name the same condition as before; None without any.
        one_side: share of all answers that name the side that is named more often; None without any.
        reasons: why the rater is not counted; none if the rater is.
    """

    rater: str
    answered: int
    right: float | None
    consistent: float | None
    one_side: float | None
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Preference:
    """How often a condition was preferred to another one.

    Attributes:
        question: its name.
        first: the condition with this share.
        second: the other condition.
        wins: answers that name the first.
        losses: answers that name the second.
        same: answers of no difference; half of them count for each.
        share: of the first, from 0 to 1.
        interval: of single answers, Wilson's or the exact binomial one.
        between_raters: of raters that are drawn again; wider where answers of one rater are alike.
        p: of the exact binomial test against one half; answers without difference do not count.
        p_corrected: by Holm, for all comparisons of the question.
    """

    question: str
    first: str
    second: str
    wins: int
    losses: int
    same: int
    share: float
    interval: tuple[float, float]
    between_raters: tuple[float, float]
    p: float
    p_corrected: float

    @property
    def answers(self) -> int:
        """All answers."""
        return self.wins + self.losses + self.same


@dataclass(frozen=True)
class StrengthScores:
    """Bradley-Terry scores of one question.

    Attributes:
        question: name.
        scores: by condition, natural logarithms of strength, with mean 0.
        intervals: by condition.
        robust: whether the intervals take raters, not single answers, as independent.
        bounded: False if a condition always won or lost, and half a win was added to each side of every pair.
    """

    question: str
    scores: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    robust: bool
    bounded: bool


@dataclass(frozen=True)
class Agreement:
    """Krippendorff's alpha of one question.

    Attributes:
        question: name.
        alpha: 1 if all raters agree, 0 if they do not more than by chance.
        interval: over the videos, drawn again.
        units: videos that at least two raters judged.
    """

    question: str
    alpha: float
    interval: tuple[float, float]
    units: int


@dataclass(frozen=True)
class StudyReport:
    """The results of a study.

    Attributes:
        name: of the data set or the study, the title of its column in tables.
        study: its definition.
        raters: all raters.
        checks: their results in the controls.
        preferences: by question and pair.
        scores: by question; none where conditions cannot be put on one scale.
        agreement: by question.
        sides: by question, the share of answers ``left`` in controls of the same animation twice, with its interval.
        level: of all intervals.
        notes: on files that were set aside.
    """

    name: str
    study: Study
    raters: tuple[Rater, ...]
    checks: tuple[Checks, ...]
    preferences: tuple[Preference, ...]
    scores: tuple[StrengthScores, ...]
    agreement: tuple[Agreement, ...]
    sides: dict[str, tuple[float, tuple[float, float], int]]
    level: float
    interval: Interval
    notes: tuple[str, ...] = ()

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
        """Everything but the raters, as plain data; numbers that are not finite become None."""
        content = {
            "study": self.study.id,
            "name": self.name,
            "raters": len(self.raters),
            "counted": len(self.counted),
            "rule": asdict(self.study.rule),
            "level": self.level,
            "interval": self.interval,
            "checks": [asdict(check) for check in self.checks],
            "preferences": [asdict(preference) | {"answers": preference.answers} for preference in self.preferences],
            "bradley_terry": [asdict(scores) for scores in self.scores],
            "agreement": [asdict(agreement) for agreement in self.agreement],
            "sides": {
                question: {"left": share, "interval": interval, "answers": count}
                for question, (share, interval, count) in self.sides.items()
            },
            "notes": self.notes,
        }
        finite: dict[str, Any] = _finite(content)
        return finite


def _finite(value: Any) -> Any:  # noqa: ANN401 - plain data
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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


@dataclass(frozen=True)
class Answers:
    """The counted answers to one question.

    Attributes:
        wins: (R, K, K): how often rater r preferred condition i to j.
        ties: (R, K, K): how often rater r saw no difference between i and j, where i is before j.
        judged: the judgements of each clip with a pair, on either side, by at least two raters.
        left: answers to the same animation on both sides that name the left.
        same: all answers to these that name a side.
    """

    wins: Array
    ties: Array
    judged: list[list[str]]
    left: int
    same: int


def answers_to(question: str, study: Study, raters: Sequence[Rater]) -> Answers:
    """Count the answers to a question; controls and repeated pairs are no part of preferences."""
    index = {condition: i for i, condition in enumerate(study.conditions)}
    shape = (len(raters), len(index), len(index))
    wins, ties = np.zeros(shape), np.zeros(shape)
    units: dict[tuple[str, int, int], list[str]] = {}
    sides: Counter[str] = Counter()
    for row, rater in enumerate(raters):
        for trial, name, answer in answers_of(rater, study.by_id):
            if name != question:
                continue
            if trial.kind == "same":
                sides[answer] += 1
            if trial.kind == "pair":
                winner = trial.preferred(answer)
                i, j = sorted((index[trial.left], index[trial.right]))
                if winner is None:
                    ties[row, i, j] += 1
                else:
                    wins[row, index[winner], i + j - index[winner]] += 1
                judgement = "same" if winner is None else "first" if index[winner] == i else "second"
                units.setdefault((trial.clip, i, j), []).append(judgement)
    judged = [unit for unit in units.values() if len(unit) > 1]
    return Answers(wins, ties, judged, sides[LEFT], sides[LEFT] + sides[RIGHT])


@ranges.checked
def analyse(
    study: Study,
    raters: Sequence[Rater],
    *,
    name: str = "study",
    level: ranges.Level = 0.95,
    interval: Interval = "wilson",
    resamples: ranges.Resamples = 1000,
    seed: ranges.Seed = 0,
    notes: Sequence[str] = (),
) -> StudyReport:
    """Analyse the answers to a study.

    Args:
        study: its definition.
        raters: all raters.
        name: of the data set, for tables.
        level: of all intervals.
        interval: of shares of single answers.
        resamples: for intervals between raters and of alpha.
        seed: of the resamples.
        notes: on files that were set aside.
    """
    checks = tuple(check_rater(rater, study) for rater in raters)
    included = [rater for rater, check in zip(raters, checks, strict=True) if not check.reasons]
    answers = {question.name: answers_to(question.name, study, included) for question in study.choices}
    conditions, options = study.conditions, {"resamples": resamples, "seed": seed}
    return StudyReport(
        name,
        study,
        tuple(raters),
        checks,
        tuple(
            preference
            for question, counts in answers.items()
            for preference in _preferences(question, conditions, counts, level, interval, **options)
        ),
        tuple(
            scores for question, counts in answers.items() for scores in _strengths(question, conditions, counts, level)
        ),
        tuple(
            Agreement(
                question,
                krippendorff_alpha(counts.judged),
                alpha_interval(counts.judged, level, **options),
                len(counts.judged),
            )
            for question, counts in answers.items()
        ),
        {
            question: (counts.left / counts.same, wilson_interval(counts.left, counts.same, level), counts.same)
            for question, counts in answers.items()
            if counts.same
        },
        level,
        interval,
        tuple(notes),
    )


def _strengths(question: str, conditions: Sequence[str], counts: Answers, level: float) -> Iterator[StrengthScores]:
    """Bradley-Terry scores; none without answers, or where conditions were never compared with the others."""
    wins = counts.wins + (counts.ties + counts.ties.transpose(0, 2, 1)) / 2
    if not is_connected(wins):
        return
    strengths = bradley_terry(wins)
    ends = strengths.intervals(level).tolist()
    scores = dict(zip(conditions, strengths.scores.tolist(), strict=True))
    intervals = {condition: (low, high) for condition, (low, high) in zip(conditions, ends, strict=True)}
    yield StrengthScores(question, scores, intervals, strengths.robust, strengths.bounded)


def _preferences(
    question: str,
    conditions: Sequence[str],
    counts: Answers,
    level: float,
    interval: Interval,
    **options: int,
) -> list[Preference]:
    """The preferences of one question, the pairs in the order of the conditions."""
    of_answers = wilson_interval if interval == "wilson" else binomial_interval
    preferences = []
    for i, j in combinations(range(len(conditions)), 2):
        won, beaten, same = counts.wins[:, i, j], counts.wins[:, j, i], counts.ties[:, i, j]
        answers, better = won + beaten + same, won + same / 2
        count, wins, losses = int(answers.sum()), int(won.sum()), int(beaten.sum())
        if count:
            share = float(better.sum()) / count
            ends = of_answers(float(better.sum()), count, level)
            between = share_between_raters(better, answers, level, **options)
            p = binomial_p(wins, wins + losses)
            names = (conditions[i], conditions[j])
            preferences.append(
                Preference(question, *names, wins, losses, int(same.sum()), share, ends, between, p, 1.0)
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

    Args:
        folder: the study's folder.
        files: downloaded files, and folders of them.
        name: of the data set, for tables; the folder's name if None.
        ignored: ids of other studies, the files of which are passed over.
        options: of :func:`analyse`.
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


def design_of(study: Study) -> tuple[int, int]:
    """How many answers a rater gives to one comparison, at least one, and how many comparisons there are."""
    pairs = {frozenset((trial.left, trial.right)) for trial in study.trials if trial.kind == "pair"}
    counts = [
        sum(trial.kind == "pair" for trial in study.trials_of(number)) / len(pairs)
        for number in range(len(study.schedules))
    ]
    return max(1, int(np.mean(counts))), len(pairs)
