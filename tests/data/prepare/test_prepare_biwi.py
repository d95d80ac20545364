"""BIWI from its raw distribution: the frames' files, the normalisation, the sound, and damaged data."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data.preparation import PreparationReport, prepare
from facediff.data.prepare import biwi
from facediff.data.prepare.biwi import check_sizes, codetalker, gaps_in, read_vl
from facediff.errors import FaceDiffError
from facediff.mesh import read_mesh
from facediff.utils.pickles import load_pickle
from tests.fakes.biwi import (
    RATE,
    VERTICES,
    faces_of,
    frames_of,
    raw_frames,
    raw_template,
    speech_of,
    vl_bytes,
    write_raw_biwi,
)


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """One sentence of one person: frames 1 to 6."""
    return write_raw_biwi(tmp_path / "raw", subjects=["F2"], sentences=["e01"], frames=6)


def prepared(raw: Path, **options: object) -> tuple[Path, PreparationReport]:
    out = raw.parent / "out"
    return out, prepare(biwi.plan(raw, **options), out, workers=1)  # type: ignore[arg-type]


def problem(raw: Path) -> str:
    """Why the one clip fails."""
    report = prepared(raw)[1]
    assert list(report.failed) == ["F2_e01"]
    assert not (raw.parent / "out" / "wav" / "F2_e01.wav").exists()
    return report.failed["F2_e01"]


def frame(raw: Path, number: int) -> Path:
    return raw / "faces" / "F2" / "e01" / f"frame_{number:03d}.vl"


@pytest.mark.parametrize("header", [4, 8])
def test_vertices_of_a_vl_file_come_back(tmp_path: Path, header: int) -> None:
    vertices = np.random.default_rng(0).normal(0, 100, (23, 3)).astype(np.float32)
    (tmp_path / "frame_001.vl").write_bytes(vl_bytes(vertices, header))
    assert np.array_equal(read_vl(tmp_path / "frame_001.vl"), vertices)


@pytest.mark.parametrize("header", [4, 8])
def test_truncated_vl_files_are_refused(tmp_path: Path, header: int) -> None:
    vertices = np.random.default_rng(0).normal(0, 100, (9, 3)).astype(np.float32)
    whole = vl_bytes(vertices, header)
    files = [tmp_path / f"frame_{i:03d}.vl" for i in range(3)]
    for file in files:
        file.write_bytes(whole)
    check_sizes(files)
    for length in (*range(len(whole)), len(whole) + 1, len(whole) + 12):
        files[1].write_bytes((whole + bytes(12))[:length])
        with pytest.raises(FaceDiffError, match=f"frame_001.vl: has {length} bytes"):
            check_sizes(files)
        # Four bytes off a long header's file look like a short header's file: only the other frames can tell.
        if not (header == 8 and length == len(whole) - 4):
            with pytest.raises(FaceDiffError, match=rf"frame_001\.vl: has {length} bytes.*expected"):
                read_vl(files[1])


def naive_normalisation(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Point by point in plain Python, with exactly rounded sums and Heron's formula for the areas."""
    turned = [(float(x), -float(y), -float(z)) for x, y, z in vertices]
    mean = [math.fsum(point[axis] for point in turned) / len(turned) for axis in range(3)]
    centred = [tuple(point[axis] - mean[axis] for axis in range(3)) for point in turned]
    areas = []
    for corners in faces:
        sides = [math.dist(centred[corners[i]], centred[corners[(i + 1) % 3]]) for i in range(3)]
        half = sum(sides) / 2
        areas.append(math.sqrt(half * (half - sides[0]) * (half - sides[1]) * (half - sides[2])))
    scale = math.sqrt(math.fsum(areas))
    return np.array([[coordinate / scale for coordinate in point] for point in centred])


@pytest.mark.parametrize("header", [4, 8])
def test_the_normalisation_is_codetalkers(tmp_path: Path, header: int) -> None:
    raw = write_raw_biwi(tmp_path / "raw", header=header)
    out, report = prepared(raw)
    assert report.sound
    assert report.clips == {
        f"{s}_{e}": frames_of(("F2", "M3", "F1"), s, e)
        for s in ("F1", "F2", "M3")
        for e in ("e01", "e02", "e33", "e37")
    }
    templates = load_pickle(out / "templates.pkl")
    assert set(templates) == {"F1", "F2", "M3"}
    for subject in ("F1", "M3"):
        expected = naive_normalisation(raw_template(subject), faces_of())
        np.testing.assert_allclose(templates[subject], expected, rtol=0, atol=1e-12)
        assert templates[subject].dtype == np.float64
    motion = np.load(out / "vertices_npy" / "M3_e33.npy")
    frames = raw_frames("M3", "e33", frames_of(("F2", "M3", "F1"), "M3", "e33"))
    assert motion.shape == (len(frames), 3 * VERTICES)
    expected = np.stack([naive_normalisation(frame, faces_of()) for frame in frames]).reshape(motion.shape)
    np.testing.assert_allclose(motion, expected, rtol=0, atol=1e-7)


def test_the_mesh_is_a_training_persons_template(tmp_path: Path) -> None:
    out, _ = prepared(write_raw_biwi(tmp_path / "raw"))
    mesh = read_mesh(out / "BIWI.ply")
    np.testing.assert_allclose(mesh.vertices, load_pickle(out / "templates.pkl")["F2"], atol=1e-7)
    assert np.array_equal(mesh.faces, faces_of())
    assert (out / "regions" / "lve.txt").read_text().startswith(f"{VERTICES // 2}, ")


def test_speech_is_16_khz_of_the_same_length(raw: Path) -> None:
    out, _ = prepared(raw)
    samples, rate = soundfile.read(out / "wav" / "F2_e01.wav")
    assert rate == 16000
    assert samples.shape == (6 * 640,)
    assert soundfile.info(out / "wav" / "F2_e01.wav").subtype == "PCM_16"
    time = np.arange(6 * 640) / 16000
    expected = np.interp(time, np.arange(6 * RATE // 25) / RATE, speech_of("F2", "e01", 6))
    assert np.abs(samples - expected)[200:-200].max() < 0.005


@pytest.mark.parametrize("place", ["wav/F2_e01.wav", "sound/deep/F2_e01_cut.wav", "F2/e01.wav", "audio/F2/e01_cut.wav"])
def test_sound_is_found_in_all_known_folders_and_preferred_to_the_video(raw: Path, place: str) -> None:
    (raw / place).parent.mkdir(parents=True, exist_ok=True)
    (raw / "audio" / "F2_e01.wav").rename(raw / place)
    (raw / "videos").mkdir()
    (raw / "videos" / "F2_e01.flv").write_bytes(b"would fail")
    out, report = prepared(raw)
    assert report.sound
    assert soundfile.info(out / "wav" / "F2_e01.wav").frames == 6 * 640


def test_frames_are_in_numeric_order_and_gaps_are_noted(raw: Path) -> None:
    folder = frame(raw, 1).parent
    frames = raw_frames("F2", "e01", 12)
    shutil.rmtree(folder)
    folder.mkdir()
    for number in (1, 2, 3, 5, 6, 7, 10, 11, 12):
        (folder / f"frame_{number}.vl").write_bytes(vl_bytes(frames[number - 1]))
    out, report = prepared(raw)
    motion = np.load(out / "vertices_npy" / "F2_e01.npy").reshape(9, -1, 3)
    expected = [codetalker(frames[number], faces_of()) for number in (0, 1, 2, 4, 5, 6, 9, 10, 11)]
    np.testing.assert_allclose(motion, expected, atol=1e-7)
    assert [note for note in report.notes if "F2_e01: frames 4, 8 to 9 are not in" in note]


@pytest.mark.parametrize(
    ("numbers", "expected"), [([1, 2], []), ([0, 1, 2], []), ([3, 4, 7], ["1 to 2", "5 to 6"]), ([], []), ([2], ["1"])]
)
def test_gaps(numbers: list[int], expected: list[str]) -> None:
    assert gaps_in(numbers) == expected


def test_neutral_sequences_are_left_out_and_counted(raw: Path) -> None:
    for name in ("01", "02", "40", "41", "notes"):
        shutil.copytree(frame(raw, 1).parent, raw / "faces" / "F2" / name)
    _, report = prepared(raw)
    assert list(report.clips) == ["F2_e01"]
    assert any(note.startswith("3 neutral sequences") for note in report.notes)


@pytest.mark.parametrize("depth", ["", "B3D", "several"])
def test_unpacked_archives_are_found_a_folder_deeper(tmp_path: Path, depth: str) -> None:
    raw = write_raw_biwi(tmp_path / "x", sentences=["e01"], frames=3)
    if depth == "several":
        for subject in ("F2", "M3", "F1"):
            for part in ("faces", "rigid_scans"):
                (tmp_path / "raw" / subject / part).mkdir(parents=True)
            (raw / "faces" / subject).rename(tmp_path / "raw" / subject / "faces" / subject)
            (raw / "rigid_scans" / f"{subject}.obj").rename(
                tmp_path / "raw" / subject / "rigid_scans" / f"{subject}.obj"
            )
        (raw / "audio").rename(tmp_path / "raw" / "audio")
    else:
        (tmp_path / "raw").mkdir()
        raw.rename(tmp_path / "raw" / depth)
    _, report = prepared(tmp_path / "raw")
    assert list(report.clips) == ["F1_e01", "F2_e01", "M3_e01"]


def test_missing_files_are_named(tmp_path: Path) -> None:
    raw = write_raw_biwi(tmp_path / "raw", regions=False)
    (raw / "audio" / "F2_e02.wav").unlink()
    (raw / "rigid_scans" / "M3.obj").unlink()
    shutil.rmtree(raw / "faces" / "F1" / "e33")
    _, report = prepared(raw)
    assert report.sound
    assert set(report.clips) == {"F1_e01", "F1_e02", "F1_e37", "F2_e01", "F2_e33", "F2_e37"}
    assert "audio/F2_e02.wav" in report.missing["F2_e02"]
    assert "videos/F2_e02.flv" in report.missing["F2_e02"]
    assert "rigid_scans/M3.obj" in report.missing["template of M3"]
    assert "faces/F1/e33" in report.missing["F1_e33"]
    assert "faces/M6" in report.missing["M6"]
    for name in ("lve.txt", "fdd.txt"):
        assert f"CodeTalker repository has it as BIWI/regions/{name}" in report.missing[f"regions/{name}"]


def test_regions_may_lie_elsewhere_and_come_later(raw: Path) -> None:
    shutil.rmtree(raw / "regions")
    out, report = prepared(raw)
    assert "regions/lve.txt" in report.missing
    given = raw.parent / "lists"
    with pytest.raises(FaceDiffError, match="lists: expected a folder with lists of vertices"):
        prepared(raw, regions=given)
    given.mkdir()
    (given / "lve.txt").write_text("1, 2")
    (given / "fdd.txt").write_text("3, 4")
    _, report = prepared(raw, regions=given)
    assert report.written == 0
    assert "regions/lve.txt" not in report.missing
    assert (out / "regions" / "lve.txt").read_text() == "1, 2"
    assert "regions/fdd.txt" in json.loads((out / "manifest.json").read_text())["files"]


def test_a_frame_that_is_not_finite(raw: Path) -> None:
    vertices = raw_frames("F2", "e01", 6)[2]
    vertices[5, 1] = np.nan
    frame(raw, 3).write_bytes(vl_bytes(vertices))
    assert str(frame(raw, 3)) in problem(raw)
