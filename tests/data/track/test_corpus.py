"""From videos to a corpus of people, with faces that are coded in the pictures instead of tracked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import facediff
from facediff.cli.app import main
from facediff.data import People
from facediff.data.corpus import read_clip_table, read_templates
from facediff.data.packed.packing import pack
from facediff.data.track.topology import BROWS, LIP_PAIRS
from facediff.mesh.mesh_files import read_mesh
from tests.fakes.people import CodedTracker, Look, talking, use_coded_faces, write_coded_video, write_people


@pytest.fixture(autouse=True)
def coded_faces(monkeypatch: pytest.MonkeyPatch) -> None:
    use_coded_faces(monkeypatch)


def pictures(looks: list[Look]) -> list[np.ndarray]:
    return [look.picture() for look in looks]


def track(source: Path, out: Path, *options: str) -> int:
    return main(["data", "track", str(source), "-o", str(out), "--workers", "1", "--quiet", *options])


def gaps_of(root: Path, clip: str) -> np.ndarray:
    faces = np.load(root / "vertices_npy" / f"{clip}.npy").reshape(-1, 468, 3)
    upper, lower = np.array(LIP_PAIRS).T
    return np.linalg.norm(faces[:, upper] - faces[:, lower], axis=-1).mean(axis=1)


def test_a_video_becomes_a_sound_corpus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    looks = talking(20, yaw=10.0)
    video = write_coded_video(tmp_path / "maria.mp4", pictures(looks))
    out = tmp_path / "people"
    assert track(video, out, "--clip-seconds", "4", "--licence", "CC-BY-4.0") == 0
    rows = read_clip_table(out)
    assert list(rows) == [f"maria_s{number:03d}" for number in range(1, 6)]
    assert [row["split"] for row in rows.values()] == ["train", "train", "train", "val", "test"]
    truth = np.array([look.gap for look in looks]) * 0.01  # centimetres of the canonical face
    measured = np.concatenate([gaps_of(out, clip) for clip in rows])
    assert len(measured) == len(truth)
    assert np.corrcoef(truth, measured)[0, 1] > 0.995  # no lag
    assert np.abs(truth - measured).mean() < 2e-4
    head = np.load(out / "head_npy" / "maria_s001.npy")
    np.testing.assert_allclose(head.mean(axis=0), [0, 10, 0], atol=0.5)
    np.testing.assert_allclose(np.load(out / "gaze_npy" / "maria_s001.npy"), 0, atol=0.5)
    template = read_templates(out / "templates.pkl")["maria"].numpy()
    assert np.linalg.norm(template[13] - template[14]) < 1e-3  # though the mouth is open in half of the frames
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["licence"]["commercial"] == "allowed"
    assert len(read_mesh(out / "people.ply").vertices) == 468
    capsys.readouterr()
    assert main(["data", "check", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []


def test_uneven_times_give_even_frames(tmp_path: Path) -> None:
    times = np.cumsum(np.random.default_rng(0).choice([0.033, 0.067], 200))
    gaps = 0.45 + 0.4 * np.sin(2 * np.pi * 0.8 * times)
    video = write_coded_video(tmp_path / "eva.mp4", pictures([Look(float(gap)) for gap in gaps]), times=times)
    assert track(video, tmp_path / "people", "--clip-seconds", "60", "--smoothing", "none") == 0
    measured = gaps_of(tmp_path / "people", "eva_s001")
    grid = times[0] + np.arange(len(measured)) / 25
    assert abs(len(measured) / 25 - (times[-1] - times[0])) < 0.08
    assert np.abs(measured - 0.01 * np.interp(grid, times, gaps)).max() < 4e-4


def test_sound_that_begins_late_stays_in_step(tmp_path: Path) -> None:
    click = np.zeros(64_000, np.float32)
    click[16_000:16_400] = 0.8  # one second after the sound's beginning
    video = write_coded_video(tmp_path / "eva.mp4", pictures(talking(5)), sound=click, sound_start=0.4)
    assert track(video, tmp_path / "people", "--clip-seconds", "60") == 0
    import soundfile

    speech = soundfile.read(tmp_path / "people" / "wav" / "eva_s001.wav")[0]
    assert abs(int(np.abs(speech).argmax()) / 16_000 - 1.4) < 0.04


@pytest.mark.parametrize(
    ("between", "clips"),
    [
        ([], 1),
        ([Look(faces=0)] * 4, 1),  # 0.16 s are interpolated
        ([Look(faces=0)] * 12, 2),
        ([Look(scale=0.6)], 2),  # a jump to a larger face, and back
    ],
)
def test_cuts_and_long_gaps_part_clips(tmp_path: Path, between: list[Look], clips: int) -> None:
    video = write_coded_video(tmp_path / "eva.mp4", pictures([*talking(4), *between, *talking(4, seed=1)]))
    assert track(video, tmp_path / "people", "--clip-seconds", "60") == 0
    rows = read_clip_table(tmp_path / "people")
    assert len(rows) == clips
    if len(between) == 4:
        confidence = np.load(tmp_path / "people" / "confidence_npy" / "eva_s001.npy")
        assert np.isnan(confidence).sum() == int(rows["eva_s001"]["missed"]) == 4


@pytest.mark.parametrize(
    ("looks", "options", "problem"),
    [
        ([Look(faces=0)] * 100, {}, "shows no face in 100 of 100 frames"),
        (talking(4, faces=2), {}, "shows several faces; say which with --face"),
        (talking(4, yaw=40), {}, "turned by more than 35°"),
        (talking(1), {}, "has no 2 s of one face"),
        (talking(4), {"audible": False}, "has no sound track"),
        (talking(4), {"sound": np.zeros(64_000, np.float32)}, "holds only silence"),
    ],
)
def test_videos_that_cannot_be_used(
    tmp_path: Path, looks: list[Look], options: dict[str, object], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    video = write_coded_video(tmp_path / "eva.mp4", pictures(looks), **options)  # type: ignore[arg-type]
    assert track(video, tmp_path / "people") == 2
    assert problem in capsys.readouterr().err


@pytest.mark.parametrize(
    ("looks", "options", "warning"),
    [
        ([Look(0.5 + 0.4 * look.gap) for look in talking(4)], {}, "the mouth is open in more than 90 % of the frames"),
        (talking(4, scale=0.25), {}, "; 80 are exact: film nearer"),
        (talking(4), {"times": np.arange(100) / 20}, "20.0 frames a second; below 24, closures of 60 ms are missed"),
        ([look for look in talking(2) for _ in range(2)], {}, "pictures are repeated; use the recording before"),
        (talking(4), {}, "the face model has SHA-256 000"),
    ],
)
def test_videos_that_are_worse_than_they_could_be(
    tmp_path: Path, looks: list[Look], options: dict[str, Any], warning: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert track(write_coded_video(tmp_path / "eva.mp4", pictures(looks), **options), tmp_path / "people") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("eva: 1 clip (in no split; more video gives more clips), 0.1 min")
    assert [warning in line for line in lines if line.startswith("warning: ")].count(True) == 1


def test_a_good_video_has_no_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("facediff.data.track.corpus.SHA256", "0" * 64)
    looks = [Look(0.5 + 0.5 * float(gap)) for gap in np.sin(np.arange(200))]
    video = write_coded_video(tmp_path / "eva.mp4", pictures(looks))
    assert track(video, tmp_path / "people", "--clip-seconds", "2") == 0
    assert "warning" not in capsys.readouterr().out


def test_noise_of_the_brows_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    random, still = np.random.default_rng(0), CodedTracker.landmarks

    def trembling(tracker: CodedTracker, picture: np.ndarray) -> tuple[np.ndarray, float] | None:
        found = still(tracker, picture)
        assert found is not None
        found[0][list(BROWS)] += random.normal(0, 1, (len(BROWS), 3))
        return found

    monkeypatch.setattr(CodedTracker, "landmarks", trembling)
    assert track(write_coded_video(tmp_path / "eva.mp4", pictures(talking(4))), tmp_path / "people") == 0
    assert "the motion of the brows is mostly noise (difference ratio 1.7" in capsys.readouterr().out


def test_a_video_becomes_a_speaker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_coded_video(tmp_path / "eva.mp4", pictures(talking(6)))
    words = ["person", "eva.mp4", "-o", "eva.ckpt", "--clip-seconds", "2", "--quiet", "--steps"]
    assert main([*words, "2"]) == 0
    model = facediff.load("eva.ckpt")
    assert (model.identities, model.corpus) == (["eva"], "people")
    times = np.arange(16_000) / 16_000
    speech = (0.3 * np.sin(2000 * times) * np.sin(9 * times)).astype(np.float32)
    before = model.animate(speech, 16_000, seed=0)
    assert before.vertices.shape == (25, 468, 3)
    assert np.isfinite(before.vertices).all()
    write_coded_video(tmp_path / "other.mp4", pictures(talking(6, seed=3)))
    assert main(["person", "other.mp4", "--name", "eva", *words[2:], "2"]) == 0  # another video is another training
    assert "the clips of eva.mp4 are replaced" in capsys.readouterr().out
    assert not np.array_equal(facediff.load("eva.ckpt").animate(speech, 16_000, seed=0).vertices, before.vertices)
    monkeypatch.setattr("facediff.data.track.recording.FaceTracker", None)  # tracks are there already
    assert main([*words, "4"]) == 0  # goes on
    assert not np.array_equal(facediff.load("eva.ckpt").animate(speech, 16_000, seed=0).vertices, before.vertices)


def test_a_model_needs_two_clips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = write_coded_video(tmp_path / "eva.mp4", pictures(talking(4)))
    assert main(["person", str(video), "-o", str(tmp_path / "eva.ckpt"), "--quiet"]) == 2
    assert "eva.mp4: gives a single clip, and training needs two" in capsys.readouterr().err
    assert not (tmp_path / "eva.ckpt").exists()


def test_one_of_several_faces_is_chosen(tmp_path: Path) -> None:
    video = write_coded_video(tmp_path / "eva.mp4", pictures(talking(4, faces=2)))
    assert track(video, tmp_path / "people", "--face", "left") == 0


def test_what_is_no_video_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "eva.mp4").write_bytes(b"no video at all" * 100)
    assert track(tmp_path / "eva.mp4", tmp_path / "people") == 2
    assert "eva.mp4" in capsys.readouterr().err


def test_people_are_added_and_a_bad_video_stops_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    videos = write_people(tmp_path / "videos", {"ada": [talking(3), talking(3, seed=1)], "ben": [talking(3)]})
    write_coded_video(videos / "ben" / "dark.mp4", pictures([Look(faces=0)] * 80))
    out = tmp_path / "people"
    assert track(videos, out) == 1
    assert "not used" in capsys.readouterr().out
    first = (out / "vertices_npy" / "ada_s001.npy").stat().st_mtime_ns
    write_people(tmp_path / "more", {"cleo": [talking(3)]})
    assert track(tmp_path / "more", out, "--licence", "CC0-1.0") == 0
    (terms,) = People(root=str(out)).licences()
    assert (terms.name, terms.commercial) == ("unknown; CC0-1.0", "unknown"), "the others' too"
    data = People(root=str(out), test_people=0.0)
    assert {data.words_of(clip) for clip in data.corpus.clips.values()} == set(data.corpus.clips), "all say other words"
    assert {row["subject"] for row in read_clip_table(out).values()} == {"ada", "ben", "cleo"}
    assert (out / "vertices_npy" / "ada_s001.npy").stat().st_mtime_ns == first
    assert sorted(read_templates(out / "templates.pkl")) == ["ada", "ben", "cleo"]
    write_people(tmp_path / "third", {"cleo": [talking(4)]})
    assert track(tmp_path / "third", out) == 0
    assert "replaces the clips of" in "".join(capsys.readouterr()), "another video of that name"
    assert track(tmp_path / "more", out, "--scale", "iris") == 2
    assert "was begun with other settings" in capsys.readouterr().err


def test_tracks_are_kept_for_the_next_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    videos = write_people(tmp_path / "videos", {"ada": [talking(3), talking(3, seed=1)]})
    out = tmp_path / "people"
    assert track(videos / "ada", out) == 0
    before = {path: path.read_bytes() for path in (out / "vertices_npy").iterdir()}
    (out / "track.json").write_text(json.dumps(json.loads((out / "manifest.json").read_text())["options"]))
    (out / "manifest.json").unlink()  # as a run leaves it that was stopped while it wrote
    monkeypatch.setattr("facediff.data.track.recording.FaceTracker", None)
    assert track(videos / "ada", out) == 0
    assert {path: path.read_bytes() for path in (out / "vertices_npy").iterdir()} == before


def test_irises_can_set_the_scale(tmp_path: Path) -> None:
    video = write_coded_video(tmp_path / "eva.mp4", pictures(talking(3)))
    assert track(video, tmp_path / "one") == 0
    assert track(video, tmp_path / "other", "--scale", "iris") == 0
    one, other = (np.load(tmp_path / name / "vertices_npy" / "eva_s001.npy") for name in ("one", "other"))
    np.testing.assert_allclose(other, one * 11.7 / 12.0, rtol=2e-3)


def test_splits_of_one_person_and_of_many(tmp_path: Path) -> None:
    names = ["ada", "ben", "cleo", "dan", "eve"]
    out = tmp_path / "people"
    write_people(tmp_path / "videos", {name: [talking(2.04, seed=i) for i in range(4)] for name in names})
    write_people(tmp_path / "videos", {"fay": [talking(2.04)]})
    assert track(tmp_path / "videos", out) == 0
    data = People(root=str(out), test_people=0.34)
    unseen = sorted({*names, "fay"} - {*data.identities})
    assert len(unseen) == 2
    assert {clip.identity for clip in data.clips("train")} == {*data.identities} - {"fay"}
    by_split = {split: {clip.identity for clip in data.clips(split)} for split in ("val", "test_a", "test_b")}
    assert by_split["val"] == by_split["test_a"] == {*data.identities} - {"fay"}
    assert by_split["test_b"] == {*unseen} - {"fay"}
    assert all(data.find_split(clip) is None for clip in data.corpus.clips.values() if clip.identity == "fay")
    assert People(root=str(out), extra_identities=["ada"]).identities == ["ada"]
    pack(out, tmp_path / "people.zarr", exact="none", workers=1)
    assert People(root=str(tmp_path / "people.zarr"), test_people=0.34)._splits == data._splits
    assert main(["data", "check", str(tmp_path / "people.zarr"), "--quick"]) == 0


def test_a_video_joins_a_corpus_of_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    videos = write_people(tmp_path / "videos", {"ada": [talking(3), talking(3, seed=1)], "ben": [talking(3)]})
    people, entry = tmp_path / "people", tmp_path / "ben"
    assert track(videos / "ada", people) == 0
    words = ["data", "import-person", str(videos / "ben" / "film0.mp4"), "--name", "ben", "--corpus", str(people)]
    assert main([*words, "-o", str(entry)]) == 0
    data = People(root=str(people), people=[str(entry)])
    assert data.identities == ["ben", "ada"]
    assert {clip.identity for clip in data.clips("train")} == {"ada", "ben"}
    assert main(["data", "check", str(entry), "--quick", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["data", "import-person", str(tmp_path / "m.npy"), "--name", "e", "--corpus", "x", "-o", "y"]) == 2


def test_an_unseen_persons_only_clip_stops_no_test(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    videos = write_people(
        tmp_path / "videos", {"ada": [talking(2.4)] * 4, "ben": [talking(2.4)] * 2, "fay": [talking(2.4)]}
    )
    assert track(videos, tmp_path / "people") == 0
    data = People(root=str(tmp_path / "people"), extra_identities=["ada"])
    data._splits = {name: "test_b" if name[:3] in ("ben", "fay") else "train" for name in data.corpus.clips}
    assert [clip.identity for clip in data.dataset("test_b").clips] == ["ben", "ben"]
    assert "their speakers' only clips: fay_s001" in capsys.readouterr().out


def test_a_corpus_keeps_its_own_frame_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_people(tmp_path / "videos", {"ada": [talking(3, seed=i) for i in range(4)]})
    assert track(tmp_path / "videos", tmp_path / "people", "--frame-rate", "30") == 0
    data = People(root=str(tmp_path / "people"))
    sample = data.dataset("train", training=True)[0]
    assert (data.frame_rate, data.assets().frame_rate) == (30.0, 30.0)
    pack(tmp_path / "people", tmp_path / "people.zarr", exact="none", workers=1)
    assert People(root=str(tmp_path / "people.zarr")).assets().frame_rate == 30.0
    assert abs(len(sample.audio) - len(sample.motion) * 16_000 / 30) < 16_000 / 30
    capsys.readouterr()
    assert main(["data", "check", str(tmp_path / "people"), "--json"]) == 0
    kinds = {finding["kind"] for finding in json.loads(capsys.readouterr().out)["findings"]}
    assert kinds == {"copy"}  # the sounds of these videos are alike
