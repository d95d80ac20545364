"""Faces follow the speech: lips meet on p, b, m, open on vowels, nothing jitters, moods and speaking styles show."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.metrics import BlinkRate
from facediff.speech.espeak import SpokenPhoneme
from facediff.synthetic import motion
from facediff.synthetic.corpus import MOODS, SyntheticClip, generate_clip, rig_of
from facediff.synthetic.face import build_face
from facediff.synthetic.motion import FRAME_RATE, SPEECH_CONTROLS, articulate, close_lips, segments_of
from facediff.synthetic.rig import CONTROLS, eyelid_pairs

pytest.importorskip("espeakng_loader")


def opening(vertices: np.ndarray, identity: str) -> np.ndarray:
    rig = rig_of(identity)
    return vertices[:, rig.upper, 1] - vertices[:, rig.lower, 1]


def load(corpus: Path, clip: str) -> tuple[np.ndarray, list[dict[str, str]]]:
    motion = np.load(corpus / "vertices_npy" / f"{clip}.npy")
    with (corpus / "phonemes" / f"{clip}.csv").open(encoding="utf-8") as stream:
        return motion.reshape(len(motion), -1, 3).astype(np.float64), list(csv.DictReader(stream))


@pytest.mark.parametrize("clip", ["F1_e01", "F1_e02", "M3_e01", "F4_e05"])
def test_lips_shut_on_bilabials_and_open_on_open_vowels(corpus: Path, clip: str) -> None:
    motion, phonemes = load(corpus, clip)
    gaps = opening(motion, clip[:2])
    widest = gaps.max(axis=1)
    times = (np.arange(len(motion)) + 0.5) / FRAME_RATE
    shut, open_wide = [], []
    for row in phonemes:
        middle = 0.5 * (float(row["start"]) + float(row["end"]))
        around = np.abs(times - middle).argmin()
        if row["viseme"] in ("PP", "MM"):
            shut.append(widest[around])
        if row["viseme"].startswith(("AA", "AE")) and "ˈ" in row["ipa"]:
            inside = (times > float(row["start"])) & (times < float(row["end"]))
            open_wide.append(widest[inside].max())
    assert len(shut) >= 2
    assert max(shut) < 0.0006
    assert max(open_wide) > 0.008
    assert np.median(open_wide) > 0.004
    assert gaps.min() > -0.0003


def test_nothing_jitters(corpus: Path) -> None:
    """Acceleration stays within what shutting and opening a mouth in two frames needs, and is no noise."""
    for clip in ("F1_e01", "F1_e02", "F1_e03"):
        motion, _ = load(corpus, clip)
        lip = opening(motion, "F1").max(axis=1)
        acceleration = np.diff(lip, 2)
        assert np.abs(acceleration).max() < 1.1 * np.ptp(lip)
        turns = np.sign(np.diff(lip))
        moving = np.abs(np.diff(lip)) > 0.0003
        flips = (turns[1:] * turns[:-1] < 0) & moving[1:] & moving[:-1]
        assert flips.mean() < 0.35
        brow = motion[:, rig_of("F1").fields[CONTROLS.index("inner_brow_up")][:, 1].argmax(), 1]
        assert np.abs(np.diff(brow, 2)).max() < 0.25 * np.ptp(brow)


def test_trajectories_have_no_corners() -> None:
    """Sampled ten times finer, the largest change of slope falls in proportion: the slope is continuous."""
    segments = segments_of(
        (
            SpokenPhoneme(0.0, 0.1, ""),
            SpokenPhoneme(0.1, 0.2, "m"),
            SpokenPhoneme(0.2, 0.4, "ˈɑː"),
            SpokenPhoneme(0.4, 0.5, "b"),
        )
    )

    def kink(step: float) -> float:
        times = np.arange(0.0, 0.5, step)
        tracks = np.column_stack([articulate(segments, times), close_lips(segments, times)])
        return float(np.abs(np.diff(tracks, 2, axis=0) / step).max())

    assert kink(0.0001) < 0.15 * kink(0.001)


def test_dominance_respects_neighbours_and_rounding_spreads() -> None:
    segments = segments_of((SpokenPhoneme(0.0, 0.1, "t"), SpokenPhoneme(0.1, 0.3, "uː"), SpokenPhoneme(0.3, 0.4, "t")))
    weights = articulate(segments, np.array([0.05, 0.2]))
    pucker = SPEECH_CONTROLS.index("pucker")
    assert weights[1, pucker] > 0.7
    assert weights[0, pucker] > 0.15


def test_moods_differ_in_articulation_and_brows_on_one_speech() -> None:
    peak, brows, waves = [], [], []
    for mood in MOODS:
        wave, weights, _ = generate_clip(SyntheticClip("M1", 2, mood))
        peak.append(np.quantile(opening(rig_of("M1").pose(weights), "M1").max(axis=1), 0.9))
        brows.append(weights[:, CONTROLS.index("outer_brow_up")].max())
        waves.append(wave)
    assert peak[1] > 1.25 * peak[0]
    assert peak[2] > 1.15 * peak[1]
    assert brows[0] < brows[1] < brows[2]
    assert np.array_equal(waves[0], waves[1])


def test_chance_moves_the_upper_face_and_hardly_the_lips() -> None:
    rig = rig_of("F3")
    takes = [rig.pose(generate_clip(SyntheticClip("F3", 5, "neutral"), seed)[1]) for seed in (0, 1)]
    lips = [opening(animation, "F3").max(axis=1) for animation in takes]
    assert np.abs(lips[0] - lips[1]).max() < 0.15 * np.ptp(lips[0])
    upper = np.linalg.norm(takes[0] - takes[1], axis=2).max()
    assert upper > 0.001


def test_a_lively_speaker_opens_by_one_and_a_half_to_three_centimetres() -> None:
    for identity in ("F1", "M3"):
        _, weights, _ = generate_clip(SyntheticClip(identity, 1, "lively"))
        assert 0.015 < opening(rig_of(identity).pose(weights), identity).max() < 0.03


def test_the_built_in_corpus_blinks_as_often_as_was_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def noted(times: np.ndarray, style: object, random: np.random.Generator) -> np.ndarray:
        shut = made(times, style, random)
        inside = (times > 0.1) & (times < times[-1] - 0.1)
        high = (shut > 0.5) & inside
        drawn.append(int(high[0]) + int(np.sum(high[1:] & ~high[:-1])))
        return shut

    made = motion._blinks
    monkeypatch.setattr(motion, "_blinks", noted)
    pairs = np.stack(eyelid_pairs(build_face()), 1)
    assert pairs.shape == (14, 2)
    found = []
    for number, mood in ((28, "lively"), (29, "flat"), (31, "neutral")):
        _, weights, _ = generate_clip(SyntheticClip("F1", number, mood))
        vertices = torch.from_numpy(rig_of("F1").pose(weights))
        metric = BlinkRate(pairs.tolist(), frames_per_second=25)
        metric.update(vertices, vertices)
        found.append(round(metric.compute().item() * len(vertices) / 1500))
    assert sum(drawn) > 0
    assert found == drawn
