"""Model folders: the same model as the checkpoint, small, without a trace of its training or of this machine."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from facediff.callbacks.averaging import EmaWithWarmup
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from facediff.models.checkpoint import read_assets, read_checkpoint
from facediff.models.pretrained import coded, decoded, stored_once
from facediff.utils.licences import Licence, commercial_use
from facediff.utils.torch_files import read_safetensors
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny, write_tiny


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As training with averaged weights writes it."""
    import lightning.pytorch as pl

    from facediff import registry

    folder = tmp_path_factory.mktemp("pretrained")
    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=24, identities=["A", "B"], frame_rate=25.0, dim=8, diffusion_steps=10, decoder=registry.decoder.gru
    )

    class Saves(pl.Callback):
        """Saves before training ends, when the model takes over its average."""

        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            trainer.save_checkpoint(folder / "model.ckpt")

    trainer = quiet_trainer(folder, max_steps=3, limit_val_batches=0, callbacks=[EmaWithWarmup(), Saves()])
    trainer.fit(model, Tiny(root=str(write_tiny(folder / "tiny"))))
    return folder / "model.ckpt"


@pytest.fixture(scope="module")
def published(checkpoint: Path) -> Path:
    return load_model(checkpoint).save_pretrained(checkpoint.parent / "published", license="mit")


@pytest.fixture
def copy(published: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(published, tmp_path / "model"))


def motion(source: Path) -> torch.Tensor:
    return load_model(source).animate(torch.sin(torch.arange(8000) / 9), identity="B", seed=3).vertices


def test_a_folder_animates_bit_for_bit_as_its_checkpoint(checkpoint: Path, published: Path) -> None:
    assert torch.equal(motion(checkpoint), motion(published))


def test_the_weights_are_the_averaged_ones_and_nothing_of_the_training(checkpoint: Path, published: Path) -> None:
    raw = torch.load(checkpoint, weights_only=True)
    stored = read_checkpoint(published)["state_dict"]
    assert all(torch.equal(stored[name], value) for name, value in raw["state_dict"].items())
    assert any(not torch.equal(stored[name], value) for name, value in raw["current_model_state"].items())
    size = sum(value.numel() * value.element_size() for value in raw["state_dict"].values())
    header = 200 * len(raw["state_dict"])  # names weigh in this miniature
    assert (published / "model.safetensors").stat().st_size <= 1.05 * size + header
    assert {path.name for path in published.iterdir()} == {
        *("config.json", "model.safetensors", "assets.npz", "README.md")
    }


def test_no_path_of_this_machine_leaves_it(checkpoint: Path, published: Path) -> None:
    words = (published / "config.json").read_text() + (published / "README.md").read_text()
    assert str(checkpoint.parent) not in words
    assert os.environ.get("HOME", "/root") + "/" not in words


def test_assets_come_back_exactly(checkpoint: Path, published: Path) -> None:
    before, after = read_assets(checkpoint), read_assets(published)
    assert before.identities == after.identities
    assert before.motion_scale == after.motion_scale
    for name, template in before.templates.items():
        assert torch.equal(after.templates[name], template)
    for name, reference in before.references.items():
        assert after.references[name].clip == reference.clip
        assert after.references[name].motion.dtype == reference.motion.dtype
        assert torch.equal(after.references[name].motion, reference.motion)


@pytest.mark.parametrize("kind", [torch.float16, torch.float32])
def test_motion_is_coded_without_loss(kind: torch.dtype) -> None:
    value = torch.cat([torch.randn(9, 4, 3).cumsum(0) * 1e-3, torch.tensor([0.0, -0.0, 65504.0]).expand(1, 4, 3)])
    value = value.to(kind)
    back = np.ascontiguousarray(decoded(coded(value))).view(value.numpy().dtype).reshape(value.shape)
    assert back.tobytes() == value.numpy().tobytes()


def test_equal_tensors_are_stored_once(checkpoint: Path, published: Path) -> None:
    one = torch.randn(4)
    kept, shared = stored_once({"a": one, "b": one.clone(), "c": one.double(), "d": one.view(2, 2)})
    assert kept.keys() == {"a", "c", "d"}
    assert shared == {"b": "a"}
    total = {
        **read_safetensors(published / "model.safetensors"),
        **json.loads((published / "config.json").read_text())["shared"],
    }
    assert total.keys() == torch.load(checkpoint, weights_only=True)["state_dict"].keys()


def test_a_published_model_is_published_again_alike(published: Path, tmp_path: Path) -> None:
    again = load_model(published).save_pretrained(tmp_path / "again")
    assert (again / "model.safetensors").read_bytes() == (published / "model.safetensors").read_bytes()
    assert (again / "assets.npz").read_bytes() == (published / "assets.npz").read_bytes()


# Licences.


def test_labels_are_stored_at_training_and_published(checkpoint: Path, published: Path) -> None:
    trained, made = load_model(checkpoint), load_model(published)
    assert [each.of for each in trained.licences] == ["corpus tiny"]
    assert trained.licences[0].commercial == "unknown"
    assert made.licences[0] == Licence("weights", "mit", "allowed", made.licences[0].source)
    assert commercial_use(made.licences) == "unknown"  # the strictest decides
    with pytest.raises(FaceDiffError, match="corpus tiny"):
        load_model(published, commercial_only=True)


def test_the_licence_of_the_weights_is_by_default_that_of_the_data(checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint, weights_only=True)
    free, closed = Licence("corpus x", "CC0-1.0", "allowed"), Licence("corpus y", "secret terms", "forbidden")
    content["facediff_licences"] = [free.state(), closed.state()]
    torch.save(content, tmp_path / "mixed.ckpt")
    made = load_model(load_model(tmp_path / "mixed.ckpt").save_pretrained(tmp_path / "mixed"))
    assert made.licences[0].name == "secret terms"
    assert commercial_use(made.licences) == "forbidden"
    head = yaml.safe_load((tmp_path / "mixed" / "README.md").read_text().split("---\n")[1])
    assert head["license"] == "other"
    assert head["license_name"] == "secret-terms"
    assert head["commercial_use"] == "forbidden"


# The card.


def test_the_card_states_licence_and_data(checkpoint: Path, tmp_path: Path) -> None:
    folder = load_model(checkpoint).save_pretrained(tmp_path / "card", license="cc-by-nc-4.0", name="ada/face")
    _, head, body = (folder / "README.md").read_text().split("---\n", 2)
    found = yaml.safe_load(head)
    assert found["license"] == "cc-by-nc-4.0"
    assert found["library_name"] == "facediff"
    assert found["corpus"] == {"name": "tiny", "synthetic": True}
    for word in ("ada/face", "ynthetic", "Limits", "Intended use", "forbidden", "corpus tiny"):
        assert word in body


def test_a_folder_with_content_is_not_replaced(checkpoint: Path, copy: Path) -> None:
    before = (copy / "config.json").read_bytes()
    with pytest.raises(FaceDiffError, match="not empty"):
        load_model(checkpoint).save_pretrained(copy)
    assert (copy / "config.json").read_bytes() == before


# What is wrong with a folder is told in one sentence.


def leaves(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:  # noqa: ANN401
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(found for key, part in items for found in leaves(part, (*path, key)))][bool(not path) :]


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "assets.npz"])
def test_a_damaged_folder_is_refused_in_a_sentence_or_read(copy: Path, name: str) -> None:
    original, rng = (copy / name).read_bytes(), np.random.default_rng(len(name))
    damages = [original[: len(original) // 2], b"", *(bytearray(original) for _ in range(12))]
    for damaged in damages:
        if isinstance(damaged, bytearray):
            for place in rng.integers(len(damaged), size=3):
                damaged[place] = int(rng.integers(256))
        (copy / name).write_bytes(damaged)
        with contextlib.suppress(FaceDiffError):
            load_model(copy)
    (copy / name).unlink()
    with pytest.raises(FaceDiffError, match=name):
        load_model(copy)


WILD = (None, True, -1, 2**70, 1e400, "", "x", "../x", [], [1], {}, {"a": 1}, {"$tensor": "x"})


def test_every_leaf_of_a_config_may_be_anything(copy: Path) -> None:
    text = (copy / "config.json").read_text()
    for number, place in list(enumerate(leaves(json.loads(text))))[::5]:
        config = json.loads(text)
        inner = config
        for key in place[:-1]:
            inner = inner[key]
        inner[place[-1]] = WILD[number % len(WILD)]
        (copy / "config.json").write_text(json.dumps(config))
        with contextlib.suppress(FaceDiffError):
            load_model(copy)
