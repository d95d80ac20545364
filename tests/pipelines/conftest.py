"""A folder as in docs/python.md: a model of the built-in corpus, a recording, motion, a mesh and blendshapes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest

import facediff
from facediff.data import Puppet
from facediff.models import DualPathDiffusion
from facediff.synthetic.corpus import generate
from facediff.synthetic.known_faces import write_puppet_shapes

CLIPS = ["F1_e01", "F1_e03", "F1_t01", "M2_e01", "M2_e05", "M2_t13", "F4_e01"]


@pytest.fixture(scope="session")
def puppet_corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("espeakng_loader")
    root = tmp_path_factory.mktemp("puppet") / "corpus"
    generate(root, only=CLIPS, progress=False)
    return root


@pytest.fixture
def saved_model(
    puppet_corpus: Path,
    tmp_path_factory: pytest.TempPathFactory,
    make_model: Callable[..., DualPathDiffusion],
    make_trainer: Callable[..., pl.Trainer],
) -> Path:
    """A checkpoint of a model that has learnt nothing, on the corpus's faces and with its styles."""
    path = puppet_corpus.parent / "puppet.ckpt"
    if not path.is_file():  # once a session
        data = Puppet(root=str(puppet_corpus))
        data.prepare_data = lambda: None  # type: ignore[method-assign]  # five clips are enough
        model = make_model(n_vertices=5875, identities=data.identities)
        trainer = make_trainer(max_steps=1, limit_val_batches=0)
        trainer.fit(model, datamodule=data)
        trainer.save_checkpoint(path)
    return path


@cache
def loaded(path: Path) -> facediff.Animator:
    return facediff.load(path, device="cpu")


@pytest.fixture
def model(saved_model: Path) -> Iterator[facediff.Animator]:
    """Loaded once, since no call changes it."""
    found = loaded(saved_model)
    with found.module.choosing():
        yield found


@pytest.fixture
def workplace(saved_model: Path, puppet_corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder, which is the current one."""
    folder = tmp_path / "work"
    (folder / "demo").mkdir(parents=True)
    shutil.copy(saved_model, folder / "demo" / "puppet.ckpt")
    shutil.copy(puppet_corpus / "wav" / "F1_t01.wav", folder / "speech.wav")
    shutil.copy(puppet_corpus / "PUPPET.ply", folder / "face.ply")
    (folder / "templates.pkl").symlink_to(puppet_corpus / "templates.pkl")
    shutil.copytree(puppet_corpus / "vertices_npy", folder / "vertices_npy")
    write_puppet_shapes(folder / "shapes", "F1")
    # The model is hardly trained, and no shapes explain its motion: refused else, as of another face.
    monkeypatch.setattr("facediff.editing.blendshapes.VISIBLE_MM", np.inf)
    monkeypatch.chdir(folder)
    return folder
