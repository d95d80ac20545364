"""The one door into a checkpoint: whatever stands in the file, it loads or is refused in one sentence.

The catalogue replaces every leaf of a valid checkpoint by wild values; whoever adds a key to checkpoints has it tested
here without a further line.
"""

from __future__ import annotations

import copy
import io
import itertools
import random
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from facediff.cli.app import main
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.base import build_model
from facediff.models.checkpoint import corpus_of, read_checkpoint
from tests.fakes.tiny import Tiny

Tree = Any
EVIL = "evilmodule"
HIDDEN = "c0ffee-hidden"


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> Tree:
    """A checkpoint as training writes it, of a model and a corpus in miniature."""
    from facediff import registry
    from tests.fakes.fixtures import quiet_trainer
    from tests.fakes.tiny import write_tiny

    folder = tmp_path_factory.mktemp("door")
    root = write_tiny(folder / "tiny")
    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=24, identities=["A", "B"], frame_rate=25.0, dim=8, diffusion_steps=10, decoder=registry.decoder.gru
    )
    trainer = quiet_trainer(folder, max_steps=1, limit_val_batches=0)
    trainer.fit(model, Tiny(root=str(root)))
    trainer.save_checkpoint(folder / "valid.ckpt")
    return torch.load(folder / "valid.ckpt", weights_only=True)


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A working folder with a module that leaves a mark when it is imported."""
    (tmp_path / f"{EVIL}.py").write_text(f"open(r'{tmp_path}/harm', 'w').close()\nclass Evil: pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("DOOR_SECRET", HIDDEN)
    yield
    assert EVIL not in sys.modules
    assert not (tmp_path / "harm").exists()


def leaves(tree: Tree, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every node: leaves and containers."""
    if path:
        yield path
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, item in items:
        yield from leaves(item, (*path, key))


def replaced(tree: Tree, path: tuple[Any, ...], value: object) -> Tree:
    """The tree with another value at a path; only the containers on the way are copied."""
    key, *rest = path
    changed = copy.copy(tree)
    if rest:
        changed[key] = replaced(tree[key], tuple(rest), value)
    elif value is MISSING:
        del changed[key]
    else:
        changed[key] = value
    return changed


MISSING = object()
WILD: dict[str, object] = {
    "missing": MISSING,
    "none": None,
    "true": True,
    "zero": 0,
    "minus": -1,
    "nan": float("nan"),
    "infinite": float("inf"),
    "empty": "",
    "module": f"{EVIL}.Evil",
    "attribute": "facediff.utils.files.os.system",
    "builtin": "builtins.eval",
    "secret": "${oc.env:DOOR_SECRET}",
    "relative": "${.root}",
    "address": "https://example.org/weights",
    "long": "x" * 100_000,
    "control": "a\x1b[31m\nb",
    "path": "../../etc/passwd",
    "yaml": f"{{class_path: {EVIL}.Evil}}",
    "class": {"class_path": f"{EVIL}.Evil", "init_args": {}},
    "hidden class": {"_class_path": f"{EVIL}.Evil", "_instantiator": f"{EVIL}.Evil"},
    "list": [],
    "nested": [[1, {"a": None}]],
    "keys": {1: 2, None: 3},
    "tensor": torch.zeros(2, 3),
    "whole": torch.zeros(2, 3, dtype=torch.long),
    "scalar": torch.tensor(float("nan")),
    "empty tensor": torch.zeros(0, 24, 3),
}


def law(load: Callable[[], object]) -> str:
    """Run a load: "loaded", or the sentence of its refusal; anything else fails the test."""
    try:
        load()
    except FaceDiffError as error:
        text = str(error)
        assert "\n" not in text.strip()
        assert text.isprintable()
        assert len(text) < 1500
        assert HIDDEN not in text
    else:
        text = "loaded"
    return text


def test_a_folder_that_training_was_given_relative_is_there_from_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "corpus").mkdir()
    source = {"class_path": "facediff.data.puppet.Puppet", "root": str(tmp_path / "corpus")}
    content = {DATA_SOURCE_KEY: source, "datamodule_hyper_parameters": {"root": "corpus"}}
    monkeypatch.chdir(tmp_path / "corpus")
    assert corpus_of("file.ckpt", content)[1]["root"] == source["root"]
    monkeypatch.chdir(tmp_path)
    assert corpus_of("file.ckpt", content)[1]["root"] == "corpus"
    source["root"] = str(tmp_path / "gone")
    monkeypatch.chdir(tmp_path / "corpus")
    assert corpus_of("file.ckpt", content)[1]["root"] == "corpus"


def load_everything(tree: Tree) -> object:
    """What the commands do with a checkpoint between the file and the first use."""
    for key in ("hyper_parameters", "state_dict", "facediff_assets"):
        if not isinstance(tree.get(key), dict):
            return read_tree(tree)
    read = read_tree(tree)
    corpus_of("file.ckpt", read)
    return build_model("file.ckpt", read)


def read_tree(tree: Tree) -> Tree:
    stream = io.BytesIO()
    torch.save(tree, stream)
    return read_checkpoint(stream)


CHECKED = ("hyper_parameters", "facediff_assets", "facediff_data", "datamodule_hyper_parameters", "facediff_format")


@pytest.mark.parametrize("draws", [50, pytest.param(150, marks=pytest.mark.slow)])
def test_every_leaf_of_a_checkpoint_may_be_anything(content: Tree, evil: None, draws: int) -> None:
    """Each node of the checked parts is left out, or becomes each wild value: some of them, by a fixed draw."""
    small = {key: value for key, value in content.items() if key in (*CHECKED, "state_dict")}
    paths = [path for path in leaves(small) if path[0] in CHECKED or len(path) == 1]
    pairs = list(itertools.product(paths, WILD))
    broken = []
    first = [(path, "missing") for path in paths if len(path) == 1]
    for path, name in [*first, *random.Random(0).sample(pairs, draws)]:  # noqa: S311
        try:
            law(lambda path=path, name=name: load_everything(replaced(small, path, WILD[name])))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - collected, so that one run shows all
            broken.append(f"{path} = {name}: {type(error).__name__}: {error}"[:300])
        except AssertionError as error:
            broken.append(f"{path} = {name}: {error}"[:300])
    assert not broken, "\n".join(broken)


def test_a_checkpoint_that_names_no_corpus_is_read(content: Tree) -> None:
    model = build_model("file.ckpt", read_tree({**content, "facediff_data": None}))
    assert model.data_source == {}


def test_lightnings_own_methods_use_the_door(content: Tree, tmp_path: Path, evil: None) -> None:
    path = tmp_path / "hostile.ckpt"
    for key in ("hyper_parameters", "datamodule_hyper_parameters"):
        torch.save(replaced(content, (key, "_instantiator"), f"{EVIL}.Evil"), path)
        loader = DualPathDiffusion if key == "hyper_parameters" else Tiny
        with pytest.raises((FaceDiffError, ValueError)):  # ValueError: Lightning's own refusal
            loader.load_from_checkpoint(path)
    torch.save(content, path)
    assert DualPathDiffusion.load_from_checkpoint(path).identities == ["A", "B"]
    assert Tiny.load_from_checkpoint(path).batch_size == 1


@pytest.mark.parametrize("command", ["test", "predict", "validate", "fit", "animate", "adapt", "style extract"])
@pytest.mark.parametrize("value", ["module", "secret", "hidden class"])
def test_no_command_imports_or_resolves_what_a_checkpoint_names(
    command: str, value: str, content: Tree, evil: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "hostile.ckpt"
    torch.save(replaced(content, ("hyper_parameters", "decoder"), WILD[value]), path)
    root = content["facediff_data"]["root"]
    words = {
        "fit": ["--config", "configs/experiment/puppet.yaml", "--ckpt_path", str(path)],
        "animate": [f"{root}/wav/A_e01.wav", "--checkpoint", str(path), "-o", "out.npz"],
        "adapt": ["--checkpoint", str(path), "--person", "C", "-o", "out.ckpt"],
        "style extract": [f"{root}/vertices_npy/A_e01.npy", "--checkpoint", str(path), "-o", "out.npy"],
    }.get(command, ["--ckpt_path", str(path)])
    assert main([*command.split(), *words]) == 2
    printed = capsys.readouterr()
    assert "hostile.ckpt" in printed.err
    assert HIDDEN not in printed.out + printed.err
    assert {file.name for file in tmp_path.iterdir()} == {"hostile.ckpt", f"{EVIL}.py"}


@pytest.mark.parametrize("device", ["meta", "cuda:99", "mps", "", "nothing", "cpu:3:4"])
def test_a_device_that_cannot_compute_is_refused(
    device: str, content: Tree, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "valid.ckpt"
    torch.save(content, path)
    speech = f"{content['facediff_data']['root']}/wav/A_e01.wav"
    words = [speech, "--checkpoint", str(path), f"--device={device}", "-o", str(tmp_path / "out.npz")]
    assert main(["animate", *words]) == 2
    assert "--device" in capsys.readouterr().err


@pytest.mark.parametrize(
    "wrapped",
    [
        lambda key: f"_orig_mod.{key}",
        lambda key: key.replace("decoder.", "decoder._orig_mod."),
        lambda key: f"_forward_module._fsdp_wrapped_module.{key}",
        lambda key: (
            ".".join(f"{word}._checkpoint_wrapped_module" for word in key.split(".")[:-1]) + "." + key.split(".")[-1]
        ),
    ],
)
def test_weights_of_wrapped_modules_are_the_models(
    wrapped: Callable[[str], str], content: Tree, tmp_path: Path
) -> None:
    weights = {wrapped(key).removeprefix("."): value for key, value in content["state_dict"].items()}
    assert weights.keys() != content["state_dict"].keys()
    torch.save({**content, "state_dict": weights}, tmp_path / "a.ckpt")
    assert read_checkpoint(tmp_path / "a.ckpt")["state_dict"].keys() == content["state_dict"].keys()
    build_model(tmp_path / "a.ckpt", read_checkpoint(tmp_path / "a.ckpt"))
