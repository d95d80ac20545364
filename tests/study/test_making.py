"""Studies are made of folders of animations: what is shown, what is refused, and what a stopped run leaves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from facediff.animation import read_archive, write_archive
from facediff.cli.app import main
from facediff.render import write_video
from facediff.study import read_study
from facediff.study.definition import DATABASE, Trial
from facediff.study.store import AnswerStore
from tests.fakes.study import write_methods
from tests.fakes.tiny import write_tiny

SMALL = ["--size", "32", "--workers", "1", "--quiet", "--languages", "en"]
FEW = ["--clips", "A_one", "--still-controls", "1", "--same-controls", "0", "--repeats", "0"]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with animations of two methods and of the truth."""
    write_methods(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    def run(*words: str) -> str:
        before = {path for path in Path().rglob("*")}
        assert main(["study", "make", *words, *SMALL]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert {path for path in Path().rglob("*")} == before
        return error

    return run


def make(*words: str, options: Sequence[str] = SMALL) -> int:
    return main(["study", "make", "ours=ours", "theirs=theirs", "--truth", "truth", "-o", "study", *options, *words])


def frames(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def changes(pictures: np.ndarray) -> np.ndarray:
    """How much the left and the right half of a video (T, H, W, 3) move."""
    moved = np.abs(np.diff(pictures.astype(float), axis=0)).mean((0, 1, 3))
    half = len(moved) // 2
    return np.array([moved[:half].max(), moved[half:].max()])


@pytest.mark.slow
def test_each_side_shows_what_the_key_says_and_the_sound_is_the_clips(place: Path) -> None:
    options = ["--size", "64", "--quiet", "--workers", "1", "--video", "webm", "--style-references", "truth"]
    options += ["--still-controls", "1", "--same-controls", "0", "--languages", "en", "--clips", "A_one"]
    assert make(options=options) == 0
    study = read_study(place / "study")
    assert study.conditions == ["ours", "theirs", "truth"]
    assert {Path(name).suffix for name in study.videos()} == {".webm"}
    by_sides: dict[tuple[str, str, str], Trial] = {(t.clip, t.left, t.right): t for t in study.trials}
    for (clip, left, right), trial in by_sides.items():
        path = place / "study" / "page" / "videos" / trial.video
        pictures = frames(path)
        assert pictures.shape[:3] == (15, 64, 128)
        still = changes(pictures)
        assert (still[0] < 2, still[1] < 2) == (left == "still", right == "still")
        if (clip, right, left) in by_sides:
            mirrored = frames(path.with_name(by_sides[clip, right, left].video))
            exchanged = np.concatenate([mirrored[:, :, 64:], mirrored[:, :, :64]], 2)
            assert np.abs(pictures.astype(float) - exchanged).mean() < 3
        with av.open(str(path)) as container:
            sound = np.concatenate([frame.to_ndarray()[0] for frame in container.decode(audio=0)])
            rate = container.streams.audio[0].rate
        speech = np.asarray(read_archive(place / "truth" / f"{clip}.npz").speech)
        assert len(sound) / rate == pytest.approx(len(speech) / 16_000, abs=0.05)
        assert np.abs(sound).max() > 0.1
    assert study.details["references"] == {"A_one": "A_two"}
    reference = str(study.trials[0].reference)
    assert frames(place / "study" / "page" / "videos" / reference).shape[2] == 64


@pytest.mark.slow
def test_the_same_seed_gives_the_same_study_and_what_is_there_is_kept(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert make(*FEW) == 0
    before = {path: path.stat().st_mtime_ns for path in (place / "study").rglob("*.mp4")}
    key = (place / "study" / "study.json").read_bytes()
    capsys.readouterr()
    assert make(*FEW) == 0
    assert "(0 drawn" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in (place / "study").rglob("*.mp4")} == before
    next(iter(before)).unlink()
    assert make(*FEW) == 0
    assert "(1 drawn" in capsys.readouterr().out
    assert (place / "study" / "study.json").read_bytes() == key
    animation = read_archive(place / "ours" / "A_one.npz")
    write_archive(place / "ours" / "A_one.npz", animation)  # another time, the same content: the same bytes
    vertices = np.array(animation.vertices)
    vertices[3, 0] += 1
    write_archive(place / "ours" / "A_one.npz", replace(animation, vertices=vertices))
    assert make(*FEW) == 0
    said = capsys.readouterr().out
    assert "(0 drawn" not in said
    assert f"({len(before)} drawn" not in said
    assert (place / "study" / "study.json").read_bytes() != key
    study = read_study(place / "study")
    assert {path.name for path in (place / "study").rglob("*.mp4")} == set(study.videos())
    assert make(*FEW, "--seed", "1") == 0
    assert read_study(place / "study").id != study.id


@pytest.mark.slow
def test_a_corpus_gives_bare_arrays_their_mesh_faces_rate_and_sound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    corpus = write_tiny(tmp_path / "corpus")
    (tmp_path / "ours").mkdir()
    for clip, condition in (("A_e06", "A"), ("A_e06", "B"), ("B_e07", "B"), ("C_e06", "A")):
        motion = np.load(corpus / "vertices_npy" / f"{clip}.npy")
        np.save(tmp_path / "ours" / f"{clip}_condition_{condition}.npy", motion[:-1])
    np.save(tmp_path / "ours" / "D_e01.npy", motion)
    words = ["study", "make", "ours=ours", "--truth", "corpus", "--mesh", "corpus/tiny.ply", "--frame-rate", "25"]
    assert main([*words, "-o", "study", *SMALL, *FEW[2:]]) == 0
    assert "D_e01" in capsys.readouterr().out
    study = read_study(tmp_path / "study")
    assert {trial.clip for trial in study.trials} == {"A_e06", "B_e07", "C_e06"}
    assert {question.name for question in study.questions} == {"realism", "lip_sync", "style", "comments"}
    references = study.details["references"]
    assert {clip[0] == reference[0] and clip != reference for clip, reference in references.items()} == {True}


def test_mistakes_are_one_sentence_and_leave_nothing(place: Path, refused: Callable[..., str]) -> None:
    (place / "empty").mkdir()
    (place / "other").mkdir()
    shutil.copy(place / "ours" / "A_one.npz", place / "other" / "else.npz")
    base = ("ours=ours", "--truth", "truth", "-o", "study")
    assert "empty: holds no animation" in refused("ours=ours", "empty", "-o", "study")
    assert "else" in refused("ours=ours", "other", "-o", "study")
    assert "nothing to compare" in refused("ours=ours", "-o", "study")
    assert "--clips" in refused(*base, "--clips", "A_three")
    (place / "notes").mkdir()
    (place / "notes" / "a.txt").touch()
    assert "notes: is not empty" in refused(*base[:-1], "notes")
    for text, named in (
        ("questions: [realsim]", "realism"),
        ("questions: [comments]", "choice"),
        ("questions: [realism, realism]", "each once"),
        ("questions: [{name: X}]", "questions[0].name"),
        ("questions: [{name: x, text: {de: Ja}}]", "en"),
        ("rule: {least_right: 2}", "rule.least_right"),
        ("consent: 3", "consent"),
        ("other: 1", "other"),
    ):
        (place / "q.yaml").write_text(text)
        assert named in refused(*base, "--questions", "q.yaml")


def test_a_study_with_answers_is_not_replaced(place: Path, refused: Callable[..., str]) -> None:
    assert make(*FEW) == 0
    study = read_study(place / "study")
    AnswerStore(place / "study" / DATABASE, study).register("a" * 32, "en", "")
    assert make(*FEW) == 0  # the same study
    words = ("ours=ours", "theirs=theirs", "--truth", "truth", "-o", "study", "--seed", "5")
    assert "answers" in refused(*words)
    assert read_study(place / "study").id == study.id


def test_a_full_disk_leaves_no_study_and_the_next_run_continues(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    count = iter(range(100))

    def ended(pictures: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        yield next(pictures)
        raise OSError(28, "No space left on device")

    def full(path: Path, pictures: Iterator[np.ndarray], *more: object) -> int:
        return write_video(path, pictures if next(count) < 3 else ended(pictures), *more)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr("facediff.study.making.write_video", full)
        assert make(*FEW) == 2
    assert "No space" in capsys.readouterr().err
    assert not (place / "study" / "study.json").exists()
    assert len(list((place / "study").rglob("*.mp4"))) == 3
    assert not list((place / "study").rglob("*.partial-*"))
    assert main(["study", "serve", "study"]) == 2
    assert "study make" in capsys.readouterr().err
    assert make(*FEW) == 0
    assert "3 up to date" in capsys.readouterr().out


def test_a_study_that_was_changed_is_noticed(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert make(*FEW) == 0
    path = place / "study" / "study.json"
    content = json.loads(path.read_text())
    content["rule"]["least_right"] = 0.1
    path.write_text(json.dumps(content))
    assert main(["study", "serve", "study"]) == 2
    assert "changed" in capsys.readouterr().err
