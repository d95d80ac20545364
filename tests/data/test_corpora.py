"""BIWI, VOCASET and 3DMEAD: splits and identity order against hand-written lists, and the layouts that circulate."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset
from facediff.data.corpus import find_region
from facediff.errors import FaceDiffError

VERTICES = 10


class MiniBiwi(Biwi):
    n_vertices = VERTICES


class MiniVocaset(Vocaset):
    n_vertices = VERTICES


class MiniMead(Mead3D):
    n_vertices = VERTICES


def write(root: Path, names: list[str], subjects: set[str], *, frames: int = 6, rate: int = 16000) -> Path:
    """The smallest folder in the peers' layout."""
    for folder in ("wav", "vertices_npy", "regions"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    templates = {subject: rng.normal(size=(VERTICES, 3)) for subject in sorted(subjects)}
    for name in names:
        subject = next(s for s in subjects if name.startswith(s))
        motion = templates[subject].ravel() + rng.normal(0, 0.01, (frames, VERTICES * 3))
        np.save(root / "vertices_npy" / f"{name}.npy", motion)
        soundfile.write(root / "wav" / f"{name}.wav", rng.uniform(-0.1, 0.1, frames * rate // 25), rate)
    (root / "templates.pkl").write_bytes(pickle.dumps(templates, protocol=2))
    (root / "regions" / "lve.txt").write_text("0, 1, 2")
    (root / "regions" / "fdd.txt").write_text("5,6")
    return root


def names_of(data: SpeechMotionDataModule) -> dict[str, list[str]]:
    return {s: [clip.name for clip in data.clips(s)] for s in ("train", "val", "test_a", "test_b")}


SEEN = ["F2", "F3", "F4", "M3", "M4", "M5"]
UNSEEN = ["F1", "F5", "F6", "F7", "F8", "M1", "M2", "M6"]


def test_biwi_has_the_splits_of_the_field(tmp_path: Path) -> None:
    people = [*(f"F{i}" for i in range(1, 9)), *(f"M{i}" for i in range(1, 7))]
    neutral = ["F2_01", "F1_40", "M3_33"]
    everything = [f"{p}_e{n:02d}" for p in people for n in range(1, 41)]
    data = MiniBiwi(root=str(write(tmp_path, [*everything, *neutral], set(people), frames=1)))
    expected = {
        "train": [f"{p}_e{n:02d}" for p in SEEN for n in range(1, 33)],
        "val": [f"{p}_e{n:02d}" for p in SEEN for n in (33, 34, 35, 36)],
        "test_a": [f"{p}_e{n:02d}" for p in SEEN for n in (37, 38, 39, 40)],
        "test_b": [f"{p}_e{n:02d}" for p in UNSEEN for n in (37, 38, 39, 40)],
    }
    assert {split: sorted(names) for split, names in expected.items()} == names_of(data)
    assert [len(names) for names in expected.values()] == [192, 24, 24, 32]
    assert {s: sorted(n) for s, n in Biwi.expected_clips().items()} == {s: sorted(n) for s, n in expected.items()}
    assert data.identities == SEEN
    assert not any(name in data.corpus.clips for name in neutral)
    # Unseen people's style comes from sentences that nothing is scored on.
    assert all(int(s.reference_name[-2:]) < 37 for s in data.dataset("test_b"))


VOCASET_TRAIN = [
    "FaceTalk_170728_03272_TA",
    "FaceTalk_170904_00128_TA",
    "FaceTalk_170725_00137_TA",
    "FaceTalk_170915_00223_TA",
    "FaceTalk_170811_03274_TA",
    "FaceTalk_170913_03279_TA",
    "FaceTalk_170904_03276_TA",
    "FaceTalk_170912_03278_TA",
]
VOCASET_VAL = ["FaceTalk_170811_03275_TA", "FaceTalk_170908_03277_TA"]
VOCASET_TEST = ["FaceTalk_170809_00138_TA", "FaceTalk_170731_00024_TA"]


def test_vocaset_has_the_splits_of_the_field_and_counts_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    people = [*VOCASET_TRAIN, *VOCASET_VAL, *VOCASET_TEST]
    everything = [f"{p}_sentence{n:02d}" for p in people for n in range(1, 41)]
    absent = [f"{VOCASET_TRAIN[0]}_sentence07", f"{VOCASET_TEST[1]}_sentence40"]
    there = [name for name in everything if name not in absent]
    data = MiniVocaset(root=str(write(tmp_path, there, set(people), frames=1)))
    expected = {
        "train": [f"{p}_sentence{n:02d}" for p in VOCASET_TRAIN for n in range(1, 41)],
        "val": [f"{p}_sentence{n:02d}" for p in VOCASET_VAL for n in range(21, 41)],
        "test_a": [],
        "test_b": [f"{p}_sentence{n:02d}" for p in VOCASET_TEST for n in range(21, 41)],
    }
    assert names_of(data) == {s: sorted(n for n in names if n in there) for s, names in expected.items()}
    assert [len(expected[s]) for s in ("train", "val", "test_b")] == [320, 40, 40]
    assert data.identities == VOCASET_TRAIN
    assert data.missing_clips() == {"train": absent[:1], "val": [], "test_b": absent[1:]}
    data.prepare_data()
    assert "1 of train, 1 of test_b" in capsys.readouterr().out
    assert data.test_splits == ["test_b"]
    sample = data.dataset("test_b")[0]
    assert sample.identity == -1
    assert int(sample.reference_name[-2:]) < 21


MEAD_MEN = [f"M{n:03d}" for n in (3, 5, 7, 9, 11, 12, 13, 19, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31)]
MEAD_WOMEN = [f"W{n:03d}" for n in (9, 11, 14, 15, 16, 18, 19, 21, 23, 24, 25, 26, 28, 29)]
MEAD_VAL = ["M032", "M033", "M034", "M035", "W033", "W035", "W036"]
MEAD_TEST = ["M037", "M039", "M040", "M041", "M042", "W037", "W038", "W040"]


def test_3dmead_by_sentence_and_by_identity(tmp_path: Path) -> None:
    people = ["M003", "W029", *MEAD_VAL[:1], *MEAD_TEST[-1:]]
    neutral = [f"{p}_{n:03d}_0_0" for p in people for n in range(1, 41)]
    emotional = [f"{p}_{n:03d}_{e}_2" for p in people for n in range(1, 31) for e in (1, 7)]
    root = write(tmp_path, [*neutral, *emotional], set(people), frames=1)
    data = MiniMead(root=str(root))
    seen = ["M003", "W029"]

    def expected(in_neutral: range, in_emotional: range) -> list[str]:
        names = [f"{p}_{n:03d}_0_0" for p in seen for n in in_neutral]
        return sorted(names + [f"{p}_{n:03d}_{e}_2" for p in seen for n in in_emotional for e in (1, 7)])

    assert names_of(data) == {
        "train": expected(range(1, 33), range(1, 25)),
        "val": expected(range(33, 37), range(25, 28)),
        "test_a": expected(range(37, 41), range(28, 31)),
        "test_b": [],
    }
    assert data.identities == [*MEAD_MEN, *MEAD_WOMEN]
    assert len(data.identities) == 32
    by_identity = MiniMead(root=str(root), split="identity")
    found = names_of(by_identity)
    assert {name[:4] for name in found["train"]} == {"M003", "W029"}
    assert {name[:4] for name in found["val"]} == {"M032"}
    assert {name[:4] for name in found["test_b"]} == {"W040"}
    assert sum(map(len, found.values())) == len(neutral) + len(emotional)
    assert by_identity.hparams["split"] == "identity"


def test_3dmead_names_tell_emotion_and_intensity_and_references_share_the_emotion(tmp_path: Path) -> None:
    names = [f"M003_{n:03d}_{e}_{i}" for n in (1, 2, 30) for e, i in ((0, 0), (1, 0), (1, 2), (4, 1))]
    names += [f"W040_{n:03d}_{e}_0" for n in (1, 2) for e in (0, 1)]
    data = MiniMead(root=str(write(tmp_path, names, {"M003", "W040"})))
    clip = data.corpus.clips["M003_030_4_1"]
    assert (clip.attributes["emotion"], clip.attributes["intensity"], clip.number) == ("fear", "2", 30)
    # Sequence 1 of one emotion says other words than sequence 1 of another.
    assert data.corpus.clips["M003_001_0_0"].sentence != data.corpus.clips["M003_001_1_0"].sentence
    assert data.corpus.clips["M003_001_1_0"].sentence == data.corpus.clips["W040_001_1_0"].sentence
    for sample in [*data.dataset("train"), *data.dataset("test_a")]:
        assert sample.reference_name.split("_")[2] == sample.name.split("_")[2]
    # Whoever is tested on all clips has a style all the same, from another clip.
    unseen = MiniMead(root=str(tmp_path), split="identity").dataset("test_b")
    assert len(unseen) == 4
    assert all(s.reference_name != s.name and s.reference_name[:4] == "W040" for s in unseen)


def test_sixty_stored_frames_a_second_become_thirty_by_every_second(tmp_path: Path) -> None:
    subject = VOCASET_TRAIN[0]
    root = write(tmp_path, [f"{subject}_sentence01", f"{subject}_sentence02"], {subject}, frames=7)
    stored = np.load(root / "vertices_npy" / f"{subject}_sentence01.npy").reshape(7, VERTICES, 3)
    data = MiniVocaset(root=str(root))
    clip = data.corpus.clips[f"{subject}_sentence01"]
    template = data.corpus.templates[subject]
    expected = torch.from_numpy(stored[::2].astype("f4")) - template
    assert data.corpus.frames(clip) == 4
    assert torch.equal(data.corpus.read_motion(clip), expected)
    assert torch.equal(data.corpus.read_motion(clip, 1, 3), expected[1:3])
    assert len(data.corpus.read_audio(clip, 0, 3)) == 3 * 16000 // 30
    # A prepared folder says what it holds.
    (root / "manifest.json").write_text('{"corpus": "vocaset", "frame_rate": 30, "unit": "mm"}')
    prepared = MiniVocaset(root=str(root))
    assert prepared.corpus.frames(prepared.corpus.clips[clip.name]) == 7
    assert prepared.assets().unit == "mm"
    (root / "manifest.json").write_text('{"frame_rate": 50}')
    with pytest.raises(FaceDiffError, match=r"frame_rate is 50.*30 frames"):
        _ = MiniVocaset(root=str(root)).corpus
    (root / "manifest.json").write_text("{")
    with pytest.raises(FaceDiffError, match=r"manifest\.json: not readable as JSON"):
        _ = MiniVocaset(root=str(root)).corpus


def test_probtalk3ds_folder_of_vertices_is_found(tmp_path: Path) -> None:
    root = write(tmp_path, ["M003_001_0_0", "M003_002_0_0"], {"M003"})
    (root / "vertices_npy").rename(root / "vertex")
    data = MiniMead(root=str(root))
    assert data.dataset("train")[0].motion.shape == (6, VERTICES, 3)


def test_float64_and_float32_files_give_the_same_offsets(tmp_path: Path) -> None:
    root = write(tmp_path, ["F2_e01", "F2_e02"], {"F2"}, frames=30)
    clip = MiniBiwi(root=str(root)).corpus.clips["F2_e01"]
    wide = MiniBiwi(root=str(root)).corpus.read_motion(clip, 3, 29)
    path = root / "vertices_npy" / "F2_e01.npy"
    np.save(path, np.load(path).astype("f4").reshape(30, VERTICES, 3))
    assert torch.equal(MiniBiwi(root=str(root)).corpus.read_motion(clip, 3, 29), wide)


def test_no_file_stays_open(tmp_path: Path) -> None:
    root = write(tmp_path, ["F2_e01", "F2_e02"], {"F2"})
    dataset = MiniBiwi(root=str(root)).dataset("train")
    _ = dataset[0]

    def held() -> int:
        links = [Path(f"/proc/self/fd/{fd.name}") for fd in Path("/proc/self/fd").iterdir()]
        maps = Path("/proc/self/maps").read_text().count(str(root))
        return maps + sum(str(root) in str(link.resolve()) for link in links if link.exists())

    if not Path("/proc/self/maps").exists():
        pytest.skip("tells open files by /proc")
    before = held()
    samples = [dataset[i % 2] for i in range(20)]
    assert held() == before == 0
    assert len(samples) == 20


MASKS: dict[str, object] = {
    "lips": np.array([7, 3, 3]),
    "forehead": np.array([1, 2]),
    "eye_region": np.array([2, 4], np.int32),
    "floats": np.array([1.5]),
}


@pytest.mark.parametrize(
    ("file", "content", "source", "expected"),
    [
        ("regions/a.txt", b"1, 2, 9", "regions/a.txt", [1, 2, 9]),
        ("regions/a.txt", b"9,1,2", "regions/a.txt", [1, 2, 9]),
        ("m.pkl", pickle.dumps(MASKS, 2), "m.pkl:lips", [3, 7]),
        ("m.pkl", pickle.dumps(MASKS, 2), "m.pkl:forehead+eye_region", [1, 2, 4]),
        ("lip.pkl", pickle.dumps([4, 5]), "lip.pkl", [4, 5]),
    ],
)
def test_regions_come_from_any_circulating_file(
    tmp_path: Path, file: str, content: bytes, source: str, expected: list[int]
) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_bytes(content)
    assert find_region(tmp_path, ["absent.txt", source], "lips", VERTICES).tensor().tolist() == expected


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("m.pkl:lip", r'm\.pkl: has no mask "lip": did you mean "lips"'),
        ("m.pkl:floats", r"m\.pkl: expected lists of whole numbers"),
        ("m.pkl", r"m\.pkl: expected lists"),
        ("list.pkl:lips", r"list\.pkl: expected a dict from mask"),
        ("list.pkl", r"list\.pkl: .*the index 10, a mesh of 10 vertices ends at 9"),
        ("none.txt", r"upper face; looked for .*none\.txt\. Ask X\. .*data\.upper_face=all"),
    ],
)
def test_a_wrong_region_is_one_sentence(tmp_path: Path, source: str, sentence: str) -> None:
    (tmp_path / "m.pkl").write_bytes(pickle.dumps(MASKS))
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 10]))
    with pytest.raises(FaceDiffError, match=sentence):
        find_region(tmp_path, [source], "upper_face", VERTICES, "Ask X.")


def test_regions_are_chosen_by_option(tmp_path: Path) -> None:
    root = write(tmp_path, ["F2_e01", "F2_e02"], {"F2"})
    (root / "FLAME_masks.pkl").write_bytes(pickle.dumps(MASKS))
    data = MiniBiwi(root=str(root), lips="FLAME_masks.pkl:lips", upper_face="all")
    assert data.assets().regions["lips"].tolist() == [3, 7]
    assert data.assets().regions["upper_face"].tolist() == list(range(VERTICES))
    (root / "regions" / "lve.txt").unlink()
    with pytest.raises(FaceDiffError, match=r"looked for .*lve\.txt, .*lip\.txt, .*BIWI_lip\.pkl\. .*CodeTalker"):
        MiniBiwi(root=str(root)).assets()


def test_a_missing_folder_says_how_the_corpus_is_had(tmp_path: Path) -> None:
    modules: list[type[SpeechMotionDataModule]] = [Biwi, Vocaset, Mead3D]
    for module, words in zip(modules, ("ETH Zurich", "voca.is.tue.mpg.de", "inferno"), strict=True):
        with pytest.raises(FaceDiffError, match=rf"nowhere: no such folder; set data\.root.*{words}"):
            _ = module(root=str(tmp_path / "nowhere")).corpus


@pytest.mark.parametrize("name", ["batch_size", "window", "max_frames_per_batch", "reference_frames"])
def test_numbers_below_one_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(FaceDiffError, match=rf"data\.{name} 0"):
        Biwi(root=str(tmp_path), **{name: 0})  # type: ignore[arg-type]


def write_person(root: Path, name: str = "Ada") -> Path:
    write(root, [f"{name}_s{i:02d}" for i in range(1, 5)], {name})
    rows = [f"{name}_s{i:02d},{split}" for i, split in enumerate(["train", "train", "val", "test"], 1)]
    (root / "clips.csv").write_text("\n".join(["clip,split", *rows]))
    (root / "manifest.json").write_text(f'{{"corpus": "person", "person": "{name}", "frame_rate": 25}}')
    return root


def test_an_imported_person_is_trained_on_beside_the_corpus(tmp_path: Path) -> None:
    root = write(tmp_path / "biwi", ["F2_e01", "F2_e02", "F2_e33", "F2_e37", "F2_e38"], {"F2"})
    person = write_person(tmp_path / "ada")
    data = MiniBiwi(root=str(root), people=[str(person)])
    assert data.identities == ["Ada", *SEEN]
    assert names_of(data) == {
        "train": ["F2_e01", "F2_e02", "Ada_s01", "Ada_s02"],
        "val": ["F2_e33", "Ada_s03"],
        "test_a": ["F2_e37", "F2_e38", "Ada_s04"],
        "test_b": [],
    }
    sample = next(s for s in data.dataset("test_a") if s.identity_name == "Ada")
    assert sample.identity == 0
    assert sample.reference_name in ("Ada_s01", "Ada_s02")
    assert data.assets().identities[0] == "Ada"
    assert set(data.assets().templates) == {"F2", "Ada"}


def test_a_persons_folder_must_be_one(tmp_path: Path) -> None:
    root = write(tmp_path / "biwi", ["F2_e01", "F2_e02"], {"F2"})
    with pytest.raises(FaceDiffError, match=r"data\.people: .*biwi is no speaker's folder"):
        MiniBiwi(root=str(root), people=[str(root)])
    for name, sentence in (("F2", "data.people: F2 is there more than once"), ("M6", "M6 already")):
        own = write(tmp_path / f"with {name}", ["F2_e01", "F2_e02"], {"F2", "M6"})
        clash = write_person(tmp_path / f"clash {name}", name)
        with pytest.raises(FaceDiffError, match=sentence):
            _ = MiniBiwi(root=str(own), people=[str(clash)]).corpus.templates
    other = write_person(tmp_path / "other", "Eve")
    (other / "wav" / "Eve_s01.wav").rename(other / "wav" / "F2_e01.wav")
    (other / "vertices_npy" / "Eve_s01.npy").rename(other / "vertices_npy" / "F2_e01.npy")
    with pytest.raises(FaceDiffError, match=r"its clip F2_e01 is also in"):
        _ = MiniBiwi(root=str(root), people=[str(other)]).corpus.clips


def test_a_persons_table_may_come_from_a_spreadsheet_but_must_name_splits(tmp_path: Path) -> None:
    root = write(tmp_path / "biwi", ["F2_e01", "F2_e02"], {"F2"})
    person = write_person(tmp_path / "ada")
    table = (person / "clips.csv").read_text()
    (person / "clips.csv").write_text(table.replace(",val", ", val "), encoding="utf-8-sig")
    assert [clip.name for clip in MiniBiwi(root=str(root), people=[str(person)]).clips("val")] == ["Ada_s03"]
    (person / "clips.csv").write_text(table.replace(",test", ",tset"))
    with pytest.raises(FaceDiffError, match=r"clips\.csv: split of Ada_s04 is 'tset'"):
        MiniBiwi(root=str(root), people=[str(person)]).clips("val")


def test_a_speaker_with_one_clip_is_reported_before_training(tmp_path: Path) -> None:
    root = write(tmp_path / "biwi", ["F2_e01", "F2_e02"], {"F2"})
    person = write_person(tmp_path / "ada")
    for number in (2, 3, 4):
        (person / "wav" / f"Ada_s{number:02d}.wav").unlink()
    data = MiniBiwi(root=str(root), people=[str(person)])
    with pytest.raises(FaceDiffError, match="Ada has no other clip"):
        data.dataset("train", training=True)
    assert len(MiniBiwi(root=str(root), people=[str(person)], reference="self").dataset("train", training=True)) == 3


def test_swapped_axes_and_damaged_headers_are_refused(tmp_path: Path) -> None:
    root = write(tmp_path, ["F2_e01", "F2_e02"], {"F2"})
    path = root / "vertices_npy" / "F2_e01.npy"
    np.save(path, np.zeros((6, 3, VERTICES)))
    with pytest.raises(FaceDiffError, match=r"F2_e01\.npy: has shape \(6, 3, 10\), expected \(frames, 30\)"):
        MiniBiwi(root=str(root)).dataset("train")[0]
    content = bytearray(path.read_bytes())
    content[content.index(b"(6")] = ord("[")
    path.write_bytes(bytes(content))
    with pytest.raises(FaceDiffError, match=r"F2_e01\.npy: not a readable NumPy array"):
        MiniBiwi(root=str(root)).dataset("train")[0]
