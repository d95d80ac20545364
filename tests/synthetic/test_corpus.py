"""The built-in corpus on disk: bytes, splits, and truth that decodes to what its regions and pairs describe."""

from __future__ import annotations

import hashlib
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from facediff.data import Puppet
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.data.check import check, text
from facediff.data.packed.packing import pack
from facediff.data.puppet import PuppetMask
from facediff.data.storage import ClipFolder, WeightFile
from facediff.errors import FaceDiffError
from facediff.models.checkpoint import corpus_of
from facediff.synthetic import corpus as corpus_module
from facediff.synthetic.cast import KEPT_OUT, SEEN, UNSEEN, drawn_names, member_of
from facediff.synthetic.corpus import MASK, generate, perform_clip, performed_clips, rig_of, speak_clip, spoken_words
from facediff.synthetic.head.mask import build_mask
from facediff.synthetic.head.parts import build_head
from facediff.synthetic.head.rig import SHAPES, eyelid_pairs, lip_pairs
from facediff.synthetic.sentences import GERMAN, TEST, TRAIN, VALIDATION, WORDS

ONLY = ("F1_e01", "F1_t01", "M5_t14")


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("puppet") / "corpus"
    generate(root, only=ONLY, progress=False)
    return root


def test_tests_can_tell() -> None:
    clips = performed_clips(drawn=3)
    count = Counter(clip.split for clip in clips)
    assert count["test_a"] >= 60
    assert count["test_b"] >= 40
    assert len({clip.name for clip in clips}) == len(clips)
    assert {clip.identity for clip in clips if clip.split == "test_b"} == set(UNSEEN)
    assert len(UNSEEN) == 4
    for first, second in ((TRAIN, TEST), (TRAIN, VALIDATION), (VALIDATION, TEST), (TRAIN, GERMAN)):
        assert not set(first) & set(second)
    spoken = {(clip.identity, clip.text) for clip in clips if clip.split == "train"}
    assert len(spoken) == count["train"]
    for identity in SEEN:
        moods = Counter(clip.mood for clip in clips if clip.identity == identity and clip.split == "train")
        assert max(moods.values()) - min(moods.values()) <= 2


def test_voices_that_are_kept_out_are_not_trained_with() -> None:
    voices = {member_of(name).voice for name in (*SEEN, *drawn_names(99))}
    assert not voices & set(KEPT_OUT)
    of_test_c = {clip.voice for clip in performed_clips() if clip.split == "test_c"}
    assert len(of_test_c) >= 2
    assert not of_test_c & voices


def test_the_same_seed_gives_the_same_bytes_on_two_processes(corpus: Path, tmp_path: Path) -> None:
    generate(tmp_path / "again", only=ONLY, workers=2, progress=False)
    assert digests(tmp_path / "again") == digests(corpus)
    generate(tmp_path / "other", only=ONLY[1:2], seed=1, progress=False)
    name = f"weights_npy/{ONLY[1]}.npy"
    assert digests(tmp_path / "other")[name] != digests(corpus)[name]


def test_vertices_are_what_weights_decode_to(corpus: Path) -> None:
    weights = np.load(corpus / "weights_npy" / "F1_t01.npy")
    vertices = np.load(corpus / "vertices_npy" / "F1_t01.npy").reshape(len(weights), -1, 3)
    rig = rig_of("F1")
    assert np.allclose(vertices, rig[0] + np.einsum("tk,kvc->tvc", weights, rig[1:]), atol=1e-6)
    assert rig.shape == (1 + len(SHAPES), len(build_head().vertices), 3)


def test_the_check_reads_weights(corpus: Path) -> None:
    report = check(corpus)
    assert report.sound, text(report)
    assert report.n_vertices == len(build_head().vertices)
    assert {row["split"]: row["present"] for row in report.splits} == {"train": 1, "test_a": 1, "test_b": 1}


def test_the_data_module_decodes_weights(corpus: Path) -> None:
    folder = ClipFolder(corpus, len(build_head().vertices))
    assert folder.names() == sorted(ONLY)
    template = rig_of("F1")[0]
    stored = folder.open("F1_t01").offsets(range(5, 9), template)  # from vertices
    weights = np.load(corpus / "weights_npy" / "F1_t01.npy")
    decoded = WeightFile(corpus / "weights_npy" / "F1_t01.npy", rig_of("F1")).offsets(range(5, 9), template)
    assert np.allclose(stored, decoded, atol=1e-6)
    assert isinstance(folder.open("F1_e01"), WeightFile)
    with pytest.raises(FaceDiffError, match="F1_e01"):
        WeightFile(corpus / "weights_npy" / "F1_e01.npy", rig_of("F1")[:-1])
    data = Puppet(root=str(corpus))
    assert data.n_vertices == len(template)
    assert len(weights) == folder.open("F1_t01").frames


def test_truth_closes_its_lips_and_another_truth_differs() -> None:
    clip = next(clip for clip in performed_clips() if clip.name == "M5_t14")
    spoken = speak_clip(clip)
    truth, another = perform_clip(clip, spoken)
    assert len(spoken.samples) == len(truth.weights) * 640
    rig = rig_of("M5").astype(np.float64)
    upper, lower = lip_pairs(build_head())
    vertices = rig[0] + np.einsum("tk,kvc->tvc", truth.weights, rig[1:])
    gaps = 1000.0 * np.linalg.norm(vertices[:, upper] - vertices[:, lower], axis=-1).max(axis=1)
    closures = [p for p in spoken.phonemes if p.ipa[:1] in ("p", "b", "m")]
    assert closures
    for phoneme in closures:
        assert gaps[int(0.5 * (phoneme.start + phoneme.end) * 25)] < 0.6, phoneme
    assert gaps.max() > 4.0
    assert np.abs(truth.weights - another.weights).max() > 0.1
    jaw = SHAPES.index("jawOpen")  # which speech decides
    assert np.abs(truth.weights[:, jaw] - another.weights[:, jaw]).max() < 0.1


def test_the_mask_is_the_heads_front_in_the_number_of_vertices_of_scans() -> None:
    mask, head = build_mask(), build_head()
    assert mask.operator.shape == (PuppetMask.n_vertices, len(head.vertices))
    assert np.allclose(mask.operator.sum(axis=1), 1.0)  # the rule moves with whatever it is applied to
    vertices = mask.transfer(head.vertices)
    corners = vertices[mask.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).min() > 0
    edges = np.sort(np.concatenate([mask.faces[:, [0, 1]], mask.faces[:, [1, 2]], mask.faces[:, [2, 0]]]), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2
    for side in (*lip_pairs(head), *eyelid_pairs(head)):
        assert np.linalg.norm(vertices[mask.vertex_of[side]] - head.vertices[side], axis=1).max() < 2.0


def test_the_corpus_of_masks_moves_as_the_heads_do(tmp_path: Path) -> None:
    generate(tmp_path / "masks", only=["X5001_e01", "X5009_t28"], variant=MASK, progress=False)
    data = PuppetMask(root=str(tmp_path / "masks"))
    assert {split: [clip.name for clip in data.clips(split)] for split in ("train", "test_a", "test_b")} == {
        "train": ["X5001_e01"],
        "test_a": [],
        "test_b": ["X5009_t28"],
    }
    assert data.assets().faces.shape[1] == 3
    clip = data.clips("train")[0]
    motion, speech = data.corpus.read_motion(clip), data.corpus.read_audio(clip, 0, data.corpus.frames(clip))
    assert abs(len(speech) / 16_000 - len(motion) / 30) < 0.04
    weights, head = np.load(tmp_path / "masks" / "weights_npy" / "X5001_e01.npy"), rig_of("X5001")
    mask, place = build_mask(), np.flatnonzero(build_mask().vertex_of >= 0)
    own = np.einsum("tk,kvc->tvc", weights, head[1:, place])
    assert np.abs(motion.numpy()[:, mask.vertex_of[place]] - own).max() < 0.003
    report = check(tmp_path / "masks")
    assert report.sound, text(report)
    assert report.corpus == "puppet_mask"


def test_weights_are_packed_as_the_vertices_that_they_decode_to(corpus: Path, tmp_path: Path) -> None:
    pytest.importorskip("zarr")
    pack(corpus, tmp_path / "packed.zarr", lossless=True, workers=1)
    folder, packed = Puppet(root=str(corpus)), Puppet(root=str(tmp_path / "packed.zarr"))
    assert packed.n_vertices == folder.n_vertices
    for name in ("F1_e01", "F1_t01"):  # weights, and vertices
        own, other = (data.corpus.read_motion(data.corpus.clips[name]) for data in (folder, packed))
        assert np.array_equal(own, other)


def test_the_first_edition_is_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"corpus": "facediff-puppet", "generator": "1.1"}')
    with pytest.raises(FaceDiffError, match="holds the first edition of the built-in corpus"):
        Puppet(root=str(tmp_path))
    source = {"class_path": "facediff.data.puppet.Puppet", "corpus": "puppet"}
    saved = {"data_source": source, "datamodule_hyper_parameters": {"seed": 3, "edition": 2}}
    assert corpus_of(tmp_path / "new.ckpt", {DATA_SOURCE_KEY: source, **saved})[1] == {"seed": 3}
    saved["datamodule_hyper_parameters"] = {"seed": 3, "edition": 1}
    with pytest.raises(FaceDiffError, match="old.ckpt: edition=1 of .*Puppet is an option of facediff 1.1"):
        corpus_of(tmp_path / "old.ckpt", {DATA_SOURCE_KEY: source, **saved})


def test_further_speech_is_the_same_by_number_and_in_no_sentence_of_the_test() -> None:
    speech = Puppet(drawn_speakers=2).further_speech()
    assert not set(UNSEEN) & set(speech.keywords["identities"])
    one = spoken_words(3, ("F1", "P001", "M1"), ["aligned:somewhere"])
    assert np.array_equal(one, spoken_words(3, ("F1", "M1")))
    assert not np.array_equal(one, spoken_words(4, ("F1", "M1")))
    assert 1.5 < len(one) / 16_000 < 8
    assert len(set(WORDS)) == len(WORDS)


def test_only_a_whole_corpus_is_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, stamps = tmp_path / "corpus", []

    def make(**options: object) -> None:
        generate(root, progress=False, **options)
        stamps.append((root / "manifest.json").stat().st_mtime_ns)

    make(only=["F1_e01"])
    every = performed_clips()
    monkeypatch.setattr(corpus_module, "performed_clips", lambda *_: every[:2])
    make()
    make()
    (root / "wav" / f"{every[1].name}.wav").write_bytes(b"")
    make()
    assert [first == second for first, second in pairwise(stamps)] == [False, True, False]
    for other in ({"seed": 1}, {"drawn": 1}, {"people": ["flite:awb"]}):
        with pytest.raises(
            FaceDiffError, match=rf"corpus: holds the corpus with {next(iter(other))} .*choose another folder"
        ):
            make(**other)
    assert (root / "manifest.json").stat().st_mtime_ns == stamps[-1]


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"name": "my browser extension"}')
    with pytest.raises(FaceDiffError, match="holds no manifest of the built-in corpus"):
        generate(tmp_path, only=ONLY, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["manifest.json"]
