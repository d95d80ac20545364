"""Every flaw, planted alone into a sound corpus, has its own finding; the sound corpus has none."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from facediff.cli.app import run
from tests.fakes.tiny import VERTICES, write_tiny

CLIP = "A_e07"
FRAMES = 26


def motion(root: Path, clip: str = CLIP) -> Path:
    return root / "vertices_npy" / f"{clip}.npy"


def sound(root: Path, clip: str = CLIP) -> Path:
    return root / "wav" / f"{clip}.wav"


def change(path: Path, how: Callable[[np.ndarray], np.ndarray]) -> None:
    """Read, change and write a file of motion."""
    np.save(path, how(np.load(path)))


def change_sound(path: Path, how: Callable[[np.ndarray], np.ndarray], subtype: str = "PCM_16") -> None:
    samples, rate = soundfile.read(path)
    soundfile.write(path, how(samples), rate, subtype=subtype)


def change_templates(root: Path, how: Callable[[dict], object]) -> None:
    path = root / "templates.pkl"
    templates = pickle.loads(path.read_bytes())  # noqa: S301 - written by the test
    path.write_bytes(pickle.dumps(how(templates) or templates))


def cut_bytes(path: Path, missing: int) -> None:
    path.write_bytes(path.read_bytes()[:-missing])


def set_rows(array: np.ndarray, rows: list[int], value: float) -> np.ndarray:
    array[rows, 4] = value
    return array


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("bomb-went-off",)


def other_clip(root: Path, name: str) -> None:
    """A further clip whose files are nobody's copy."""
    np.save(motion(root, name), np.load(motion(root)) + np.float32(1e-5))
    samples, rate = soundfile.read(sound(root))
    soundfile.write(sound(root, name), 0.9 * samples, rate)


def add_stranger(root: Path) -> None:
    other_clip(root, "Z_e01")
    change_templates(root, lambda t: t.update(Z=t["A"] + 1e-5))


def write_manifest(root: Path, **fields: object) -> None:
    (root / "manifest.json").write_text(json.dumps(fields))


def swap_for_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def wide(array: np.ndarray) -> np.ndarray:
    """The same motion with six vertices more."""
    return np.concatenate([array, array[:, :18]], 1)


def remove_training_clips(root: Path) -> None:
    for path in (*root.glob("wav/[AB]_e0[1-4].wav"), *root.glob("vertices_npy/[AB]_e0[1-4].npy")):
        path.unlink()
    (root / "clips.csv").unlink()  # its rows would be of clips that are not here


def silent_header(root: Path) -> None:
    """A wav whose header promises more than there is, as an interrupted copy has it."""
    cut_bytes(sound(root), 20_000)


def write_region(root: Path, text: str) -> None:
    (root / "regions" / "lve.txt").write_text(text)


@pytest.fixture(scope="module")
def sound_corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("check") / "tiny")


@pytest.fixture
def root(sound_corpus: Path, tmp_path: Path) -> Path:
    return shutil.copytree(sound_corpus, tmp_path / "tiny")


def examined(root: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict]:
    """Exit status and report of the command."""
    status = run("data check", [str(root), "--corpus", "tests.fakes.tiny.Tiny", "--json", *options])
    return status, json.loads(capsys.readouterr().out)


Plant = Callable[[Path], object]
ERRORS: list[tuple[str, Plant, set[str], str]] = [
    ("motion cut short", lambda r: cut_bytes(motion(r), 100), {"motion_unreadable"}, "not a readable"),
    ("motion of text", lambda r: motion(r).write_text("no motion\n" * 20), {"motion_unreadable"}, "not a readable"),
    ("motion of whole numbers", lambda r: change(motion(r), lambda a: a.astype(int)), {"motion_unreadable"}, "int64"),
    (
        "one clip of another topology",
        lambda r: change(motion(r), wide),
        {"motion_unreadable"},
        f"expected (frames, {3 * VERTICES})",
    ),
    (
        "NaN frames",
        lambda r: change(motion(r), lambda a: set_rows(a, [5, 9], np.nan)),
        {"motion_unreadable"},
        "frame 5 holds NaN",
    ),
    ("still motion", lambda r: change(motion(r), lambda a: a[:1].repeat(FRAMES, 0)), {"motion_still"}, "never moves"),
    (
        "millimetres",
        lambda r: change(motion(r), lambda a: 1000 * a),
        {"motion_far_from_template"},
        "times as large",
    ),
    (
        "head motion",
        lambda r: change(motion(r), lambda a: a + np.float32(0.04)),
        {"motion_far_from_template"},
        "head motion",
    ),
    (
        "motion copied",
        lambda r: shutil.copy(motion(r), motion(r, "B_e07")),
        {"copy"},
        "vertices_npy/B_e07.npy",
    ),
    ("sound of text", lambda r: sound(r).write_text("no sound\n" * 20), {"sound_unreadable"}, "not a readable"),
    ("sound cut short", silent_header, {"sound_unreadable"}, "20000 bytes are missing"),
    ("silence", lambda r: change_sound(sound(r), np.zeros_like), {"sound_silent"}, "silent"),
    (
        "NaN in sound",
        lambda r: change_sound(sound(r), lambda s: np.where(np.arange(len(s)) == 9, np.nan, s), "FLOAT"),
        {"sound_unreadable"},
        "finite numbers",
    ),
    ("speech of another clip", lambda r: change_sound(sound(r), lambda s: s[:6000]), {"length"}, "do not belong"),
    (
        "subject without template",
        lambda r: change_templates(r, lambda t: t.pop("B") is None or t),
        {"template_missing"},
        "no template of B, needed by 7 clips",
    ),
    ("templates of text", lambda r: (r / "templates.pkl").write_text("x"), {"templates_unreadable"}, "not a pickle"),
    (
        "NaN in a template",
        lambda r: change_templates(r, lambda t: t["A"].__setitem__((3, 1), np.nan)),
        {"template_broken"},
        "1 coordinates",
    ),
    (
        "mesh of another topology",
        lambda r: trimesh.creation.box().export(r / "tiny.ply"),
        {"mesh_broken"},
        "has 8 vertices, expected 24",
    ),
    ("no region", lambda r: (r / "regions" / "lve.txt").unlink(), {"region_missing"}, "data.lips=all"),
    (
        "lip pair too high",
        lambda r: (r / "regions" / "inner_lip_pairs.txt").write_text("0, 24\n"),
        {"region_broken"},
        "below 24",
    ),
    (
        "table without clips",
        lambda r: (r / "clips.csv").write_text("a,b\n1,2\n"),
        {"clips_table"},
        "with the column clip",
    ),
    ("no training clip", remove_training_clips, {"no_training_clip"}, "nothing can be trained"),
    (
        "manifest of text",
        lambda r: (r / "manifest.json").write_text("{"),
        {"manifest_unreadable"},
        "not readable as JSON",
    ),
    ("odd frame rate", lambda r: write_manifest(r, frame_rate=26), {"frame_rate"}, "frame_rate is 26"),
    (
        "twice the frame rate",
        lambda r: write_manifest(r, frame_rate=50),
        {"frame_rate"},
        "about 25 motion frames for each second of speech, but manifest.json says 50",
    ),
    (
        "file of the manifest missing",
        lambda r: write_manifest(r, files={"gone.txt": {"bytes": 1, "sha256": ""}}),
        {"file_missing"},
        "not there",
    ),
    (
        "file changed, size kept",
        lambda r: write_manifest(r, files={"clips.csv": {"bytes": (r / "clips.csv").stat().st_size, "sha256": "0"}}),
        {"file_changed"},
        "not what was written",
    ),
    (
        "manifest names a file outside",
        lambda r: write_manifest(r, files={"../x": {"bytes": 1, "sha256": ""}, "/etc/hosts": {}, "clips.csv": 1}),
        {"manifest_entry"},
        "no entry of a file below",
    ),
    ("unfinished", lambda r: (r / "prepare.json").write_text("{}"), {"unfinished"}, "was interrupted"),
]
HARMLESS: list[tuple[str, Plant, set[str], str]] = [
    ("half precision", lambda r: change(motion(r), lambda a: a.astype("f2")), {"motion_dtype"}, "half precision"),
    ("speech too short", lambda r: change_sound(sound(r), lambda s: s[:-3200]), {"speech_shorter"}, "with silence"),
    (
        "speech too long",
        lambda r: change_sound(sound(r), lambda s: np.concatenate([s, s[:3200]])),
        {"speech_longer"},
        "left out",
    ),
    ("sound copied", lambda r: shutil.copy(sound(r), sound(r, "B_e07")), {"copy"}, "wav/B_e07.wav"),
    ("motion is a pipe", lambda r: swap_for_pipe(motion(r)), {"motion_missing"}, "speech without motion"),
    ("wav without npy", lambda r: motion(r).unlink(), {"motion_missing"}, "speech without motion"),
    ("npy without wav", lambda r: sound(r).unlink(), {"sound_missing"}, "motion without speech"),
    ("an unseen subject", add_stranger, {"unknown_subject"}, "in no split of tiny (Z)"),
    ("no mesh", lambda r: (r / "tiny.ply").unlink(), {"mesh_missing"}, "templates/tiny.ply"),
    ("failed clips", lambda r: write_manifest(r, failed={"A_e09": "no sound"}), {"prepare_failed"}, "A_e09: no sound"),
    (
        "table with a misspelt clip",
        lambda r: (r / "clips.csv").write_text((r / "clips.csv").read_text().replace("A_e01", "A_eO1")),
        {"clips_table"},
        "not here: A_eO1; a misspelt name",
    ),
    ("index named twice", lambda r: write_region(r, "1,2,2"), {"region_repeats"}, "1 index of lips"),
]


def test_a_sound_corpus_has_no_finding(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options in ((), ("--quick",)):
        status, report = examined(root, capsys, *options)
        assert (status, report["sound"], report["findings"]) == (0, True, [])


@pytest.mark.parametrize(
    ("name", "plant", "kinds", "words"), ERRORS + HARMLESS, ids=lambda value: value if isinstance(value, str) else ""
)
def test_a_flaw_makes_a_corpus_not_sound_and_a_blemish_does_not(
    root: Path, capsys: pytest.CaptureFixture[str], name: str, plant: Plant, kinds: set[str], words: str
) -> None:
    plant(root)
    status, report = examined(root, capsys)
    assert {finding["kind"] for finding in report["findings"]} == kinds
    assert any(words in finding["message"] for finding in report["findings"]), report["findings"]
    flawed = name in [case[0] for case in ERRORS]
    assert {finding["severity"] for finding in report["findings"]} <= ({"error"} if flawed else {"warning", "note"})
    assert (status, report["sound"]) == ((1, False) if flawed else (0, True))


@pytest.mark.parametrize("file", ["templates.pkl", f"vertices_npy/{CLIP}.npy"])
def test_a_pickle_that_would_run_code_is_reported_and_not_run(
    root: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    monkeypatch.chdir(root.parent)
    (root / file).write_bytes(pickle.dumps({"A": Bomb()}))
    status, report = examined(root, capsys)
    assert status == 1
    assert [finding["where"] for finding in report["findings"]] == [file]
    np.save(root / file, np.array([Bomb()], object)) if file.endswith(".npy") else None
    assert examined(root, capsys)[0] == 1
    assert not (root.parent / "bomb-went-off").exists()


def test_quick_reads_no_content(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(motion(root), lambda a: set_rows(a, [5], np.nan))
    shutil.copy(motion(root, "B_e06"), motion(root, "B_e07"))
    assert examined(root, capsys, "--quick")[0] == 0
    assert examined(root, capsys)[0] == 1
    cut_bytes(motion(root), 100)
    assert examined(root, capsys, "--quick")[0] == 1


def test_a_wav_from_a_pipe_is_whole(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Programs that write to a pipe leave the largest number where the size belongs."""
    data = sound(root).read_bytes()
    place = data.index(b"data") + 4
    sound(root).write_bytes(data[:place] + struct.pack("<I", 0xFFFFFFFF) + data[place + 4 :])
    assert examined(root, capsys)[1]["findings"] == []


def test_damaged_headers_of_all_sorts_are_reported(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No byte of a header of motion or sound, set to anything, ends the check."""
    rng = np.random.default_rng(3)
    for path in (motion(root), sound(root)):
        data = bytearray(path.read_bytes())
        for _ in range(40):
            hurt = bytearray(data)
            for place in rng.integers(0, 128 if path.suffix == ".npy" else 44, 3):
                hurt[place] = rng.integers(256)
            path.write_bytes(hurt)
            status, report = examined(root, capsys, "--quick")
            assert status == (0 if report["sound"] else 1)
        path.write_bytes(data)
    assert examined(root, capsys)[0] == 0
