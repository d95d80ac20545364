"""Totals and facts of BIWI, VOCASET and 3DMEAD."""

from __future__ import annotations

import hashlib
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import run
from facediff.data import Biwi
from facediff.data.check import check
from tests.data.check import small
from tests.data.check.small import BIWI, MEAD, VOCASET, kinds, message, rows
from tests.fakes import biwi, vocaset


def test_totals_of_a_corpus_without_a_list(fakes: Path) -> None:
    report = check(fakes / "tiny", "tests.fakes.tiny.Tiny")
    # 12 + 2 n frames for sentence n of A, one more for B, two more for C; 25 frames a second.
    assert rows(report) == {
        (None, "train"): (None, 8, None, 14 + 16 + 18 + 20 + 15 + 17 + 19 + 21, 5.6),
        (None, "val"): (None, 2, None, 22 + 23, 1.8),
        (None, "test_a"): (None, 4, None, 24 + 26 + 25 + 27, 4.08),
        (None, "test_b"): (None, 2, None, 26 + 28, 2.16),
        (None, "none"): (None, 5, None, 16 + 18 + 20 + 22 + 24, 4.0),
    }
    subjects = [(row["subject"], row["trained_on"], row["clips"], row["frames"]) for row in report.subjects]
    assert subjects == [("A", True, 7, 140), ("B", True, 7, 147), ("C", False, 7, 154)]


def test_the_json_object_is_complete(copies: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = copies / "tiny"
    (root / "wav" / "A_e01.wav").unlink()
    assert run("data check", [str(root), "--corpus", "tests.fakes.tiny.Tiny", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert set(report) == {
        *("format", "root", "quick", "corpus", "data_module", "sound", "frame_rate", "stored_frame_rate"),
        *("n_vertices", "points", "findings", "splits", "subjects", "templates", "mesh", "regions", "manifest"),
    }
    (finding,) = report["findings"]
    assert finding["severity"] == "warning"
    assert (finding["kind"], finding["where"]) == ("sound_missing", "A_e01")
    assert (report["corpus"], report["data_module"]) == ("tiny", "tests.fakes.tiny.Tiny")
    assert (report["n_vertices"], report["frame_rate"], report["mesh"]) == (24, 25.0, "tiny.ply")
    lips = ",".join(map(str, range(12)))
    assert report["regions"]["lips"] == {
        "source": "regions/lve.txt",
        "count": 12,
        "hash": hashlib.sha256(lips.encode()).hexdigest()[:8],
        "duplicates": 0,
        "circulating_count": None,
    }
    blob = hashlib.sha1(b"blob %d\0" % (root / "templates.pkl").stat().st_size)  # noqa: S324 - git's name for a file
    blob.update((root / "templates.pkl").read_bytes())
    assert report["templates"]["blob"] == blob.hexdigest()
    assert report["templates"]["subjects"] == ["A", "B", "C"]
    assert report["manifest"] == {"there": False, "ended": True, "facediff": None, "changed": [], "missing": []}


def test_a_complete_biwi(fakes: Path) -> None:
    report = check(fakes / "biwi", BIWI)
    # The fake is complete by its own list, so that only the check figure, which is the real BIWI's, can differ.
    assert report.sound
    assert kinds(report, "warning") == ["check_figure_differs"]
    frames = {name: biwi.frames_of(biwi.SUBJECTS, *name.split("_")) for name in ("F2_e37", "M3_e37", "F1_e37")}
    assert rows(report)[None, "test_a"] == (2, 2, 0, frames["F2_e37"] + frames["M3_e37"], pytest.approx(1.68, abs=1))
    assert rows(report)[None, "test_b"] == (1, 1, 0, frames["F1_e37"], frames["F1_e37"] / 25)
    assert "2 sequences and" in message(report, "check_figure_differs")
    assert "24 sequences and 3 879 frames" in message(report, "check_figure_differs")
    assert report.templates["origin"] == "own"
    assert all(area == pytest.approx(1, abs=1e-5) for area in report.templates["areas"].values())
    assert report.regions["lips"] is not None
    assert report.regions["lips"]["circulating_count"] == 4996
    assert kinds(report, "note").count("region_unusual") == 2


def test_test_a_of_biwi_agrees_with_the_check_figure(tmp_path: Path) -> None:
    root = biwi.write_biwi(tmp_path / "biwi", subjects=["F2"], sentences=["e01"])
    (template,) = pickle.loads((root / "templates.pkl").read_bytes()).values()  # noqa: S301 - written above
    people = ("F2", "F3", "F4", "M3", "M4", "M5")
    (root / "templates.pkl").write_bytes(pickle.dumps(dict.fromkeys(people, template)))
    names = [f"{person}_e{sentence}" for person in people for sentence in range(37, 41)]
    for i, name in enumerate(names):
        frames = 162 if i < 15 else 161  # 15 x 162 + 9 x 161 = 3879
        np.save(root / "vertices_npy" / f"{name}.npy", np.zeros((frames, 3 * biwi.VERTICES), "f4"))
        soundfile.write(root / "wav" / f"{name}.wav", np.zeros(frames * 320), 8000)
    report = check(root, BIWI, quick=True)
    assert "check_figure_agrees" in kinds(report, "note")
    assert rows(report)[None, "test_a"][3] == 3879
    (root / "wav" / "F2_e37.wav").unlink()
    assert "check_figure_differs" in kinds(check(root, BIWI, quick=True), "warning")


def test_clips_of_biwi_that_are_missing_are_counted_and_named(copies: Path) -> None:
    root = copies / "biwi"
    for name in ("F2_e02", "M3_e33"):
        (root / "wav" / f"{name}.wav").unlink()
        (root / "vertices_npy" / f"{name}.npy").unlink()
    report = check(root, BIWI, quick=True)
    assert rows(report)[None, "train"][:3] == (4, 3, 1)
    assert rows(report)[None, "val"][:3] == (2, 1, 1)
    told = {f.where: f.message for f in report.findings if f.kind == "clips_missing"}
    assert set(told) == {"split train", "split val"}
    assert "1 clip of 4 not there: F2_e02" in told["split train"]


def test_templates_that_are_swapped(copies: Path) -> None:
    root = copies / "biwi"
    templates = pickle.loads((root / "templates.pkl").read_bytes())  # noqa: S301 - written by the fake
    templates["F2"], templates["M3"] = templates["M3"], templates["F2"]
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    report = check(root, BIWI)
    assert kinds(report) == ["motion_of_another"] * 8
    assert "nearer to the template of M3 than to that of F2" in message(report, "motion_of_another")


def test_templates_without_unit_area(copies: Path) -> None:
    root = copies / "biwi"
    templates = pickle.loads((root / "templates.pkl").read_bytes())  # noqa: S301 - written by the fake
    (root / "templates.pkl").write_bytes(pickle.dumps({name: 1.02 * face for name, face in templates.items()}))
    report = check(root, BIWI)
    assert kinds(report, "warning") == ["template_area", "check_figure_differs"]
    assert "F1 1.04" in message(report, "template_area")
    (root / "manifest.json").write_text(json.dumps({"corpus": "biwi", "unit": "mm"}))
    assert "template_area" not in kinds(check(root, BIWI), "warning")


@pytest.mark.parametrize("origin", ["FaceFormer and TalkingStyle", "FaceDiffuser and DiffSpeaker"])
def test_templates_that_circulate_are_known(copies: Path, monkeypatch: pytest.MonkeyPatch, origin: str) -> None:
    """The real files cannot be had here, so the fake's own blob id is entered in their place."""
    content = (copies / "biwi" / "templates.pkl").read_bytes()
    blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()  # noqa: S324 - git's name for a file
    known = {who: start for start, who in Biwi.circulating.templates.items()}
    assert known == {"FaceFormer and TalkingStyle": "606284c0", "FaceDiffuser and DiffSpeaker": "d436309f"}
    other = next(who for who in known if who != origin)
    facts = replace(Biwi.circulating, templates={blob[:8]: origin, known[other]: other})
    monkeypatch.setattr(small.SmallBiwi, "circulating", facts)
    report = check(copies / "biwi", BIWI, quick=True)
    assert report.templates["origin"] == origin
    assert f"the templates of {origin}" in message(report, "templates_origin")
    assert f"{other} ({known[other]})" in message(report, "templates_origin")


def test_vocaset_at_60_frames_a_second(fakes: Path) -> None:
    report = check(fakes / "vocaset", VOCASET)
    assert kinds(report) == []
    assert (report.frame_rate, report.stored_frame_rate) == (30, 60)
    counts = {
        split: [-(-vocaset.frames_of(subject, sentence) // 2) for subject, sentence in clips]
        for split, clips in {
            "train": [
                *((vocaset.TRAIN, s) for s in ("sentence01", "sentence02", "sentence21")),
                *((vocaset.TRAIN_2, s) for s in ("sentence01", "sentence40")),
            ],
            "val": [(vocaset.VALIDATION, "sentence21"), (vocaset.VALIDATION, "sentence22")],
            "test_b": [(vocaset.TEST, "sentence21"), (vocaset.TEST, "sentence30")],
            "none": [(vocaset.VALIDATION, "sentence01"), (vocaset.TEST, "sentence01")],
        }.items()
    }
    found = rows(report)
    assert {split: row[3] for (_, split), row in found.items()} == {s: sum(c) for s, c in counts.items()}
    assert found[None, "train"][:3] == (320, 5, 315)
    assert found[None, "test_b"][:3] == (40, 2, 38)
    assert kinds(report, "warning").count("clips_missing") == 3


def test_a_few_missing_clips_of_vocaset_are_only_a_note(copies: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = sorted(path.stem for path in (copies / "vocaset" / "wav").iterdir())
    expected = {"train": [n for n in names if vocaset.TRAIN in n or vocaset.TRAIN_2 in n] * 4}
    expected["train"].append(f"{vocaset.TRAIN}_sentence03")
    monkeypatch.setattr(small.SmallVocaset, "expected_clips", classmethod(lambda _: expected))
    report = check(copies / "vocaset", VOCASET, quick=True)
    assert "never recorded" in message(report, "clips_missing")
    assert kinds(report, "note").count("clips_missing") == 1


def test_vocaset_stored_at_30_frames_a_second_is_noticed(copies: Path) -> None:
    root = copies / "vocaset"
    for path in (root / "vertices_npy").iterdir():
        np.save(path, np.load(path)[::2])
    report = check(root, VOCASET)
    assert kinds(report) == ["frame_rate"]
    assert "about 30 motion frames" in message(report, "frame_rate")
    assert "copies of vocaset have 60" in message(report, "frame_rate")
    assert 'write {"frame_rate": 30} into manifest.json' in message(report, "frame_rate")
    (root / "manifest.json").write_text('{"frame_rate": 30}')  # as the finding says
    assert kinds(check(root, VOCASET)) == []


def test_3dmead_has_totals_of_both_ways_to_split_it(fakes: Path) -> None:
    report = check(fakes / "mead", MEAD)
    assert report.findings == [f for f in report.findings if f.kind == "region_unusual"]
    sizes = small.MEAD_FRAMES
    of = {way: {} for way in ("sentence", "identity", "both")}
    for (way, split), row in rows(report).items():
        of[way][split] = row[3]
    train_a = sizes["M003_001_0_0"] + sizes["M003_024_1_2"]
    assert of["sentence"] == {
        "train": train_a,
        "val": sizes["M003_033_0_0"] + sizes["W009_026_4_1"],
        "test_a": sizes["M003_037_0_0"] + sizes["W009_028_6_0"],
        "none": sizes["M032_001_0_0"] + sizes["W040_030_7_2"],
    }
    assert of["identity"] == {
        "train": sum(n for name, n in sizes.items() if name[:4] in ("M003", "W009")),
        "val": sizes["M032_001_0_0"],
        "test_b": sizes["W040_030_7_2"],
    }
    assert of["both"] == {
        **{split: of["sentence"][split] for split in ("train", "val", "test_a")},
        "test_b": sizes["W040_030_7_2"],
        "none": sizes["M032_001_0_0"],
    }
