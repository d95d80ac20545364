"""Packed corpora: what comes back, what Zarr itself reads, how packing is resumed, and what every data module reads."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facediff.data import Biwi
from facediff.data.corpus import read_templates
from facediff.data.packed import packing
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.unpacking import unpack
from facediff.data.preparation import write_templates
from facediff.errors import FaceDiffError
from facediff.utils.checksums import describe_files
from facediff.utils.plain_files import write_json
from tests.data.packed.damage import RECORD, TINY, change
from tests.fakes.tiny import VERTICES, Tiny, write_tiny

MM = 0.001
pack = partial(packing.pack, exact="none")


def same_content(one: Path, other: Path) -> bool:
    return describe_files(one) == describe_files(other)


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


def test_the_lines_of_the_manual_read_steps_and_exact_clips(corpus: Path, packed: Path, tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "packed.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    packing.pack(corpus, tmp_path / "exact.zarr", corpus=TINY, lossless=True, workers=1)
    for store, most in ((packed, 0.01 * MM), (tmp_path / "exact.zarr", 0.0)):
        names: dict[str, Any] = {}
        exec(lines.replace("BIWI.zarr", str(store)), names)  # noqa: S102 - the manual's own
        was = np.load(corpus / "vertices_npy" / f"{names['clip']['name']}.npy")
        assert np.abs(names["vertices"] - was.reshape(len(was), -1)).max() <= most


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


class MiniBiwi(Biwi):
    corpus_name = "mini-biwi"  # "biwi" with so few vertices would be found by other tests too
    n_vertices = VERTICES


def test_motion_that_1_1_packed_by_lz4_is_read(
    corpus: Path, packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zarr.codecs

    blosc = zarr.codecs.BloscCodec
    monkeypatch.setattr(zarr.codecs, "BloscCodec", lambda **options: blosc(**{**options, "cname": "lz4hc"}))
    pack(corpus, tmp_path / "out.zarr", corpus=TINY, workers=1)
    change(tmp_path / "out.zarr", RECORD, lambda record: record.__setitem__("codec", "lz4"))
    assert (tmp_path / "out.zarr/motion_int16/c/0/0").read_bytes() != (packed / "motion_int16/c/0/0").read_bytes()
    pairs = zip(*(Tiny(root=str(root)).dataset("train") for root in (packed, tmp_path / "out.zarr")), strict=True)
    assert all(torch.equal(one.motion, other.motion) for one, other in pairs)


def test_the_unit_is_that_of_the_manifest_or_of_the_data_module(tmp_path: Path) -> None:
    root, people = write_tiny(tmp_path / "corpus", sentences=1), {"A": "F2", "B": "M3", "C": "F1"}
    for folder, suffix in (("wav", "wav"), ("vertices_npy", "npy")):
        for old, new in people.items():
            (root / folder / f"{old}_e01.{suffix}").rename(root / folder / f"{new}_e01.{suffix}")
    faces = read_templates(root / "templates.pkl")
    write_templates(root / "templates.pkl", {new: faces[old].numpy() for old, new in people.items()})
    for unit, millimetres in ((None, 185.0), ("cm", 10.0)):
        out = tmp_path / f"{unit}.zarr"
        write_json(root / "manifest.json", {"unit": unit} if unit else {})
        pack(root, out, corpus=f"{__name__}.MiniBiwi", workers=1)
        assert PackedCorpus(out).record.step == pytest.approx(0.02 / millimetres, rel=0.011)
    write_json(root / "manifest.json", {"unit": "furlong"})
    with pytest.raises(FaceDiffError, match="furlong"):
        pack(root, tmp_path / "out.zarr", corpus=f"{__name__}.MiniBiwi", workers=1)


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


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("changed", ["vertices_npy/A_e02.npy", "templates.pkl", "clips.csv"])
def test_a_corpus_that_changed_since_is_not_mixed_with_what_is_there(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str, whole: bool
) -> None:
    source = Path(shutil.copytree(corpus, tmp_path / "corpus"))
    with monkeypatch.context() as patch:
        if not whole:
            patch.setattr(packing, "_finish", lambda *words: 1 // 0)
        with nullcontext() if whole else pytest.raises(ZeroDivisionError):
            pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)
    os.utime(source / changed)
    with pytest.raises(FaceDiffError, match="changed since" if whole else "state of the corpus was"):
        pack(source, tmp_path / "out.zarr", corpus=TINY, workers=1)


def test_what_is_there_is_not_written_again(corpus: Path, packed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = describe_files(packed)
    monkeypatch.setattr(packing, "_write", None)
    assert pack(corpus, packed, corpus=TINY, workers=1).written == 0
    assert describe_files(packed) == before


@pytest.mark.parametrize("place", ["motion_int16/c/0/0"])
def test_what_is_there_and_was_damaged_since_is_refused(corpus: Path, packed: Path, tmp_path: Path, place: str) -> None:
    out = Path(shutil.copytree(packed, tmp_path / "corpus.zarr"))
    with (out / place).open("ab") as stream:
        stream.write(b" ")
    with pytest.raises(FaceDiffError, match=place):
        pack(corpus, out, corpus=TINY, workers=1)
    (out / place).unlink()
    with pytest.raises(FaceDiffError, match=place):
        pack(corpus, out, corpus=TINY, workers=1)


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
