"""3DMEAD from its raw distributions: parameters to vertices, the sound, the shape of a face, and damaged data."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data import Mead3D
from facediff.data.preparation import PreparationReport, prepare
from facediff.data.prepare import mead3d
from facediff.data.prepare.mead3d import find_sounds
from facediff.errors import FaceDiffError
from facediff.mesh.flame import Flame
from facediff.mesh.mesh_files import read_mesh
from facediff.speech.audio import read_speech
from facediff.utils.pickles import load_pickle
from tests.fakes.flame import VERTICES, flame_arrays, write_flame
from tests.fakes.mead3d import (
    CLIPS,
    EMOTIONS,
    emote_folder,
    frames_of,
    parameters_of,
    speech_of,
    write_hdf5,
    write_raw_emote,
    write_raw_probtalk3d,
    write_wav,
)
from tests.fakes.vocaset import flame_masks, python2_pickle

PAIR = ("M003_001_0_0", "M003_002_0_0")
CLIP = PAIR[0]
Parts = dict[str, np.ndarray]


class MiniMead(Mead3D):
    n_vertices = VERTICES


@pytest.fixture(scope="module")
def flame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flame(tmp_path_factory.mktemp("flame") / "generic_model.pkl")


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Two clips of one speaker, of different lengths."""
    return write_raw_emote(tmp_path / "raw", clips=PAIR, audio="wav")


def prepared(raw: Path, flame: Path, out: str = "out", **options: object) -> tuple[Path, PreparationReport]:
    target = raw.parent / out
    return target, prepare(mead3d.plan(raw, flame=flame, **options), target, workers=1)  # type: ignore[arg-type]


def hdf5(raw: Path, name: str = CLIP) -> Path:
    return raw / "EMICA-MEAD_flame2020" / emote_folder(name) / "shape_pose_cam.hdf5"


def problem(raw: Path, flame: Path) -> str:
    """Why the first of the two clips fails; the second does not."""
    report = prepared(raw, flame)[1]
    assert list(report.failed) == [CLIP]
    assert list(report.clips) == [PAIR[1]]
    return report.failed[CLIP]


def motion_of(out: Path, name: str) -> np.ndarray:
    return np.load(out / "vertices_npy" / f"{name}.npy").reshape(-1, VERTICES, 3)


def mean_shape(subject: str, clips: tuple[str, ...] = CLIPS) -> np.ndarray:
    """Mean over all frames of all clips: longer clips weigh more."""
    frames = [parameters_of(name)["shape"] for name in clips if name.startswith(subject)]
    return np.concatenate(frames).astype(np.float64).mean(0)


def test_vertices_are_the_models_for_the_parameters_on_disk(tmp_path: Path, flame: Path) -> None:
    out, report = prepared(write_raw_emote(tmp_path / "raw", audio="wav"), flame)
    model = Flame.read(flame)
    assert sorted(report.clips) == sorted(CLIPS)
    assert not report.failed
    templates = load_pickle(out / "templates.pkl")
    assert sorted(templates) == ["M003", "M032", "M037", "W009", "W040"]
    for subject, template in templates.items():
        directions = flame_arrays()["shapedirs"][..., :300]
        np.testing.assert_allclose(template, model.template + directions @ mean_shape(subject), atol=1e-12)
    for name in CLIPS:
        parts = parameters_of(name)
        stored = np.load(out / "vertices_npy" / f"{name}.npy")
        assert stored.dtype == np.float32
        assert stored.shape == (frames_of(name), 3 * VERTICES) == (report.clips[name], 3 * VERTICES)
        expected = model.vertices(mean_shape(name[:4]), parts["exp"], parts["jaw"]).astype(np.float32)
        np.testing.assert_allclose(stored.reshape(-1, VERTICES, 3), expected, rtol=0, atol=1e-7)


def test_a_clips_offsets_are_motion_alone(raw: Path, flame: Path) -> None:
    """Without expression and with the jaw at rest, nothing moves, whatever shape a clip has."""
    for name in PAIR:
        still = {**parameters_of(name), "exp": np.zeros((5, 100)), "jaw": np.zeros((5, 3))}
        write_hdf5(hdf5(raw, name), {**still, "shape": still["shape"][:5]})
    out, _ = prepared(raw, flame)
    template = load_pickle(out / "templates.pkl")["M003"]
    for name in PAIR:
        np.testing.assert_allclose(motion_of(out, name), template.astype(np.float32)[None].repeat(5, 0), atol=1e-7)


def test_all_forms_give_the_same_corpus(tmp_path: Path, flame: Path) -> None:
    """EMOTE's files, older ones by hickle, and ProbTalk3D's arrays: equal parameters, equal bytes."""
    clips = CLIPS[::4]
    raws = [
        write_raw_emote(tmp_path / "flat", clips=clips, audio="wav"),
        write_raw_emote(tmp_path / "hickle", clips=clips, audio="wav", form="hickle"),
        write_raw_probtalk3d(tmp_path / "probtalk3d", clips=clips),
    ]
    outs = [prepared(raw, flame, f"out{i}")[0] for i, raw in enumerate(raws)]
    first, *others = [
        {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()} for out in outs
    ]
    assert {f"wav/{name}.wav" for name in clips} < set(first)
    for other in others:
        assert {name for name in first if first[name] != other.get(name)} <= {"manifest.json"}
        assert set(other) == set(first)


def test_fewer_coefficients_and_other_batches(raw: Path, flame: Path) -> None:
    """Fifty expressions, a hundred shapes, a shape given once for the whole clip; the rest is zero."""
    parts = parameters_of(CLIP)
    write_hdf5(hdf5(raw), {"shape": parts["shape"][:1, :100], "exp": parts["exp"][:, :50], "jaw": parts["jaw"]})
    next((raw / "MEAD").rglob("002.wav")).unlink()
    hdf5(raw, PAIR[1]).unlink()
    out, report = prepared(raw, flame)
    assert not report.failed
    full = np.zeros((len(parts["exp"]), 100))
    full[:, :50] = parts["exp"][:, :50]
    shape = np.concatenate([parts["shape"][0, :100], np.zeros(200)])
    expected = Flame.read(flame).vertices(shape, full, parts["jaw"])
    np.testing.assert_allclose(motion_of(out, CLIP), expected, atol=1e-7)


def test_shared_files_next_to_the_clips(tmp_path: Path, flame: Path) -> None:
    raw = write_raw_emote(tmp_path / "raw", audio="wav")
    (raw / "FLAME_masks.pkl").write_bytes(python2_pickle(flame_masks(VERTICES)))
    out, report = prepared(raw, flame)
    rows = list(csv.DictReader((out / "clips.csv").read_text().splitlines()))
    assert [row["clip"] for row in rows] == sorted(CLIPS)
    for row in rows:
        subject, number, emotion, intensity = row["clip"].split("_")
        word = EMOTIONS[int(emotion)]
        assert row["subject"] == subject
        assert (row["emotion"], row["intensity"]) == (word, str(int(intensity) + 1))
        assert row["sentence"] == f"{word}_{number}"
    mesh = read_mesh(out / "FLAME.ply")
    np.testing.assert_array_equal(mesh.faces, flame_arrays()["f"])
    np.testing.assert_allclose(mesh.vertices, flame_arrays()["v_template"], atol=1e-7)
    assert (out / "FLAME_masks.pkl").is_file()
    assert not any(key.startswith("regions") for key in report.missing)
    data = MiniMead(root=str(out), split="identity")
    assert {clip.attributes["emotion"] for clip in data.clips("test_b")} == {"neutral", "contempt"}
    assert sorted(data.assets().templates) == sorted({name[:4] for name in CLIPS})


def test_the_sound_of_meads_own_files(tmp_path: Path, flame: Path) -> None:
    """AAC loses a little, but nothing may be shifted: 20 ms are half a frame."""
    raw = write_raw_emote(tmp_path / "raw", clips=PAIR, audio="m4a")
    out, report = prepared(raw, flame)
    assert not report.failed
    for name in PAIR:
        found, info = read_speech(out / "wav" / f"{name}.wav"), soundfile.info(out / "wav" / f"{name}.wav")
        assert (info.samplerate, info.channels, info.subtype) == (16_000, 1, "PCM_16")
        expected = speech_of(name, 16_000)
        assert 0 <= len(found) - len(expected) < 0.04 * 16_000
        shifts = range(-320, 321)
        padded = np.pad(expected, 400)
        scores = [found[: len(expected)] @ padded[400 + s : 400 + s + len(expected)] for s in shifts]
        assert abs(list(shifts)[int(np.argmax(scores))]) <= 16


def test_sound_is_found_in_all_known_folders(tmp_path: Path) -> None:
    tone = np.zeros(100)
    places = {
        "raw": f"MEAD/{emote_folder(CLIP, 'audio')}.wav",
        "no_audio": f"{CLIP[:4]}/neutral/level_1/001.flac",
        "flat": f"wav/{CLIP}.wav",
        "deep": f"a/b/c/{CLIP}.wav",
    }
    for root, place in places.items():
        path = tmp_path / root / place
        path.parent.mkdir(parents=True)
        soundfile.write(path, tone, 16_000)
        assert find_sounds(tmp_path / root) == {CLIP: path}
    # What is converted already comes before MEAD's own.
    (tmp_path / "raw" / "MEAD" / emote_folder(CLIP, "audio")).with_suffix(".m4a").write_bytes(b"x")
    assert find_sounds(tmp_path / "raw")[CLIP].suffix == ".wav"
    # Neither other files nor MEAD's other cameras are sound.
    (tmp_path / "raw" / "MEAD" / emote_folder(CLIP, "audio")).with_suffix(".txt").write_bytes(b"x")
    video = tmp_path / "video" / emote_folder(CLIP, "video/left_30").replace("001", "002.mp4")
    write_wav(video.with_suffix(".wav"), tone)
    assert find_sounds(tmp_path / "video") == {}


def test_speakers_that_are_not_there_are_named(raw: Path, flame: Path) -> None:
    report = prepared(raw, flame)[1]
    absent = [key for key in report.missing if len(key) == 4]
    assert len(absent) == 46
    assert "M003" not in absent
    assert "M003" in mead3d.plan(raw, flame=flame, subjects=["M003"]).options["subjects"]
    assert not [key for key in mead3d.plan(raw, flame=flame, subjects=["M003"]).missing if len(key) == 4]
    with pytest.raises(
        FaceDiffError, match=r'--subjects: there is no subject of the raw folder "M03": did you mean "M003"'
    ):
        mead3d.plan(raw, flame=flame, subjects=["M03"])


def test_a_clip_without_sound_or_without_parameters_is_missing(raw: Path, flame: Path) -> None:
    next((raw / "MEAD").rglob("002.wav")).unlink()
    extra = hdf5(raw, "M003_005_0_0")
    extra.parent.mkdir(parents=True)
    _, report = prepared(raw, flame)
    assert list(report.clips) == [CLIP]
    assert "expected its sound, M003_002_0_0.wav or M003/audio/…/002.m4a" in report.missing[PAIR[1]]
    assert report.missing["M003_005_0_0"] == f"expected {extra}"


FRAMES = frames_of(CLIP)


def with_nan(key: str) -> Parts:
    parts = parameters_of(CLIP)
    parts[key][3, 1] = np.nan
    return parts


def without(key: str) -> Parts:
    return {name: value for name, value in parameters_of(CLIP).items() if name != key}


def cut(key: str) -> Parts:
    parts = parameters_of(CLIP)
    return {**parts, key: parts[key][:-2]}


@pytest.mark.parametrize("form", ["flat", "hickle"])
@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (without("jaw"), "has no 'jaw'; .*shape, exp, jaw"),
        (without("exp"), "has no 'exp'"),
        (with_nan("exp"), "NaN or infinity"),
        (with_nan("jaw"), "NaN or infinity"),
        (with_nan("shape"), "NaN or infinity"),
        (cut("jaw"), rf"frames do not agree \({FRAMES} of shape, {FRAMES} of exp, {FRAMES - 2} of jaw\)"),
        (cut("shape"), r"frames do not agree"),
        (
            {**without("jaw"), "jaw": np.zeros((FRAMES, 6))},
            r"jaw.* has shape \(1, \d+, 6\) of float64; expected \(1, frames, 3\)",
        ),
        (
            {**without("exp"), "exp": np.zeros((FRAMES, 101))},
            r"exp.* has shape .*101\) of float\d+; expected \(1, frames, up to 100\)",
        ),
        ({key: value[:0] for key, value in parameters_of(CLIP).items()}, r"with at least one frame"),
        ({**without("exp"), "exp": np.full((FRAMES, 3), b"text")}, r"exp.* of \|S4"),
    ],
)
def test_wrong_parameters_cost_one_clip_and_say_why(
    parts: Parts, message: str, form: str, raw: Path, flame: Path
) -> None:
    write_hdf5(hdf5(raw), parts, form)  # type: ignore[arg-type]
    said = problem(raw, flame)
    assert said.startswith(str(hdf5(raw)))
    with pytest.raises(FaceDiffError, match=message):
        raise FaceDiffError(said)


def test_a_repaired_clip_is_written_by_a_second_run_but_shapes_are_never_mixed(raw: Path, flame: Path) -> None:
    """The repaired clip changes the speaker's mean shape, so that the clip that is there has another."""
    whole = hdf5(raw).read_bytes()
    hdf5(raw).write_bytes(b"")
    out, report = prepared(raw, flame)
    assert list(report.failed) == [CLIP]
    hdf5(raw).write_bytes(whole)
    with pytest.raises(FaceDiffError, match=r"mean shape has changed; remove vertices_npy/M003_\* there"):
        prepared(raw, flame)
    for path in out.glob("vertices_npy/M003_*"):
        path.unlink()
    assert sorted(prepared(raw, flame)[1].clips) == list(PAIR)
    fresh, _ = prepared(raw, flame, "fresh")
    for path in fresh.rglob("*.npy"):
        assert (out / path.relative_to(fresh)).read_bytes() == path.read_bytes()
