"""The referee: models on one face, scored against the known phonemes of their speech.

It needs no recording of a person: closures and the mouth's opening follow from the phonemes; blinks and head, which do
not, are reported without a judgement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch

from facediff.data.articulation import MouthMotion, articulation, mouth_motion
from facediff.metrics import (
    BilabialClosureRate,
    BlinkRate,
    DifferenceRatio,
    FrameStep,
    LipOpeningCorrelation,
    MotionLiveliness,
    SequenceMetric,
)
from facediff.metrics.mouth import opening
from facediff.speech.phonemes import TimedPhoneme, closures
from facediff.synthetic.spoken_set import LANGUAGES, SpokenClip, SpokenMotion, open_face, reference
from facediff.utils.cross_correlation import correlations, peak

Array = npt.NDArray[np.float64]

Ideal = Literal["higher", "lower", "zero", "one"]
"""Which way is better: larger, smaller, nearer to 0 or nearer to 1."""


@dataclass(frozen=True)
class RefereeScore:
    """A column."""

    title: str
    ideal: Ideal | None  # which way is better; None where nothing is better or worse
    digits: int
    meaning: str  # its definition

    def badness(self, value: float) -> float:
        """How bad a value is: smaller is better."""
        match self.ideal:
            case "higher":
                return -value
            case "zero":
                return abs(value)
            case "one":
                return abs(math.log(value)) if value > 0 else math.inf
            case _:
                return value


FURTHEST, OVERLAP = 0.4, 1.0
"""Seconds of delay that are looked at, either way, and seconds that must overlap."""

SCORES = {
    "closures": RefereeScore(
        "closures", "higher", 2, "share of p, b and m in which the lips meet in at least one frame"
    ),
    "chance": RefereeScore("chance", None, 2, "the same share of all other sounds, within 1 mm"),
    "closure_auc": RefereeScore(
        "AUC", "higher", 2, "how well the opening tells p, b and m from all other sounds: 0.5 by chance"
    ),
    "gap": RefereeScore(
        "gap, mm", "lower", 2, "opening of the lips in p, b and m at its smallest, beyond that at rest; mean"
    ),
    "correlation": RefereeScore("opening", "higher", 2, "correlation of the mouth's opening with the reference's"),
    "lag": RefereeScore("lag, ms", "zero", 0, "how late the opening is, by cross-correlation; negative is early"),
    "open_vowels": RefereeScore("vowels", "one", 2, "opening at a, ɑ, æ …, as a share of the reference's"),
    "rounding": RefereeScore(
        "rounding", "one", 2, "narrowing of the mouth at u, o and w against other vowels, as a share of the reference's"
    ),
    "lips": RefereeScore("lips", "one", 2, "how much the lips move, as a share of the reference (standard deviation)"),
    "jitter": RefereeScore(
        "jitter", "one", 2, "second over first differences of the lips in time, over the reference's"
    ),
    "step": RefereeScore("step", "one", 2, "how far the lips go from frame to frame, over the reference's"),
    "upper_face": RefereeScore("brows, lids", "one", 2, "how much the upper face moves, as a share of the reference"),
    "blinks": RefereeScore("blinks/min", None, 0, "blinks a minute"),
    "head": RefereeScore("head, °", None, 1, "root mean square of the head's turn about its mean"),
}


@dataclass
class RefereeScores:
    """The scores of one motion of every clip.

    Args:
        frame_rate: of the motion.
        jaw: the channel that opens the jaw, of motion that is channels; None for points of the open face.
    """

    frame_rate: float
    jaw: int | None = None

    def __post_init__(self) -> None:
        face = self.face = open_face()
        lips, lids = ([(int(a), int(b)) for a, b in pairs] for pairs in (face.lip_pairs, face.lid_pairs))
        self._pair = torch.from_numpy(face.lip_pairs)
        # Of channels only the jaw is known: scores of lips and lids are left out, and the report says so.
        opened: list[tuple[int, int]] = [(0, 1)]
        self._openings: dict[str, SequenceMetric] = {"correlation": LipOpeningCorrelation(opened)}
        self._faces: dict[str, SequenceMetric] = {}
        self._closures: dict[str, BilabialClosureRate] = {}
        if self.jaw is None:
            of_lips, of_brows = (index.tolist() for index in (face.lips, face.upper_face))
            self._faces = {
                "lips": MotionLiveliness(of_lips),
                "jitter": DifferenceRatio(of_lips),
                "step": FrameStep(of_lips),
                "upper_face": MotionLiveliness(of_brows),
                "blinks": BlinkRate(lids, frames_per_second=self.frame_rate),
            }
            self._closures = {name: BilabialClosureRate(lips, count="closures") for name in ("", *LANGUAGES)}
        else:
            self._openings["jitter"] = DifferenceRatio([1])
        self._mouths: list[MouthMotion] = []
        self._true_mouths: list[MouthMotion] = []
        self._gaps: list[float] = []
        self._lags: list[Array] = []
        self._turns: list[Array] = []

    def add(self, clip: SpokenClip, motion: SpokenMotion, truth: SpokenMotion) -> None:
        """Score one clip."""
        frames = min(len(motion.points), len(truth.points))
        points, true = motion.points[:frames], truth.points[:frames]
        mouth, true_mouth = self.opening(points, self.jaw), self.opening(true, None)
        pair, true_pair = (as_pair(series) for series in (mouth, true_mouth))
        for metric in self._openings.values():
            metric.update(pair, true_pair)
        predicted, target = torch.from_numpy(points), torch.from_numpy(true)
        for metric in self._faces.values():
            metric.update(predicted, target)
        timed = [TimedPhoneme(p.start, p.end, p.ipa) for p in clip.phonemes]
        closed = [(start, end) for start, end in closures(timed, self.frame_rate) if end <= frames]
        if self.jaw is None:
            for found, vertices in ((self._mouths, points), (self._true_mouths, true)):
                rest, pairs, rate = self.face.rest, self.face.lip_pairs, self.frame_rate
                found.append(mouth_motion(vertices, rest, pairs, millimetres=1000, frame_rate=rate, phonemes=timed))
        if self._closures and closed:
            for name in ("", clip.language):
                self._closures[name].update(predicted, target, closures=closed)
            resting = float(self.opening(self.face.rest[None], self.jaw)[0])
            self._gaps += [1000 * float(mouth[start:end].min() - resting) for start, end in closed]
        furthest, least = round(FURTHEST * self.frame_rate), round(OVERLAP * self.frame_rate)
        self._lags.append(correlations(mouth, true_mouth, furthest, least))
        if motion.head is not None:
            self._turns.append(np.rad2deg(motion.head - motion.head.mean(0)))

    def opening(self, points: Array, jaw: int | None) -> Array:
        """How far the mouth is open in every frame (T,): in metres on the face, else the jaw's channel."""
        if jaw is not None:
            return np.asarray(points[:, jaw, 0])
        return np.asarray(opening(torch.from_numpy(points), None, self._pair).numpy())

    def scores(self) -> dict[str, float]:
        """All scores that there are."""
        values: dict[str, float] = {}
        for name, metric in {**self._openings, **self._faces}.items():
            _note(values, name, metric)
        for name, rate in self._closures.items():
            if int(rate.counts[1]):
                _note(values, f"closures_{name}" if name else "closures", rate)
        if self._mouths:
            articulated = articulation(self._mouths)
            found = articulated.shares_of(articulation(self._true_mouths))
            found = {name: found[name] for name in ("open_vowels", "rounding")}
            found |= {"chance": articulated.chance, "closure_auc": articulated.closure_auc}
            values |= {name: value for name, value in found.items() if math.isfinite(value)}
        if self._gaps:
            values["gap"] = float(np.mean(self._gaps))
        usable = [scores for scores in self._lags if np.isfinite(scores).all() and scores.any()]
        if usable:
            values["lag"] = 1000 * peak(np.mean(usable, axis=0)) / self.frame_rate
        if self._turns:
            values["head"] = float(np.sqrt(np.square(np.concatenate(self._turns)).sum(1).mean()))
        return values


def _note(values: dict[str, float], name: str, metric: SequenceMetric) -> None:
    """A score, where it has a value: a still face has no ratio of differences."""
    try:
        value = float(metric.compute())
    except ValueError:
        return
    if math.isfinite(value):
        values[name] = value


def as_pair(series: Array) -> torch.Tensor:
    """A series of openings as two points (T, 2, 3) that are so far apart."""
    pair = np.zeros((len(series), 2, 3))
    pair[:, 1, 1] = series
    return torch.from_numpy(pair)


@dataclass(frozen=True)
class Judgement:
    """A row of the report."""

    name: str
    # By name, as far as there are any; ``closures_de`` and so on by language
    scores: Mapping[str, float] = field(default_factory=dict)
    # How it was put on the open face, its licence and so on, by title
    facts: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None  # of the processor for a second of speech; None if not measured
    memory: float | None = None  # bytes at most; None if not known
    frame_rate: float = 25.0
    problem: str = ""  # why there are no scores; empty if there are


def judge(
    clips: Sequence[SpokenClip], motions: Mapping[str, SpokenMotion], frame_rate: float, jaw: int | None
) -> dict[str, float]:
    """The scores of a model's motion of all clips, by their names."""
    scores = RefereeScores(frame_rate, jaw)
    for clip in clips:
        scores.add(clip, motions[clip.name], reference(clip, frame_rate))
    return scores.scores()
