from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from facediff.spaces.rotations import convert, matrices
from facediff.speech.audio import read_speech
from facediff.speech.phonemes import TimedPhoneme, closures, read_phonemes
from facediff.synthetic.head.rig import SHAPES
from facediff.synthetic.performance import FaceMotion
from facediff.synthetic.spoken_set import (
    LANGUAGES,
    SpokenClip,
    open_face,
    reference,
    spoken_set,
    write_spoken_set,
)


def test_every_language_has_closures_and_a_reference_that_makes_them() -> None:
    clips = spoken_set(list(LANGUAGES), 1, 1)
    assert [clip.language for clip in clips] == list(LANGUAGES)
    face = open_face()
    for clip in clips:
        timed = [TimedPhoneme(p.start, p.end, p.ipa) for p in clip.phonemes]
        closed = closures(timed, 25)
        assert len(closed) >= 3, clip.text
        points = reference(clip, 25).points
        assert len(points) == round(25 * clip.seconds)
        gaps = np.linalg.norm(points[:, face.lip_pairs[:, 0]] - points[:, face.lip_pairs[:, 1]], axis=-1).mean(1)
        # The lips of the reference are nearer in its closures than in most other frames.
        assert np.mean([gaps[start:end].min() for start, end in closed]) < np.quantile(gaps, 0.25), clip.text


def test_the_reference_is_one_motion_at_any_frame_rate() -> None:
    clip = spoken_set(["en"], 1, 1)[0]
    slow, quick = reference(clip, 25).points, reference(clip, 75).points
    assert np.abs(quick[1::3][: len(slow)] - slow).max() < 1e-9


def test_the_references_head_turns_as_the_corpus_does(monkeypatch: pytest.MonkeyPatch) -> None:
    angles = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
    motion = FaceMotion(np.zeros((3, len(SHAPES))), np.zeros((3, 2)), angles)
    made = {
        "perform_clip": lambda *_: (motion, motion),
        "rig_of": lambda _: np.zeros((1 + len(SHAPES), 1, 3)),
        "open_face": lambda: SimpleNamespace(points=[0]),
    }
    for name, function in made.items():
        monkeypatch.setattr(f"facediff.synthetic.spoken_set.{name}", function)
    head = reference(SpokenClip("a_01", "en", "espeak:en", "", np.zeros(0, np.float32), ()), 25).head
    assert head is not None
    turns = matrices(convert(head, "axis_angle", "quaternion"))
    assert turns[0, 1, 2] < 0  # a positive pitch takes the nose down
    assert turns[1, 0, 2] > 0  # a positive yaw turns the face to its left, where x grows
    assert turns[2, 0, 1] > 0  # a positive roll leans the crown towards the left shoulder
    np.testing.assert_allclose(np.linalg.norm(head, axis=1), np.deg2rad(2))


def test_speech_for_other_programs_is_what_was_spoken(tmp_path: Path) -> None:
    clips = spoken_set(["de"], 1, 1)
    folder = tmp_path / "speech"
    write_spoken_set(clips, folder)
    samples = read_speech(folder / "wav" / f"{clips[0].name}.wav")
    assert np.abs(samples - clips[0].samples).max() < 1e-4
    written = read_phonemes(folder / "phonemes" / f"{clips[0].name}.csv")
    assert [p.ipa for p in written] == [p.ipa for p in clips[0].phonemes]
    assert (folder / "clips.csv").read_text(encoding="utf-8").count(clips[0].text) == 1
