"""What a figure is drawn from: clips that are chosen, and files and facts that are missing."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from facediff.errors import FaceDiffError
from facediff.evaluation.figures import FigureData, find_clips, motion_maps, opening_curves, read_pairs
from facediff.evaluation.figures.gather import gather
from facediff.synthetic.corpus import vertex_count
from tests.fakes.tiny import VERTICES

CLIPS = ["A_e06", "A_e07", "B_e06"]
Read = Callable[[str, str], NDArray[np.float64]]


def test_lengths_are_cut_to_the_shortest_with_a_note(damaged: Callable[..., FigureData], read: Read) -> None:
    whole = read("ours", "A_e06")
    material = damaged(whole[:5])
    maps, notes = motion_maps(material, ["A_e06"])
    assert maps["ours"].frames == maps["truth"].frames == 5
    assert notes == [f"A_e06: lengths differ (truth {len(whole)}, ours 5 frames): cut to the first 5"]
    curves, note = opening_curves(material, "A_e06", read_pairs("0-6", None, VERTICES))
    assert len(curves.openings["truth"]) == 5
    assert note is not None


def test_a_stride_of_the_truth(own_material: FigureData, read: Read) -> None:
    opened = replace(own_material, truth_stride=2).open("A_e06")
    np.testing.assert_array_equal(opened["truth"].numpy(), read("truth", "A_e06")[::2].astype("f4"))


def test_choosing_clips(own_material: FigureData, tiny_root: Path, methods: dict[str, Path], tmp_path: Path) -> None:
    assert own_material.choose(["B_e06", "B_e06"]) == ["B_e06"]
    with pytest.raises(FaceDiffError, match=r'no clip "A_e66".*did you mean "A_e06"'):
        own_material.choose(["A_e66"])
    with pytest.raises(FaceDiffError, match=r'ours: there is no clip "C_e06"'):
        own_material.choose(["C_e06"])
    for other in ({"truth": methods["ours"]}, {"none": tmp_path}, {"gone": tmp_path / "gone"}):
        with pytest.raises(FaceDiffError):
            find_clips(other, tiny_root / "vertices_npy")
    with pytest.raises(FaceDiffError, match="--identity all"):
        find_clips(methods, tiny_root / "vertices_npy", identity="all")
    parted = {name: {clip: Path()} for name, clip in zip(("ours", "theirs"), CLIPS, strict=False)}
    with pytest.raises(FaceDiffError, match="truth and ours and theirs have no clip in common"):
        replace(own_material, methods=parted).choose()


def test_the_built_in_corpus_is_known_with_its_unit(tmp_path: Path) -> None:
    vertices = vertex_count()
    facts = {"corpus": "facediff-puppet", "generator": "2.2", "vertices": vertices, "frame_rate": 25}
    for folder in (tmp_path / "corpus/vertices_npy", tmp_path / "ours"):
        folder.mkdir(parents=True)
        np.save(folder / "F1_t01.npy", np.zeros((3, 3 * vertices), np.float32))
    (tmp_path / "corpus/manifest.json").write_text(json.dumps(facts))
    (tmp_path / "corpus/templates.pkl").write_bytes(pickle.dumps({"F1": np.zeros((vertices, 3), np.float32)}))
    found = gather({"ours": tmp_path / "ours"}, tmp_path / "corpus")
    assert (found.n_vertices, found.unit, found.frame_rate) == (vertices, "m", 25.0)
    assert "synthetic" in found.remark
