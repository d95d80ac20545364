"""The referee: models on one face, scored against the known phonemes of their speech.

It needs no recording of a person: closures and the mouth's opening follow from the phonemes; blinks and head, which do
not, are reported without a judgement. Faults are planted in every model's motion, and the scores must detect them.
From top to bottom: the scores, the faults, the rows of the report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
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
from facediff.synthetic.spoken_set import LANGUAGES, OpenFace, SpokenClip, SpokenMotion, open_face, reference
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
        mouth, true_mouth = self.opening(points), self.opening(true, None)
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
            resting = float(self.opening(self.face.rest[None])[0])
            self._gaps += [1000 * float(mouth[start:end].min() - resting) for start, end in closed]
        furthest, least = round(FURTHEST * self.frame_rate), round(OVERLAP * self.frame_rate)
        self._lags.append(correlations(mouth, true_mouth, furthest, least))
        if motion.head is not None:
            self._turns.append(np.rad2deg(motion.head - motion.head.mean(0)))

    def opening(self, points: Array, jaw: int | None = -1) -> Array:
        """How far the mouth is open in every frame (T,): in metres on the face, else the jaw's channel."""
        channel = self.jaw if jaw == -1 else jaw
        if channel is not None:
            return np.asarray(points[:, channel, 0])
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


# Faults.

DELAY, MUTED, JITTER = 0.08, 0.2, 0.5
"""Seconds of delay; share that is left of the lips' motion; noise, as a share of each point's own deviation."""

CLOSES, FOLLOWS, LIVELY, SHIVERS = 0.5, 0.1, 2.0, 1.6
"""Closures and correlation below which, and motion and jitter of the lips above which, a model has the fault already: a
mouth that does not follow its speech loses nothing by another sentence."""

Fault = Callable[[SpokenMotion, SpokenMotion, float, OpenFace], Array]
"""Spoils the points of a clip; it is handed the clip, another sentence, the frame rate and the face."""


def delayed(motion: SpokenMotion, _other: SpokenMotion, frame_rate: float, _face: OpenFace) -> Array:
    """Everything comes later."""
    times = np.maximum(np.arange(len(motion.points)) - DELAY * frame_rate, 0)
    before = times.astype(np.int64)
    after, share = np.minimum(before + 1, len(times) - 1), (times - before)[:, None, None]
    return np.asarray((1 - share) * motion.points[before] + share * motion.points[after])


def muted(motion: SpokenMotion, _other: SpokenMotion, _frame_rate: float, face: OpenFace) -> Array:
    """Lips stay nearly as they are at rest; of channels, all of them do."""
    points = motion.points.copy()
    if points.shape[1:] != face.rest.shape:
        return np.asarray(MUTED * points)
    lips = np.union1d(face.lips, face.lip_pairs)
    points[:, lips] = face.rest[lips] + MUTED * (points[:, lips] - face.rest[lips])
    return points


def trembling(motion: SpokenMotion, _other: SpokenMotion, _frame_rate: float, _face: OpenFace) -> Array:
    """The face shakes from frame to frame, in proportion to each point's motion."""
    noise = np.random.default_rng(len(motion.points)).normal(size=(len(motion.points), 1, 1))
    return np.asarray(motion.points + JITTER * noise * motion.points.std(axis=0))


def wrong_sentence(motion: SpokenMotion, substitute: SpokenMotion, _frame_rate: float, _face: OpenFace) -> Array:
    """Motion for another sentence; its last frame is held if it is shorter."""
    return np.asarray(substitute.points[np.minimum(np.arange(len(motion.points)), len(substitute.points) - 1)])


@dataclass(frozen=True)
class PlantedFault:
    """A fault and the scores that must detect it."""

    title: str  # of its row
    spoil: Fault  # makes it
    seen_by: tuple[str, ...]  # scores that must be worse than the sound model's


FAULTS = {
    "delay": PlantedFault("80 ms late", delayed, ("closures", "closure_auc", "gap", "correlation", "lag")),
    # Lips that hardly part close in time, so that closures alone would call such a model good.
    "muted": PlantedFault("muted lips", muted, ("open_vowels", "rounding", "lips", "step")),
    "jitter": PlantedFault("jitter", trembling, ("jitter",)),
    "sentence": PlantedFault("wrong sentence", wrong_sentence, ("closures", "closure_auc", "gap", "correlation")),
}


@dataclass(frozen=True)
class FaultVerdict:
    """Whether a score detects a fault: its values for the sound model and for the spoilt one."""

    fault: str
    score: str
    sound: float
    spoilt: float

    @property
    def seen(self) -> bool:
        """Whether the spoilt motion is worse."""
        score = SCORES[self.score]
        return score.badness(self.spoilt) > score.badness(self.sound)


@dataclass(frozen=True)
class Judgement:
    """A row of the report, with the scores of its planted faults."""

    name: str
    # By name, as far as there are any; ``closures_de`` and so on by language
    scores: Mapping[str, float] = field(default_factory=dict)
    faults: Mapping[str, Mapping[str, float]] = field(default_factory=dict)  # the scores of each planted fault
    # How it was put on the open face, its licence and so on, by title
    facts: Mapping[str, str] = field(default_factory=dict)
    seconds: float | None = None  # of the processor for a second of speech; None if not measured
    memory: float | None = None  # bytes at most; None if not known
    frame_rate: float = 25.0
    problem: str = ""  # why there are no scores; empty if there are

    def seen(self) -> list[FaultVerdict]:
        """The verdict of each score on the faults that it must detect, where it has a value."""
        return [
            FaultVerdict(fault, score, self.scores[score], values[score])
            for fault, values in self.faults.items()
            for score in FAULTS[fault].seen_by
            if score in self.scores and score in values and not self.lacks(score)
        ]

    def lacks(self, score: str) -> str:
        """Why a score cannot detect faults in this model, in words; empty if it can."""
        if score in ("closures", "closure_auc", "gap") and self.scores.get("closures", 1) < CLOSES:
            return f"it closes its lips for fewer than {100 * CLOSES:.0f} % of p, b and m"
        if score in ("correlation", "lag") and self.scores.get("correlation", 0) < FOLLOWS:
            return "its mouth does not follow the speech"
        if score in ("open_vowels", "rounding") and self.scores.get(score, 1) <= MUTED:
            return "it hardly opens or rounds its mouth"
        if score in ("lips", "step") and self.scores.get(score, 0) > LIVELY:
            return f"its lips move more than {LIVELY:g} times as much as the reference's"
        if score == "jitter" and self.scores.get("jitter", 0) > SHIVERS:
            return "it shivers already"
        return ""


def judge(
    clips: Sequence[SpokenClip], motions: Mapping[str, SpokenMotion], frame_rate: float, jaw: int | None
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """The scores of a model and of its planted faults."""
    truths = {clip.name: reference(clip, frame_rate) for clip in clips}
    sound = RefereeScores(frame_rate, jaw)
    for clip in clips:
        sound.add(clip, motions[clip.name], truths[clip.name])
    faults = {}
    for name, fault in FAULTS.items():
        if name == "sentence" and len({clip.text for clip in clips}) < 2:
            continue
        spoilt = RefereeScores(frame_rate, jaw)
        for clip in clips:
            motion = motions[clip.name]
            points = fault.spoil(motion, motions[another(clip, clips).name], frame_rate, open_face())
            spoilt.add(clip, SpokenMotion(points, motion.head), truths[clip.name])
        faults[name] = spoilt.scores()
    return sound.scores(), faults


def another(clip: SpokenClip, clips: Sequence[SpokenClip]) -> SpokenClip:
    """The next sentence of the same voice, or else of the same language, or else of any."""
    index = [candidate.name for candidate in clips].index(clip.name)
    candidates = [candidate for candidate in (*clips[index + 1 :], *clips[:index]) if candidate.text != clip.text]
    for alike in ("voice", "language"):
        same = [candidate for candidate in candidates if getattr(candidate, alike) == getattr(clip, alike)]
        if same:
            return same[0]
    return candidates[0] if candidates else clip


def reference_judgement(clips: Sequence[SpokenClip], frame_rate: float = 25.0) -> Judgement:
    """The row of the reference itself, without planted faults."""
    scores = RefereeScores(frame_rate)
    for clip in clips:
        motion = reference(clip, frame_rate)
        scores.add(clip, motion, motion)
    return Judgement("reference", scores.scores(), frame_rate=frame_rate)
