"""Data modules: layouts of motion, speech and regions, options, and imported persons."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset
from facediff.data.corpus import find_region
from facediff.errors import FaceDiffError
from tests.fakes.mini import SEEN, VERTICES, MiniBiwi, names_of, write


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
    assert data.words_of(data.corpus.clips["Ada_s01"]) == "Ada_s01", "nobody else says the same"
    large = 1000 * data.corpus.templates["Ada"].numpy()
    (person / "templates.pkl").write_bytes(pickle.dumps({"Ada": large}))
    with pytest.raises(FaceDiffError, match="times as large as"):
        MiniBiwi(root=str(root), people=[str(person)]).assets()
