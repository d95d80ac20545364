"""3DMEAD: both ways to split it, names, and the layout of ProbTalk3D."""

from __future__ import annotations

from pathlib import Path

from tests.fakes.mini import VERTICES, MiniMead, names_of, write

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
    everyone = [f"{sex}{number:03d}" for sex in "MW" for number in range(1, 50)]
    clips = {name: MiniMead.parse_name(f"{name}_030_6_2") for name in everyone}
    for split, named in (("train", data.identities), ("val", MEAD_VAL), ("test_b", MEAD_TEST)):
        assert [name for name, clip in clips.items() if clip and by_identity.split_of(clip) == split] == named
    assert {name[:4] for name in found["val"]} == {"M032"}
    assert {name[:4] for name in found["test_b"]} == {"W040"}
    assert sum(map(len, found.values())) == len(neutral) + len(emotional)
    assert by_identity.hparams["split"] == "identity"
    both = names_of(MiniMead(root=str(root), split="both"))
    assert both == {**names_of(data), "test_b": found["test_b"]}


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


def test_probtalk3ds_folder_of_vertices_is_found(tmp_path: Path) -> None:
    root = write(tmp_path, ["M003_001_0_0", "M003_002_0_0"], {"M003"})
    (root / "vertices_npy").rename(root / "vertex")
    data = MiniMead(root=str(root))
    assert data.dataset("train")[0].motion.shape == (6, VERTICES, 3)
