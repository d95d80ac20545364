"""Files of tensors: what PyTorch and safetensors write comes back, other objects are passed over, and nothing runs."""

from __future__ import annotations

import argparse
import collections
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.errors import FaceDiffError
from facediff.utils.torch_files import load_tensors, read_authors_checkpoint, read_safetensors, write_safetensors
from tests.fakes.hostile import Harm


class CfgNode(dict[str, object]):
    """A dict of another library's."""


def test_authors_files_give_their_tensors_and_options_whatever_else_they_hold(tmp_path: Path) -> None:
    options = argparse.Namespace(lr=1.0, data=Path("a/b"), layers=[1, 2], mean=np.zeros(3), node=CfgNode(x=1))
    content = {
        "args": options,
        "model": {
            "module.weight": torch.arange(3.0),
            "none": torch.zeros(0, 3),
            "p": torch.nn.Parameter(torch.ones(2)),
        },
        "optimiser": collections.defaultdict(dict, {1: {"step": torch.ones(1)}}),
        "best": np.float64(3.0),
        "generator": np.random.default_rng(0).bit_generator.state,
        "layer": torch.nn.Linear(2, 2),
        "config": CfgNode(dim=4),
    }
    torch.save(content, tmp_path / "author.pth")
    tensors, found = read_authors_checkpoint(tmp_path / "author.pth")
    assert {name: value.tolist() for name, value in tensors.items()} == {
        "weight": [0, 1, 2],
        "none": [],
        "p": [1, 1],
    }
    assert tensors["none"].shape == (0, 3)
    assert not tensors["p"].requires_grad
    assert found == {"lr": 1.0, "data": "a/b", "layers": [1, 2]}


def test_files_of_before_pytorch_1_6_are_read(tmp_path: Path) -> None:
    torch.save({"weight": torch.arange(3)}, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    assert read_authors_checkpoint(tmp_path / "old.pth")[0]["weight"].tolist() == [0, 1, 2]


def test_nothing_of_a_file_runs(tmp_path: Path) -> None:
    harm = Harm(tmp_path / "harm")
    torch.save({"weight": torch.ones(2), "harm": harm}, tmp_path / "hostile.pth")
    for read in (load_tensors, read_authors_checkpoint):
        with pytest.raises(FaceDiffError, match=r"hostile\.pth"):
            read(tmp_path / "hostile.pth")
    assert not harm.path.exists()


def test_a_file_without_tensors_by_name_is_refused(tmp_path: Path) -> None:
    torch.save([torch.ones(2)], tmp_path / "list.pth")
    with pytest.raises(FaceDiffError, match=r"list\.pth: holds no tensors by name"):
        read_authors_checkpoint(tmp_path / "list.pth")


def test_safetensors_come_back_and_damaged_files_are_named(tmp_path: Path) -> None:
    tensors = {"half": torch.randn(7).half(), "flags": torch.tensor([True, False]), "part": torch.randn(4, 4)[:, 1]}
    path = tmp_path / "model.safetensors"
    write_safetensors(path, tensors)
    found = read_safetensors(path)
    assert all(torch.equal(found[name], value) for name, value in tensors.items())
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FaceDiffError, match=r"model\.safetensors"):
        read_safetensors(path)
