"""Regions: index files, duplicates, hashes and refusals."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facediff.metrics import TOPOLOGIES, Region

Indices = Any  # right and wrong ones


@pytest.mark.parametrize("text", ["5,1,3,1", "5, 1, 3, 1\n", "5 1\n3\t1\n", "5\r\n1\r\n3\r\n1\r\n", "\ufeff5,1,3,1,"])
def test_files_in_every_separation(tmp_path: Path, text: str) -> None:
    path = tmp_path / "lve.txt"
    path.write_text(text, encoding="utf-8", newline="")
    region = Region.from_file(path, n_vertices=6)
    assert (region.name, region.indices, region.duplicates, region.count) == ("lve", (1, 3, 5), 1, 3)
    assert region.hash == hashlib.sha256(b"1,3,5").hexdigest()[:8]
    assert Region.from_file(str(path), name="biwi/lve").name == "biwi/lve"


@pytest.mark.parametrize("content", [b"1,2,x3", b"1,-2", b"1.0 2.0", b" \n", b"1,99", b"\xff\xfe\x00\x81", None])
def test_bad_files_are_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "lve.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"lve\.txt: .*(expected vertex indices|region 'lve'|index 99, a mesh of 6)"):
        Region.from_file(path, n_vertices=6)


@pytest.mark.parametrize("indices", [[4, 2, 4], torch.tensor([4, 2, 4]), np.array([4, 2, 4]), {2, 4}, range(2, 5, 2)])
def test_any_collection_of_integers(indices: Indices) -> None:
    assert Region.from_indices("lips", indices).indices == (2, 4)


@pytest.mark.parametrize("indices", [[], [1.0, 2.0], [[1, 2]], torch.tensor([True, False]), [-1, 2]], ids=str)
def test_other_collections_are_refused(indices: Indices) -> None:
    with pytest.raises(ValueError, match="region 'lips' needs"):
        Region.from_indices("lips", indices)


def test_the_plain_constructor_wants_sorted_distinct_indices() -> None:
    with pytest.raises(ValueError, match=r"use Region\.from_indices"):
        Region("lips", (2, 1))


def test_the_hash_is_of_the_vertices_only() -> None:
    first, second = Region.from_indices("a", [1, 2]), Region.from_indices("b", [2, 1, 1], n_vertices=9)
    assert first.hash == second.hash
    assert first.hash != Region.from_indices("a", [12]).hash


def test_weights_above_a_threshold(tmp_path: Path) -> None:
    weights = [0.0, 0.1, 0.10001, 2e-12, 1.0]
    path = tmp_path / "weighted_mouth_mask.txt"
    path.write_text("\n".join(map(str, weights)), encoding="utf-8")
    for given in (path, str(path)):
        region = Region.from_weights(given, 0.1)
        assert (region.indices, region.n_vertices, region.name) == ((2, 4), 5, "weighted_mouth_mask > 0.1")
    for dtype in (torch.float32, torch.float64):  # strictly above, in either precision
        assert Region.from_weights(torch.tensor(weights, dtype=dtype), 0.1, name="mouth").indices == (2, 4)
    with pytest.raises(ValueError, match="belongs to a mesh of 5 vertices"):
        region.check(6)


@pytest.mark.parametrize("content", ["0.1\nx\n", "0.1\nnan", "0.1,0.2", "0.1\n0.2", ""])
def test_bad_weights_are_named(tmp_path: Path, content: str) -> None:
    path = tmp_path / "mask.txt"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ValueError, match="mask.*(finite weight)"):
        Region.from_weights(path, 0.5)
    for weights in (torch.ones(2, 2), torch.tensor([1.0, float("nan")])):
        with pytest.raises(ValueError, match="finite weights"):
            Region.from_weights(weights, 0.5)


# Of the meshes themselves, and of the index files and masks that circulate with them.
PUBLISHED = {
    "biwi": (23370, {4996}, {7784}),
    "vocaset": (5023, {250, 428, 648}, {827, 1501}),
    "mead3d": (5023, {250, 428, 648}, {827, 1501}),
    "multiface": (6172, {1035, 1438}, {656, 1529}),
}


def test_usual_meshes_and_regions_have_their_published_sizes() -> None:
    found = {name: (each.n_vertices, {*each.lips}, {*each.upper}) for name, each in TOPOLOGIES.items()}
    assert found == PUBLISHED
    assert [each.name for each in TOPOLOGIES.values()] == [*PUBLISHED]


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_region_is_known_by_its_size_and_bound_to_its_mesh(name: str) -> None:
    mesh, (vertices, lips, upper) = TOPOLOGIES[name], PUBLISHED[name]
    for part, sizes in (("lips", lips), ("upper", upper)):
        for size in sizes:
            region = Region.from_indices("some", range(size))
            assert " usual on " in mesh.remark(part, region)
            assert " not usual on " not in mesh.remark(part, region)
            assert " not usual on " in mesh.remark(part, Region.from_indices("some", range(size + 1)))
            assert mesh.bind(region).n_vertices == vertices
    assert mesh.bind(Region.from_indices("last", [vertices - 1])).indices == (vertices - 1,)
    with pytest.raises(ValueError, match=str(vertices)):
        mesh.bind(Region.from_indices("beyond", [vertices]))
    with pytest.raises(ValueError, match="belongs to a mesh"):
        mesh.bind(Region.from_indices("other", [0], n_vertices=vertices + 1))
