"""On disk: the layout of BIWI's copies, whole or not there, the same bytes for the same seed."""

import csv
import hashlib
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff import synthetic as puppet
from facediff.errors import FaceDiffError
from facediff.synthetic import corpus as corpus_module
from facediff.synthetic.corpus import clips, generate, is_complete

pytest.importorskip("espeakng_loader")


def digests(root: Path) -> dict[str, str]:
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in root.rglob("*")
        if path.is_file()
    }


def test_splits_are_disjoint_and_moods_balanced() -> None:
    splits = [set(puppet.TRAIN_SENTENCES), set(puppet.VAL_SENTENCES), set(puppet.TEST_SENTENCES)]
    assert sum(map(len, splits)) == len(set.union(*splits)) == 32
    assert set(puppet.REFERENCE_SENTENCES).isdisjoint(puppet.TEST_SENTENCES)
    assert puppet.SEEN_IDENTITIES == ("F1", "F2", "F3", "M1", "M2", "M3")
    plan = clips()
    assert len({clip.name for clip in plan}) == len(plan) == 6 * 32 + 2 * 29
    for identity in puppet.SEEN_IDENTITIES:
        moods = [c.mood for c in plan if c.identity == identity and c.number in puppet.TRAIN_SENTENCES]
        assert {moods.count(mood) for mood in puppet.MOODS} == {8}
    for identity in puppet.UNSEEN_IDENTITIES:
        references = [c for c in plan if c.identity == identity and c.number in puppet.REFERENCE_SENTENCES]
        assert {c.mood for c in references} == set(puppet.MOODS)
        assert {c.number for c in plan if c.identity == identity} == {*range(1, 25), *range(28, 33)}


def test_drawn_speakers_say_the_training_sentences_only() -> None:
    plan = clips(2)
    assert plan[: len(clips())] == clips()
    further = plan[len(clips()) :]
    assert {clip.identity for clip in further} == {"X01", "X02"}
    assert [clip.number for clip in further] == 2 * list(puppet.TRAIN_SENTENCES)
    for identity in ("X01", "X02"):
        moods = [clip.mood for clip in further if clip.identity == identity]
        assert {moods.count(mood) for mood in puppet.MOODS} == {8}


def test_drawn_speakers_leave_the_eight_as_they_are(corpus: Path, tmp_path: Path) -> None:
    generate(tmp_path / "more", only=["F1_e01", "X02_e01"], progress=False, drawn=2)
    there = digests(tmp_path / "more")
    assert there["vertices_npy/F1_e01.npy"] == digests(corpus)["vertices_npy/F1_e01.npy"]
    rows = list(csv.DictReader((tmp_path / "more" / "clips.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["subject"] for row in rows] == ["F1", "X02"]
    templates = pickle.loads((tmp_path / "more" / "templates.pkl").read_bytes())  # noqa: S301 - written by ourselves
    assert list(templates) == [*puppet.SEEN_IDENTITIES, *puppet.UNSEEN_IDENTITIES, "X02"]
    assert (tmp_path / "more" / "PUPPET.ply").read_bytes() == (corpus / "PUPPET.ply").read_bytes()
    motion = np.load(tmp_path / "more" / "vertices_npy" / "X02_e01.npy").reshape(-1, puppet.N_VERTICES, 3)
    assert 0.001 < np.abs(motion - templates["X02"]).max() < 0.04


def test_corpus_with_drawn_speakers_is_another_corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corpus_module, "clips", lambda drawn=0: clips(drawn)[:1] + clips(drawn)[-drawn:][:drawn])
    root = tmp_path / "corpus"
    generate(root, progress=False, drawn=1)
    assert is_complete(root, drawn=1)
    assert not is_complete(root)
    assert not is_complete(root, drawn=2)


def test_layout(corpus: Path) -> None:
    with (corpus / "clips.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [*rows[0]] == ["clip", "subject", "sentence", "mood", "voice", "text"]
    with (corpus / "templates.pkl").open("rb") as stream:
        templates = pickle.load(stream)  # noqa: S301 - just written by ourselves
    assert list(templates) == [*puppet.SEEN_IDENTITIES, *puppet.UNSEEN_IDENTITIES]
    for row in rows:
        samples, rate = soundfile.read(corpus / "wav" / f"{row['clip']}.wav", dtype="int16")
        motion = np.load(corpus / "vertices_npy" / f"{row['clip']}.npy")
        assert rate == puppet.SAMPLE_RATE
        assert samples.ndim == 1
        assert np.abs(samples).max() > 10_000
        assert motion.dtype == np.float32
        assert motion.shape[1] == 3 * puppet.N_VERTICES
        assert len(samples) == len(motion) * puppet.SAMPLE_RATE // puppet.FRAME_RATE
        assert 40 <= len(motion) <= 100
        rest = templates[row["subject"]]
        assert rest.shape == (puppet.N_VERTICES, 3)
        assert rest.dtype == np.float64
        assert np.abs(motion.reshape(-1, puppet.N_VERTICES, 3) - rest).max() < 0.04
        with (corpus / "phonemes" / f"{row['clip']}.csv").open(encoding="utf-8") as stream:
            phonemes = list(csv.DictReader(stream))
        assert float(phonemes[0]["start"]) == 0.0
        assert float(phonemes[-1]["end"]) == pytest.approx(len(motion) / puppet.FRAME_RATE, abs=1e-3)
    for name in ("lve", "fdd"):
        index = [int(word) for word in (corpus / "regions" / f"{name}.txt").read_text().split(", ")]
        assert index == sorted(set(index))
        assert index[-1] < puppet.N_VERTICES
    assert len((corpus / "regions" / "inner_lip_pairs.txt").read_text().splitlines()) == 13


def test_mesh_file_can_be_read(corpus: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(corpus / "PUPPET.ply", process=False)
    assert mesh.vertices.shape == (puppet.N_VERTICES, 3)
    assert np.array_equal(mesh.faces, corpus_module.build_face().faces)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], corpus_module.build_face().colours)


def test_same_seed_same_bytes_and_other_seed_other_motion(corpus: Path, tmp_path: Path) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        generate(tmp_path / name, seed=seed, only=["F1_e01"], progress=False)
    first, second, other = (digests(tmp_path / name) for name in "abc")
    assert first == second
    assert first["wav/F1_e01.wav"] == other["wav/F1_e01.wav"]
    assert first["vertices_npy/F1_e01.npy"] != other["vertices_npy/F1_e01.npy"]
    assert first["vertices_npy/F1_e01.npy"] == digests(corpus)["vertices_npy/F1_e01.npy"]


@pytest.mark.slow
def test_workers_make_the_same_bytes(corpus: Path, tmp_path: Path) -> None:
    generate(tmp_path / "two", only=["F1_e01", "M3_e01"], workers=2, progress=False)
    assert digests(tmp_path / "two")["vertices_npy/M3_e01.npy"] == digests(corpus)["vertices_npy/M3_e01.npy"]


def test_manifest_names_every_file(corpus: Path) -> None:
    manifest = json.loads((corpus / "manifest.json").read_text())
    there = digests(corpus)
    del there["manifest.json"]
    assert {name: file["sha256"] for name, file in manifest["files"].items()} == there


def test_only_a_whole_corpus_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "corpus"
    assert not is_complete(root)
    generate(root, only=["F1_e01"], progress=False)
    assert not is_complete(root)
    monkeypatch.setattr(corpus_module, "clips", lambda drawn=0: clips(drawn)[:2])
    generate(root, progress=False)
    assert is_complete(root)
    assert not is_complete(root, seed=1)
    stamp = (root / "manifest.json").stat().st_mtime_ns
    generate(root, progress=False)
    assert (root / "manifest.json").stat().st_mtime_ns == stamp
    (root / "wav" / "F1_e02.wav").write_bytes(b"")
    assert not is_complete(root)
    (root / "manifest.json").write_text("{")
    assert not is_complete(root)


def test_an_interruption_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(corpus_module, "_write_clip", interrupt)
    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path / "corpus", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(FaceDiffError, match="not empty"):
        generate(tmp_path, progress=False)
    with pytest.raises(FaceDiffError, match="is a file"):
        generate(tmp_path / "thesis.tex", progress=False)
    with pytest.raises(FaceDiffError, match="thesis.tex/below: cannot be written"):
        generate(tmp_path / "thesis.tex" / "below", progress=False)
    with pytest.raises(FaceDiffError, match="no clip 'F1_e99'"):
        generate(tmp_path / "new", only=["F1_e99"], progress=False)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_importing_is_cheap() -> None:
    script = (
        "import sys, facediff.synthetic as p; heavy = 'torch soundfile soxr espeakng_loader tqdm'.split()\n"
        "print(p.N_VERTICES, *(name for name in heavy if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(puppet.N_VERTICES)]


def test_somebody_elses_folder_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "manifest.json").write_text('{"name": "my browser extension"}')
    with pytest.raises(FaceDiffError, match="holds no manifest of the built-in corpus"):
        generate(tmp_path / "mine", only=["F1_e01"], progress=False)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["manifest.json"]
