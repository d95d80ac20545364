from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from facediff.benchmark.referee import SCORES, RefereeScores, judge
from facediff.pipelines.candidates import Candidate, CandidateMotion, perform
from facediff.synthetic.spoken_set import SpokenClip, SpokenMotion, open_face, reference, spoken_set
from facediff.utils.hub import BUNDLED


@cache
def clips() -> tuple[SpokenClip, ...]:
    return tuple(spoken_set(["en", "de"], 1, 2))


def delayed(motion: SpokenMotion, other: SpokenMotion) -> np.ndarray:
    return np.concatenate([motion.points[:1]] * 2 + [motion.points[:-2]])  # 80 ms at 25 frames a second


def muted(motion: SpokenMotion, other: SpokenMotion) -> np.ndarray:
    face, points = open_face(), motion.points.copy()
    lips = np.union1d(face.lips, face.lip_pairs)
    points[:, lips] = face.rest[lips] + 0.2 * (points[:, lips] - face.rest[lips])
    return points


def trembling(motion: SpokenMotion, other: SpokenMotion) -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(len(motion.points), 1, 1))
    return motion.points + 0.5 * noise * motion.points.std(axis=0)


def another_sentence(motion: SpokenMotion, other: SpokenMotion) -> np.ndarray:
    return other.points[np.minimum(np.arange(len(motion.points)), len(other.points) - 1)]


FAULTS = {
    delayed: ("closures", "closure_auc", "gap", "correlation", "lag"),
    # Lips that hardly part close in time, so that closures alone would call such a model good.
    muted: ("open_vowels", "rounding", "lips", "step"),
    trembling: ("jitter",),
    another_sentence: ("closures", "closure_auc", "gap", "correlation"),
}


def test_the_planted_faults_of_the_bundled_model_are_seen_by_every_score_that_is_for_them() -> None:
    made = perform(Candidate("puppet", str(BUNDLED)), clips(), None)
    assert isinstance(made, CandidateMotion)
    scores = judge(clips(), made.clips, made.frame_rate, made.jaw)
    for fault, detecting in FAULTS.items():
        spoilt = {}
        for clip in clips():
            other = next(each for each in clips() if each.voice == clip.voice and each.text != clip.text)
            motion = made.clips[clip.name]
            spoilt[clip.name] = SpokenMotion(fault(motion, made.clips[other.name]), motion.head)
        worse = judge(clips(), spoilt, made.frame_rate, made.jaw)
        for name in detecting:
            assert SCORES[name].badness(worse[name]) > SCORES[name].badness(scores[name]), (fault, name)
        if fault is delayed:
            assert 60 < worse["lag"] - scores["lag"] < 100
    assert made.commercial_use == "allowed"
    assert made.seconds is not None
    assert made.seconds > 0
    assert scores["closures_de"] <= 1
    assert "head" not in scores


def test_the_reference_scores_as_itself() -> None:
    scores = RefereeScores(25.0)
    for clip in clips():
        truth = reference(clip, 25.0)
        scores.add(clip, truth, truth)
    scores = scores.scores()
    for name in ("closures", "correlation", "lips", "jitter", "step", "upper_face"):
        assert scores[name] == pytest.approx(1.0, abs=1e-6), name
    assert scores["lag"] == pytest.approx(0.0, abs=1e-6)
    assert scores["gap"] < 1.0
    assert 0.5 < scores["head"] < 10


def test_a_known_delay_gap_and_turn_are_measured() -> None:
    clip, face = clips()[0], open_face()
    truth = reference(clip, 50.0)
    late = SpokenMotion(np.concatenate([truth.points[:1]] * 3 + [truth.points[:-3]]), None)
    scores = RefereeScores(50.0)
    scores.add(clip, late, truth)
    assert scores.scores()["lag"] == pytest.approx(60.0, abs=2)
    points = np.repeat(face.rest[None], len(truth.points), 0)
    points[:, face.lip_pairs[:, 1], 1] -= 0.003
    turns = np.zeros((len(points), 3))
    turns[::2, 1] = np.deg2rad(4)
    open_mouth = RefereeScores(50.0)
    open_mouth.add(clip, SpokenMotion(points, turns), truth)
    scores = open_mouth.scores()
    assert scores["gap"] == pytest.approx(3.0, abs=0.5)
    assert scores["closures"] == 0
    assert scores["head"] == pytest.approx(2.0, abs=0.05)
    assert "jitter" not in scores  # what never moves has none


def test_channels_are_scored_by_their_jaw() -> None:
    face = open_face()
    motions = {}
    for clip in clips():
        truth = reference(clip, 25.0)
        gap = truth.points[:, face.lip_pairs[:, 0]] - truth.points[:, face.lip_pairs[:, 1]]
        jaw = np.linalg.norm(gap, axis=-1).mean(1)
        motions[clip.name] = SpokenMotion(np.stack([0 * jaw, 30 * jaw], 1)[..., None])
    scores = judge(clips(), motions, 25.0, 1)
    assert scores["correlation"] == pytest.approx(1)
    assert "closures" not in scores
    late = {name: SpokenMotion(delayed(motion, motion)) for name, motion in motions.items()}
    assert judge(clips(), late, 25.0, 1)["lag"] == pytest.approx(80, abs=5)
