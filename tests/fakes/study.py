"""User studies in miniature: one without videos, for answers and tables, and animations of which one is made."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from facediff.animation import write_archive
from facediff.study.answers import FORMAT, Answer, Rater, questions_of
from facediff.study.definition import DATABASE, PAGE_FOLDER, VIDEO_FOLDER, Rule, Study, Trial
from facediff.study.design import Design, Pairs, make_forms, make_pairs, make_schedules
from facediff.study.page import write_page
from facediff.study.store import AnswerStore
from facediff.study.texts import bundled_question, standard
from tests.fakes.clicks import RATE, SAMPLE_RATE, clicks

DAY = "2026-01-01"
METHODS = ("ours", "theirs")
SCORES = {"ours": 0.4, "theirs": -0.5, "third": -0.1, "truth": 0.6}


def small_study(
    *,
    methods: Sequence[str] = METHODS,
    clips: int = 6,
    design: Design = "latin",
    pairs: Pairs = "first",
    no_difference: bool = False,
    rule: Rule | None = None,
    languages: Sequence[str] = ("en", "de"),
    seed: int = 0,
    **controls: int,
) -> Study:
    """A study whose videos are names only."""
    names = [f"A_e{i:02d}" for i in range(clips)]
    counts = {"still": 3, "same": 1, "repeats": 1, **controls}
    forms = make_forms(names, make_pairs([*methods, "truth"], pairs), design=design, seed=seed, **counts)
    showings, schedules = make_schedules(forms, seed)
    reference = hashlib.sha256(b"reference").hexdigest()[:16] + ".mp4"
    trials = []
    for showing in showings:
        video = hashlib.sha256(f"{showing.clip}{showing.left}{showing.right}".encode()).hexdigest()[:16]
        trial = hashlib.sha256(f"{seed}{showing}".encode()).hexdigest()[:16]
        trials.append(Trial(trial, showing.kind, showing.clip, showing.left, showing.right, f"{video}.mp4", reference))
    questions = [bundled_question(name, languages) for name in ("realism", "style", "comments")]
    questions[0] = replace(questions[0], no_difference=no_difference)
    return Study(
        title=standard("title", languages),
        consent=standard("consent", languages),
        languages=tuple(languages),
        methods=tuple(methods),
        questions=tuple(questions),
        rule=rule or Rule(),
        trials=tuple(trials),
        schedules=tuple(map(tuple, schedules)),
        seed=seed,
        version="0",
    )


def write_study(folder: Path, study: Study) -> Path:
    """The folder of a study whose videos hold nothing."""
    videos = folder / PAGE_FOLDER / VIDEO_FOLDER
    videos.mkdir(parents=True)
    for name in study.videos():
        (videos / name).write_bytes(b"video " * 100)
    write_page(folder / PAGE_FOLDER, study)
    study.write(folder)
    return folder


def simulate(
    study: Study, scores: Mapping[str, float], raters: int, *, no_difference: float = 0.0, seed: int = 0
) -> list[Rater]:
    """Raters who prefer i to j with the chance 1 / (1 + exp(s_j - s_i)), and hardly ever a still face.

    ``no_difference`` is the share of answers that see none, where a question allows it.
    """
    rng, scores = np.random.default_rng(seed), {"still": -6.0, **scores}

    def rater(number: int) -> Rater:
        answers: dict[str, Answer] = {}
        for trial in study.trials_of(number):
            replies = {}
            for question, allowed in questions_of(study, trial).items():
                left = rng.random() < 1 / (1 + np.exp(scores[trial.right] - scores[trial.left]))
                same = "same" in allowed and rng.random() < no_difference
                replies[question] = "same" if same else "left" if left else "right"
            answers[trial.id] = Answer(trial.id, replies, 10.0, 1, f"{DAY}T00:{len(answers):02d}:00Z")
        token = hashlib.sha256(f"{seed}/{number}".encode()).hexdigest()[:32]
        return Rater(token, number, study.languages[0], "", f"{DAY}T00:00:00Z", f"{DAY}T23:59:59Z", answers)

    return [rater(number) for number in range(raters)]


def write_answers(folder: Path, study: Study, raters: int, seed: int = 0) -> AnswerStore:
    """Simulated raters, as the server stores them."""
    store = AnswerStore(folder / DATABASE, study)
    for rater in simulate(study, SCORES, raters, seed=seed):
        assert store.register(rater.token, rater.language, rater.code) == rater.number
        for answer in rater.answers.values():
            assert store.save(rater.token, answer)
        assert store.finish(rater.token, {})
    return store


def as_file(rater: Rater, study: Study) -> dict[str, object]:
    """A rater's answers as the page writes them."""
    content = asdict(rater)
    token, answers = content.pop("token"), content.pop("answers")
    file = {"format": FORMAT, "study": study.id, "rater": token, "trials": list(answers.values()), **content}
    plain: dict[str, object] = json.loads(json.dumps(file))
    return plain


def write_methods(folder: Path, *, clips: Sequence[str] = ("A_one", "A_two"), frames: int = 15) -> dict[str, Path]:
    """Folders ``truth``, ``ours`` and ``theirs`` with archives of a mouth that opens, by so much differently."""
    found = {}
    for shift, name in enumerate(("truth", *METHODS)):
        found[name] = folder / name
        found[name].mkdir(parents=True)
        for number, clip in enumerate(clips):
            whole = clicks(name=clip, lower=float(shift))
            sound = np.asarray(whole.speech)[: frames * SAMPLE_RATE // RATE]
            vertices = np.roll(whole.vertices, number, 0)[:frames]
            write_archive(found[name] / f"{clip}.npz", replace(whole, vertices=vertices, speech=sound, metadata={}))
    return found
