"""A person's video reconstruction becomes a corpus entry: through real files, against what is known of the person."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import run
from facediff.data.corpus import Corpus, read_manifest
from facediff.errors import FaceDiffError
from facediff.utils.pickles import load_pickle
from tests.fakes.person import (
    FRAMES,
    RATE,
    VERTICES,
    Array,
    Person,
    face,
    lower_face,
    motion,
    person,
    speech,
    write_auxiliary,
    write_speech,
)
from tests.fakes.words import last_of_each

MICRON = 1e-6


@pytest.fixture(scope="module")
def known() -> Person:
    return person()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, known: Person) -> Path:
    """The auxiliary corpus, the sound, and the motion as one array."""
    folder = tmp_path_factory.mktemp("files")
    write_auxiliary(folder / "corpus")
    write_speech(folder / "sound.wav", FRAMES / RATE)
    np.save(folder / "motion.npy", known.seen.astype(np.float32))
    np.save(folder / "neutral.npy", 1000 * face().astype(np.float32) + [0, 0, 90])
    return folder


@pytest.fixture(scope="module")
def brief(files: Path, tmp_path_factory: pytest.TempPathFactory, known: Person) -> Path:
    """The same with the first three seconds of the motion, for tests that do not look at the result."""
    folder = tmp_path_factory.mktemp("brief")
    (folder / "corpus").symlink_to(files / "corpus")
    write_speech(folder / "sound.wav", 3)
    np.save(folder / "motion.npy", known.seen[:90].astype(np.float32))
    return folder


def words(files: Path, motion: str, out: Path, *more: str) -> list[str]:
    given = [str(files / motion), "--audio", str(files / "sound.wav"), "--name", "Target", "--frame-rate", "30"]
    given += ["--corpus", str(files / "corpus"), "-o", str(out), "--clip-seconds", "2"]
    return last_of_each([*given, *more])


def imported(out: Path) -> Array:
    """All clips in one."""
    parts = [np.load(path) for path in sorted((out / "vertices_npy").glob("*.npy"))]
    return np.concatenate(parts).reshape(-1, VERTICES, 3)


@pytest.fixture(scope="module")
def entry(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "deep" / "target"
    assert run("data import-person", words(files, "motion.npy", out)) == 0
    return out


def test_the_motion_is_the_known_one_in_the_corpus_s_coordinates(entry: Path, known: Person) -> None:
    made = imported(entry)
    assert made.shape == known.truth.shape
    assert np.abs(made - known.truth).max() < MICRON
    template = load_pickle(entry / "templates.pkl")["Target"]
    assert template.dtype == np.float32
    calm = np.setdiff1d(np.arange(VERTICES), known.restless)
    assert np.abs(template - face())[calm].max() < MICRON


def test_the_report_tells_what_was_removed(entry: Path, known: Person) -> None:
    report = read_manifest(entry)["report"]
    mean = known.rotations.mean(0)
    u, _, vt = np.linalg.svd(mean)
    traces = np.trace(known.rotations @ (u @ vt).T, axis1=1, axis2=2)
    angles = np.degrees(np.arccos((traces - 1) / 2))
    assert angles.max() > 10
    assert report["rotation_max"] == pytest.approx(angles.max(), abs=1e-3)
    assert report["rotation_rms"] == pytest.approx(np.sqrt((angles**2).mean()), abs=1e-3)
    # The head's centre is that of its stable vertices, which lie within a face's breadth of the model's origin.
    assert report["translation_max"] > 0.02
    assert report["scale"] == pytest.approx(0.001, abs=1e-15)
    assert report["measured_scale"] == pytest.approx(0.001, rel=1e-5)
    assert report["frames"] == report["frames_written"] == FRAMES
    assert report["seconds"] == pytest.approx(8)
    assert report["jitter"] < MICRON
    assert report["topology_residual"] < 0.05
    assert report["warnings"] == []
    still = (np.array(report["template_frames"]) / RATE) % 2
    assert ((still > 1) & (still < 2)).all()  # every other second is silent
    assert len(still) == round(0.05 * FRAMES)


def test_translation_removed_is_that_of_the_head(files: Path, tmp_path: Path, known: Person) -> None:
    """Without rotation, every point of the head moves by the same known amount."""
    np.save(tmp_path / "motion.npy", 1000 * known.truth + known.places[:, None])
    arguments = words(files, "motion.npy", tmp_path / "out")
    arguments[0] = str(tmp_path / "motion.npy")
    assert run("data import-person", arguments) == 0
    report = read_manifest(tmp_path / "out")["report"]
    away = np.linalg.norm(known.places - known.places.mean(0), axis=1) / 1000
    assert report["translation_max"] == pytest.approx(away.max(), rel=1e-4)
    assert report["translation_rms"] == pytest.approx(np.sqrt((away**2).mean()), rel=1e-4)
    assert report["rotation_max"] < 1e-3


def test_the_entry_is_an_ordinary_corpus(entry: Path, files: Path) -> None:
    corpus = Corpus(files / "corpus", VERTICES, RATE, people=[entry])
    clips = [clip for clip in corpus.clips.values() if clip.identity == "Target"]
    assert [clip.name for clip in clips] == ["Target_s01", "Target_s02", "Target_s03", "Target_s04"]
    offset, samples = 0, speech(FRAMES / RATE)
    for clip in clips:
        offsets = corpus.read_motion(clip)
        true = motion(np.arange(offset, offset + len(offsets)) / RATE) - face()
        moving = lower_face()
        assert np.sqrt(((offsets.numpy() - true)[:, moving] ** 2).mean()) < 4e-3  # the restless 2 % are in it
        audio = corpus.read_audio(clip, 0, len(offsets)).numpy()
        first = round(offset * 16000 / RATE)
        assert np.abs(audio - samples[first : first + len(audio)]).max() < 2e-3
        info = soundfile.info(entry / "wav" / f"{clip.name}.wav")
        assert (info.samplerate, info.channels, info.subtype) == (16000, 1, "PCM_16")
        assert info.frames == pytest.approx(len(offsets) * 16000 / RATE, abs=1)
        offset += len(offsets)
    assert offset == FRAMES


def test_clips_are_cut_in_pauses_and_split_by_order(entry: Path) -> None:
    with (entry / "clips.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [list(row.values()) for row in rows] == [
        ["Target_s01", "Target", "s01", "train"],
        ["Target_s02", "Target", "s02", "train"],
        ["Target_s03", "Target", "s03", "val"],
        ["Target_s04", "Target", "s04", "test"],
    ]
    lengths = [len(np.load(entry / "vertices_npy" / f"{row['clip']}.npy", mmap_mode="r")) for row in rows]
    for cut in np.cumsum(lengths)[:-1] / RATE:
        assert cut % 2 > 1, "in a silent second"
    assert min(lengths) >= RATE


def test_the_manifest_describes_every_file(entry: Path) -> None:
    manifest = json.loads((entry / "manifest.json").read_text())
    assert {key: manifest[key] for key in ("corpus", "person", "frame_rate", "n_vertices", "unit")} == {
        "corpus": "person",
        "person": "Target",
        "frame_rate": 30.0,
        "n_vertices": VERTICES,
        "unit": "m",
    }
    there = {path.relative_to(entry).as_posix() for path in entry.rglob("*") if path.is_file()}
    assert set(manifest["files"]) == there - {"manifest.json"}
    for name, facts in manifest["files"].items():
        data = (entry / name).read_bytes()
        assert facts == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    assert [path.name for path in entry.parent.iterdir()] == ["target"]


@pytest.mark.parametrize("double", [False, True])
def test_every_form_of_motion_gives_the_same(files: Path, tmp_path: Path, known: Person, double: bool) -> None:
    frames = known.seen[:90]
    np.save(tmp_path / "motion", frames if double else frames.reshape(90, -1).astype(np.float32))
    write_speech(tmp_path / "sound.wav", 3)
    arguments = words(files, "motion.npy", tmp_path / "out", "--audio", str(tmp_path / "sound.wav"))
    assert run("data import-person", [str(tmp_path / "motion.npy"), *arguments[1:]]) == 0
    assert np.abs(imported(tmp_path / "out") - known.truth[:90]).max() < MICRON
    assert read_manifest(tmp_path / "out")["report"]["splits"] == {"train": 2}


def test_another_frame_rate_is_resampled(files: Path, tmp_path: Path, known: Person) -> None:
    corpus = write_auxiliary(tmp_path / "corpus", rate=25.0)
    out = tmp_path / "out"
    arguments = words(files, "motion.npy", out, "--corpus", str(corpus))
    assert run("data import-person", arguments) == 0
    made = imported(out)
    assert made.shape == (200, VERTICES, 3)
    calm = np.setdiff1d(np.arange(VERTICES), known.restless)
    true = motion(np.arange(200) / 25)
    assert np.abs(made - true)[20:-20, calm].max() < 5e-5  # 0.05 mm of some 15 mm
    manifest = read_manifest(out)
    assert (manifest["frame_rate"], manifest["unit"]) == (25.0, "m")


def test_template_and_stable_vertices_may_be_given(files: Path, tmp_path: Path, known: Person) -> None:
    """The template lies elsewhere than the motion, with another pose; the motion is laid onto it."""
    still = str(files / "corpus" / "regions" / "still.txt")
    out = tmp_path / "out"
    given = ["--template", str(files / "neutral.npy"), "--stable", still]
    assert run("data import-person", words(files, "motion.npy", out, *given)) == 0
    report = read_manifest(out)["report"]
    assert (report["template_frames"], report["stable_vertices"]) == ([], int((~lower_face()).sum()))
    assert report["template_source"].endswith("neutral.npy")
    assert np.abs(load_pickle(out / "templates.pkl")["Target"] - face()).max() < MICRON
    assert np.abs(imported(out) - known.truth).max() < MICRON


def test_a_person_s_size_is_kept_and_another_unit_is_not(files: Path, tmp_path: Path, known: Person) -> None:
    """A head one tenth larger stays larger; a unit that is no power of ten is measured."""
    factors = {}
    for name, factor in (("big", 1.1), ("odd", 3.7)):
        np.save(tmp_path / f"{name}.npy", factor * known.seen[:90])
        write_speech(tmp_path / "sound.wav", 3)
        arguments = words(files, "motion.npy", tmp_path / name, "--audio", str(tmp_path / "sound.wav"))
        assert run("data import-person", [str(tmp_path / f"{name}.npy"), *arguments[1:]]) == 0
        made = imported(tmp_path / name)
        factors[name] = np.ptp(made[0, :, 1]) / np.ptp(known.truth[0, :, 1])
    assert factors == pytest.approx({"big": 1.1, "odd": 1.0}, rel=1e-4)


def nothing_left(folder: Path) -> bool:
    return not [path for path in folder.rglob("*") if "partial" in path.name or path.name == "out"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--name", "../up"], "expected letters"),
        (["--name", "anna"], "has a speaker of that name already"),
        (["--frame-rate", "60"], "expected the same stretch of video; check --frame-rate"),
        (["--corpus", "{tmp}/bare"], r"manifest\.json: has no frame rate"),
        (["--audio", "{tmp}/silent.wav"], r"silent\.wav: holds only silence"),
        (["--template", "{tmp}/small.npy"], r"small\.npy: has 4 vertices"),
        (["--template", "{tmp}/metres.npy"], r"metres\.npy: .* is 0\.001 times as large as the faces of the motion"),
        (["--template", "{tmp}/other.npy"], r"other\.npy: .* does not lie"),
        (["--stable", "{tmp}/beyond.txt"], r"beyond\.txt: .*360"),
        (["--stable", "{tmp}/line.txt"], r"line\.txt: names 2 vertices; expected at least 10"),
        (["-o", "{tmp}/full"], "full: is not empty"),
    ],
)
def test_a_wrong_option_gets_one_sentence(brief: Path, tmp_path: Path, options: list[str], sentence: str) -> None:
    write_auxiliary(tmp_path / "bare", manifest=False)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    soundfile.write(tmp_path / "silent.wav", np.zeros(16000 * 8), 16000)
    np.save(tmp_path / "small.npy", np.zeros((4, 3)))
    np.save(tmp_path / "metres.npy", face())
    np.save(tmp_path / "other.npy", 1000 * face()[::-1])
    (tmp_path / "beyond.txt").write_text("1, 2, 360")
    (tmp_path / "line.txt").write_text("5, 6")
    more = [option.format(tmp=tmp_path) for option in options]
    with pytest.raises(FaceDiffError, match=sentence):
        run("data import-person", words(brief, "motion.npy", tmp_path / "out", *more))
    assert nothing_left(tmp_path)
    assert (tmp_path / "full" / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_an_interruption_or_a_full_disk_leaves_nothing(
    brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("facediff.data.person.importer.write_templates", stop)
    expected = KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else FaceDiffError
    with pytest.raises(expected, match=None if expected is KeyboardInterrupt else "No space left on device"):
        run("data import-person", words(brief, "motion.npy", tmp_path / "new" / "out"))
    assert list(tmp_path.iterdir()) == []
