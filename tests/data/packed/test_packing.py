"""Packed corpora: what comes back, what Zarr itself reads, how packing is resumed, and what every data module reads."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from facediff.data import Biwi
from facediff.data.check import check
from facediff.data.corpus import read_templates
from facediff.data.packed import packing
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.unpacking import unpack
from facediff.data.prepare.runner import write_templates
from facediff.errors import FaceDiffError
from facediff.utils.checksums import describe_files
from facediff.utils.plain_files import write_json
from tests.fakes.tiny import VERTICES, Tiny, write_tiny

TINY = "tests.fakes.tiny.Tiny"
MM = 0.001
pack = partial(packing.pack, exact="none")


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature corpus with a manifest, noise on its motion, and a clip that is longer than a chunk of speech."""
    root = write_tiny(tmp_path_factory.mktemp("packed") / "corpus", sentences=7)
    rng = np.random.default_rng(0)
    for path in sorted((root / "vertices_npy").glob("*.npy")):
        clip = np.load(path)
        np.save(path, (clip + rng.normal(0, 1e-4, clip.shape)).astype(np.float32))
    long = np.load(root / "vertices_npy" / "A_e01.npy")[:1] + rng.normal(0, 1e-3, (590, 3 * VERTICES))
    np.save(root / "vertices_npy" / "A_e01.npy", long.astype(np.float32))
    speech = (0.3 * np.sin(np.arange(590 * 640) / 30) * 32767).astype(np.int16)
    soundfile.write(root / "wav" / "A_e01.wav", speech, 16000, subtype="PCM_16")
    (root / "phonemes").mkdir()
    (root / "phonemes" / "A_e01.csv").write_text("start,end,ipa\n0,0.1,m\n")
    write_json(root / "manifest.json", {"format": 1, "unit": "m", "frame_rate": 25, "files": describe_files(root)})
    return root


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def packed(corpus: Path) -> Path:
    out = corpus.parent / "corpus.zarr"
    pack(corpus, out, corpus=TINY, workers=1)
    return out


def same_content(one: Path, other: Path) -> bool:
    return describe_files(one) == describe_files(other)


def test_what_is_unpacked_is_within_the_tolerance_and_all_else_is_the_same(
    corpus: Path, packed: Path, tmp_path: Path
) -> None:
    assert unpack(packed, tmp_path / "back", workers=1) == 21
    worst = 0.0
    for path in sorted((corpus / "vertices_npy").glob("*.npy")):
        was, now = np.load(path), np.load(tmp_path / "back" / "vertices_npy" / path.name)
        assert now.dtype == was.dtype
        worst = max(worst, float(np.abs(now.astype(np.float64) - was).max()))
        heard, again = (soundfile.read(root / "wav" / f"{path.stem}.wav") for root in (corpus, tmp_path / "back"))
        assert heard[1] == again[1]
        assert np.array_equal(heard[0], again[0])
    assert 0.005 * MM < worst <= 0.01 * MM
    assert {path.name for path in tmp_path.joinpath("back").iterdir()} == {path.name for path in corpus.iterdir()}
    for place in ("clips.csv", "templates.pkl", "tiny.ply", "regions/lve.txt", "phonemes/A_e01.csv"):
        assert (tmp_path / "back" / place).read_bytes() == (corpus / place).read_bytes()
    assert check(tmp_path / "back", TINY).sound  # the checksums are those of what was written
    assert json.loads((tmp_path / "back" / "manifest.json").read_text())["packed"]["tolerance_mm"] == 0.01


@pytest.mark.parametrize("tolerance", [1.0, 0.001])
def test_every_tolerance_is_kept(corpus: Path, tmp_path: Path, tolerance: float) -> None:
    pack(corpus, tmp_path / "out.zarr", corpus=TINY, tolerance=tolerance, workers=1)
    record = PackedCorpus(tmp_path / "out.zarr").record
    assert {clip.coding for clip in record.clips.values()} == {"int16" if tolerance == 1 else "int32"}
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    for path in sorted((corpus / "vertices_npy").glob("*.npy"))[:4]:
        now = np.load(tmp_path / "back" / "vertices_npy" / path.name).astype(np.float64)
        assert np.abs(now - np.load(path)).max() <= tolerance * MM


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_lossless_packing_gives_every_bit_back(corpus: Path, tmp_path: Path, dtype: str) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    (source / "manifest.json").unlink()
    path = source / "vertices_npy" / "B_e02.npy"
    np.save(path, np.load(path).astype(dtype))
    pack(source, tmp_path / "out.zarr", corpus=TINY, lossless=True, workers=1)
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    assert same_content(tmp_path / "back" / "vertices_npy", source / "vertices_npy")
    plain, exact = (Tiny(root=str(place)).corpus for place in (source, tmp_path / "out.zarr"))
    assert torch.equal(plain.read_motion(plain.clips["B_e02"]), exact.read_motion(exact.clips["B_e02"]))


def test_zarr_reads_the_same_numbers(corpus: Path, packed: Path) -> None:
    import zarr

    group = zarr.open_group(packed, mode="r")
    record = group.attrs["facediff"]
    motion, faces = group["motion_int16"], group["templates"][:].reshape(-1, VERTICES, 3)
    assert motion.metadata.zarr_format == 3
    assert sorted(read_templates(corpus / "templates.pkl")) == record["identities"]
    for clip in record["clips"][:3]:
        rows = motion[clip["first"] : clip["first"] + clip["frames"]].astype(np.int64)
        begins = np.arange(len(rows)) % motion.chunks[0] == 0
        steps = np.zeros_like(rows)
        for t in range(len(rows)):  # the definition, as the documentation has it
            steps[t] = rows[t] if begins[t] else steps[t - 1] + rows[t]
        steps = steps.astype(np.int16)
        face = faces[record["identities"].index(clip["identity"])]
        vertices = steps.reshape(len(rows), -1, 3) * record["step"] + face
        was = np.load(corpus / "vertices_npy" / f"{clip['name']}.npy").reshape(vertices.shape)
        assert np.abs(vertices - was).max() <= 0.01 * MM


@pytest.mark.parametrize("chunk", [0.04, 0.5, 60.0])
def test_windows_are_those_of_the_folder(corpus: Path, tmp_path: Path, chunk: float) -> None:
    pack(corpus, tmp_path / "out.zarr", corpus=TINY, chunk_seconds=chunk, workers=1)
    plain, other = Tiny(root=str(corpus)).corpus, Tiny(root=str(tmp_path / "out.zarr")).corpus
    assert list(plain.clips) == list(other.clips)
    rng = np.random.default_rng(1)
    for name in ("A_e01", "B_e03", "C_e07"):
        clip, twin = plain.clips[name], other.clips[name]
        assert twin.attributes == clip.attributes
        frames = plain.frames(clip)
        assert other.frames(twin) == frames
        for start, stop in [(0, frames), (frames - 1, frames + 9), *np.sort(rng.integers(0, frames, (6, 2)))]:
            moved, again = plain.read_motion(clip, start, stop), other.read_motion(twin, int(start), int(stop))
            assert moved.shape == again.shape
            assert not len(moved) or float((moved - again).abs().max()) <= 0.0101 * MM
            assert torch.equal(plain.read_audio(clip, start, stop), other.read_audio(twin, start, stop))
        spread = [corpus.read_spread(c, 5) for corpus, c in ((plain, clip), (other, twin))]
        assert float((spread[0] - spread[1]).abs().max()) <= 0.0101 * MM


def test_only_the_chunks_of_a_window_are_read(packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = PackedCorpus(packed)
    fetched: list[int] = []
    motion = opened.open("A_e01")
    original = motion.array.decode
    monkeypatch.setattr(motion.array, "decode", lambda number, raw: (fetched.append(number), original(number, raw))[1])
    motion.offsets(range(100, 120), np.zeros((VERTICES, 3), np.float32))
    assert len(fetched) == len({t // 12 for t in range(100, 120)})


def test_every_second_frame_of_a_faster_corpus(corpus: Path, tmp_path: Path) -> None:
    class Fast(Tiny):
        frame_rate = 12.5

    pack(corpus, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = Fast(root=str(corpus)).corpus, Fast(root=str(tmp_path / "out.zarr")).corpus
    clip = plain.clips["A_e01"]
    assert other.frames(other.clips["A_e01"]) == plain.frames(clip) == 295
    moved, again = (c.read_motion(c.clips["A_e01"], 30, 61) for c in (plain, other))
    assert float((moved - again).abs().max()) <= 0.0101 * MM


@pytest.mark.parametrize(
    ("rate", "channels", "subtype"),
    [(16000, 1, "PCM_24"), (22050, 2, "PCM_16"), (48000, 1, "FLOAT"), (8000, 1, "PCM_U8")],
)
def test_speech_of_any_form_is_what_the_folder_gives(
    corpus: Path, tmp_path: Path, rate: int, channels: int, subtype: str
) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    (source / "manifest.json").unlink()
    tone = np.random.default_rng(0).uniform(-0.5, 0.5, (15 * rate, channels))
    soundfile.write(source / "wav" / "A_e01.wav", tone, rate, subtype=subtype)
    pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = Tiny(root=str(source)).corpus, Tiny(root=str(tmp_path / "out.zarr")).corpus
    for start, stop in ((0, 590), (240, 260)):
        heard = [c.read_audio(c.clips["A_e01"], start, stop) for c in (plain, other)]
        assert torch.equal(heard[0], heard[1])
    unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1)
    was, now = (soundfile.read(root / "wav" / "A_e01.wav")[0] for root in (source, tmp_path / "back"))
    assert np.array_equal(was, now)


def test_batches_of_packed_and_plain_agree_in_loader_processes(corpus: Path, packed: Path) -> None:
    options = {"batch_size": 2, "window": 9}
    loaders = [
        Tiny(root=str(root), num_workers=workers, **options).train_dataloader()
        for root, workers in ((corpus, 0), (packed, 2))
    ]
    for one, other in zip(*loaders, strict=True):
        assert one.names == other.names
        assert torch.equal(one.audio, other.audio)
        assert float((one.motion - other.motion).abs().max()) <= 0.0101 * MM
    plain, twin = (Tiny(root=str(root)) for root in (corpus, packed))
    assert twin.assets().regions.keys() == plain.assets().regions.keys()
    assert torch.equal(twin.assets().templates["A"], plain.assets().templates["A"])
    assert twin.motion_scale() == pytest.approx(plain.motion_scale(), rel=1e-4)
    assert (twin.root / "phonemes" / "A_e01.csv").is_file()


def test_what_scores_are_computed_from_keeps_every_bit(corpus: Path, tmp_path: Path) -> None:
    packing.pack(corpus, tmp_path / "out.zarr", corpus=TINY, workers=1)
    plain, other = (Tiny(root=str(root)) for root in (corpus, tmp_path / "out.zarr"))
    codings = {name: clip.coding for name, clip in other.packed.record.clips.items()} if other.packed else {}
    scored: set[str] = set()
    for split in ("test_a", "test_b"):
        for one, twin in zip(plain.dataset(split), other.dataset(split), strict=True):
            assert (one.name, one.reference_name) == (twin.name, twin.reference_name)
            for kind in ("motion", "reference", "audio", "template"):
                assert torch.equal(getattr(one, kind), getattr(twin, kind))
            scored |= {one.name, one.reference_name}
    assert codings == {name: "float32" if name in scored else "int16" for name in codings}
    assert len(scored) < len(codings)
    # Each array holds the rows of its own clips only.
    assert sum(facts.rows for name, facts in other.packed.record.arrays.items() if name.startswith("motion")) == sum(
        -(-clip.frames // 12) * 12 for clip in other.packed.record.clips.values()
    )
    assert unpack(tmp_path / "out.zarr", tmp_path / "back", workers=1) == len(codings)
    for name, coding in codings.items():
        was, now = (np.load(root / "vertices_npy" / f"{name}.npy") for root in (corpus, tmp_path / "back"))
        assert np.array_equal(was, now) == (coding == "float32")
    with pytest.raises(FaceDiffError, match="exact"):
        packing.pack(corpus, tmp_path / "more.zarr", corpus=TINY, exact="all")  # type: ignore[arg-type]


class MiniBiwi(Biwi):
    corpus_name = "mini-biwi"  # "biwi" with so few vertices would be found by other tests too
    n_vertices = VERTICES


def test_the_unit_is_the_corpuss_own_or_the_one_that_is_given(tmp_path: Path) -> None:
    root, people = write_tiny(tmp_path / "corpus", sentences=1), {"A": "F2", "B": "M3", "C": "F1"}
    for folder, suffix in (("wav", "wav"), ("vertices_npy", "npy")):
        for old, new in people.items():
            (root / folder / f"{old}_e01.{suffix}").rename(root / folder / f"{new}_e01.{suffix}")
    faces = read_templates(root / "templates.pkl")
    write_templates(root / "templates.pkl", {new: faces[old].numpy() for old, new in people.items()})
    for unit, millimetres in ((None, 185.0), ("cm", 10.0)):
        out = tmp_path / f"{unit}.zarr"
        pack(root, out, corpus=f"{__name__}.MiniBiwi", unit=unit, workers=1)
        assert PackedCorpus(out).record.step == pytest.approx(0.02 / millimetres, rel=0.011)
    with pytest.raises(FaceDiffError, match="furlong"):
        pack(root, tmp_path / "out.zarr", corpus=f"{__name__}.MiniBiwi", unit="furlong", workers=1)


# Interruptions and refusals.


@pytest.mark.parametrize("tasks", [0, 1, 5, 99])
def test_an_interrupted_run_is_continued_and_ends_in_the_same_bytes(
    corpus: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tasks: int
) -> None:
    out, written = tmp_path / "corpus.zarr", 0
    original = packing.encoded

    def write(*words: object) -> None:
        nonlocal written
        if written == tasks:
            raise KeyboardInterrupt
        written += 1
        work(*words)

    def encode(*words: object) -> bytes:
        if tasks == 99:  # while the record is made
            raise KeyboardInterrupt
        return original(*words)

    work = packing._write
    with monkeypatch.context() as patch:
        patch.setattr(packing, "_write", write)
        patch.setattr(packing, "group_metadata", encode)
        with pytest.raises(KeyboardInterrupt):
            pack(corpus, out, corpus=TINY, workers=1)
    assert not (out / "zarr.json").exists()
    with pytest.raises(FaceDiffError, match="interrupted"):
        _ = Tiny(root=str(out)).corpus
    again = pack(corpus, out, corpus=TINY, workers=1)
    assert again.written == (0 if tasks else 1)
    assert same_content(out, packed)


def test_a_corpus_that_changed_since_is_not_mixed_with_what_is_there(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    with monkeypatch.context() as patch:
        patch.setattr(packing, "_finish", lambda *words: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)
    np.save(source / "vertices_npy" / "A_e02.npy", np.load(source / "vertices_npy" / "A_e02.npy"))
    with pytest.raises(FaceDiffError, match="changed since"):
        pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)


def test_what_is_there_is_not_written_again(corpus: Path, packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = describe_files(packed)
    monkeypatch.setattr(packing, "_write", None)
    assert pack(corpus, packed, corpus=TINY, workers=1).written == 0
    assert describe_files(packed) == before


@pytest.mark.parametrize("place", ["motion_int16/c/0/0", "speech/zarr.json"])
def test_what_is_there_and_was_damaged_since_is_refused(corpus: Path, packed: Path, tmp_path: Path, place: str) -> None:
    out = Path(shutil.copytree(packed, tmp_path / "corpus.zarr"))
    with (out / place).open("ab") as stream:
        stream.write(b" ")
    with pytest.raises(FaceDiffError, match=place):
        pack(corpus, out, corpus=TINY, workers=1)
    (out / place).unlink()
    with pytest.raises(FaceDiffError, match=place):
        pack(corpus, out, corpus=TINY, workers=1)


def test_a_full_disk_ends_unpacking_in_one_sentence(
    packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, content: bytes) -> int:
        if path.suffix == ".wav":
            raise OSError(errno.ENOSPC, "No space left on device")
        return original(path, content)

    original = Path.write_bytes
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises((FaceDiffError, OSError), match="No space left"):
        unpack(packed, tmp_path / "back", workers=1)
    assert not (tmp_path / "back").exists()


def test_other_options_and_other_folders_are_refused(corpus: Path, packed: Path, tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match=r"packed otherwise"):
        pack(corpus, packed, corpus=TINY, tolerance=0.1, workers=1)
    (tmp_path / "full.zarr").mkdir()
    (tmp_path / "full.zarr" / "precious").touch()
    for root, out, word in (
        (corpus, tmp_path / "full.zarr", "precious"),
        (corpus, tmp_path / "out", ".zarr"),
        (corpus, corpus / "out.zarr", str(corpus)),
        (packed, tmp_path / "out.zarr", "packed already"),
        (tmp_path / "full.zarr", tmp_path / "out.zarr", "full.zarr"),
    ):
        with pytest.raises(FaceDiffError, match=word):
            pack(root, out, corpus=TINY, workers=1)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["full.zarr"]


def broken_frame(root: Path) -> str:
    path = root / "vertices_npy" / "A_e03.npy"
    clip = np.load(path)
    clip[4, 5] = np.nan
    np.save(path, clip)
    return "A_e03.npy.*frame 4"


def far_away(root: Path) -> str:
    path = root / "vertices_npy" / "A_e03.npy"
    np.save(path, np.load(path) + np.float32(5))
    return "A_e03.npy.*template of A"


def without_template(root: Path) -> str:
    faces = read_templates(root / "templates.pkl")
    write_templates(root / "templates.pkl", {name: faces[name].numpy() for name in "AB"})
    return "no template for C"


def cut_speech(root: Path) -> str:
    path = root / "wav" / "B_e02.wav"
    path.write_bytes(path.read_bytes()[:40])
    return "B_e02.wav"


@pytest.mark.parametrize("damage", [broken_frame, far_away, without_template, cut_speech])
def test_a_damaged_clip_is_named_and_nothing_pretends_to_be_whole(
    corpus: Path, tmp_path: Path, damage: Callable[[Path], str]
) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    with pytest.raises(FaceDiffError, match=damage(source)):
        pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)
    assert not (tmp_path / "out.zarr" / "zarr.json").exists()


def test_the_check_understands_packed_corpora(corpus: Path, packed: Path) -> None:
    plain, other = check(corpus, TINY), check(packed, TINY)
    assert other.sound
    assert (other.splits, other.subjects, other.regions) == (plain.splits, plain.subjects, plain.regions)
    assert {finding.kind for finding in other.findings} - {finding.kind for finding in plain.findings} == {"packed"}
    assert str(packed) in json.dumps(other.state())


def test_the_regions_of_a_packed_corpus_are_drawn(packed: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from facediff.cli.data import regions

    regions(packed, output=tmp_path / "regions.png", corpus=TINY, size=64)
    assert (tmp_path / "regions.png").stat().st_size


def test_packed_scores_are_those_of_the_folder(
    corpus: Path, packed: Path, make_model: Callable[..., Any], make_trainer: Callable[..., Any]
) -> None:
    plain, other = (
        make_trainer().test(make_model(motion_scale="none"), datamodule=Tiny(root=str(root)), verbose=False)
        for root in (corpus, packed)
    )
    for one, two in zip(plain, other, strict=True):
        for name in ("test_a/mve", "test_a/lve", "test_b/lve"):
            if name in one:
                assert two[name] == pytest.approx(one[name], rel=1e-4)
    assert any("lve" in name for scores in plain for name in scores)
