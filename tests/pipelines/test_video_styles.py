"""A person's style from a video, and sound that is out of step with the mouth."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import facediff
from facediff.cli.app import main
from facediff.data.track.face import pair_distances
from facediff.errors import Note
from facediff.pipelines.video_styles import with_video_styles
from facediff.speech.audio import read_speech
from facediff.utils.files import example_recordings
from tests.fakes.people import Look, talking, use_coded_faces, write_coded_video


@pytest.fixture(autouse=True)
def coded_faces(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    use_coded_faces(monkeypatch)
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_coded_video(tmp_path / "eva.mp4", [look.picture() for look in talking(3)])


@pytest.mark.filterwarnings("ignore::facediff.errors.Note")
def test_a_video_is_a_style_on_the_models_face(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = cast("Callable[[], facediff.Animator]", lambda: SimpleNamespace(corpus="people", n_vertices=468))
    with pytest.warns(Note, match="the face model has SHA-256 000"):
        words = str(with_video_styles(f"{video}:0.5,other:0.5", model))
    file, weight = words.split(",")[0].rsplit(":", 1)
    motion = facediff.read(file)
    assert (motion.vertices.shape[1:], motion.name, weight) == ((468, 3), "style_s001", "0.5")
    monkeypatch.setattr("facediff.data.track.corpus.track_people", None)  # the second time nothing is tracked
    assert with_video_styles({str(video): 0.5, "other": 1}, model) == {file: 0.5, "other": 1}


@pytest.mark.parametrize("style", [None, "", "F1_e05", {"F1_e05": 0.4, "my.movie": 0.6}, Path("a.npz"), 3])
def test_other_styles_stay(style: object) -> None:
    assert with_video_styles(style, cast("Callable[[], facediff.Animator]", None)) == style


@pytest.mark.filterwarnings("ignore::facediff.errors.Note")
def test_python_and_the_command_take_a_video_alike(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "facediff.Animation.retarget", lambda motion, face: facediff.load("puppet").animate(*SHORT, seed=9)
    )
    model, usual = facediff.load("puppet"), facediff.load("puppet").animate(*SHORT, seed=1)
    styled = model.animate(*SHORT, seed=1, style=video)
    assert not np.array_equal(styled.vertices, usual.vertices)
    speech = tmp_path / "speech.npz"
    assert (
        main(
            [
                "animate",
                str(example_recordings()[0]),
                "--seed",
                "1",
                "--style",
                str(video),
                "-o",
                str(speech),
                "--quiet",
            ]
        )
        == 0
    )
    np.testing.assert_array_equal(
        facediff.read(speech).vertices, model.animate(example_recordings()[0], seed=1, style=str(video)).vertices
    )
    np.testing.assert_array_equal(model.extract_style([video]), model.extract_style(video))


SHORT = (np.random.default_rng(0).normal(0, 0.1, 16_000).astype(np.float32), 16_000)


@pytest.mark.parametrize(
    ("frames", "warning"), [(-4, "sound is about 1[3-9]. ms late"), (0, ""), (4, "sound is about 1[3-9]. ms early")]
)
def test_sound_out_of_step_with_the_mouth(
    frames: int, warning: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    speech = read_speech(example_recordings()[0])
    expected = facediff.load("puppet").animate(speech, 16_000, seed=0)
    gaps = 100 * pair_distances(expected.vertices, np.asarray(expected.inner_lip_pairs))  # centimetres
    late = np.roll(gaps, frames)
    video = write_coded_video(tmp_path / "eva.mp4", [Look(float(gap)).picture() for gap in late], sound=speech)
    assert main(["data", "track", str(video), "-o", str(tmp_path / "people"), "--workers", "1", "--quiet"]) == 0
    found = [line for line in capsys.readouterr().out.splitlines() if "the sound is" in line]
    assert len(found) == bool(warning)
    assert all(re.search(warning, line) for line in found)
