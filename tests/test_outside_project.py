"""A package outside facediff with one extension of every kind, installed by pip and driven by name."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff import registry

ROOT = Path(__file__).parents[1]
PROJECT = ROOT / "docs" / "examples" / "outside_project"
ADDED = {
    ("audio_encoder", "loudness"),
    ("identity_encoder", "one_hot"),
    ("motion_space", "halved"),
    ("mesh_encoder", "distances"),
    ("style_encoder", "mean"),
    ("fusion", "gated"),
    ("decoder", "moving_average"),
    ("sampler", "one_jump"),
    ("model", "AutoregressiveTransformer"),
    ("corpus", "ThreeSpeakers"),
    ("metric", "lip_range"),
    ("augmentation", "reversed"),
    ("voice_gate", "above_level"),
    ("acting", "raised_brows"),
    ("puppet_voice", "hummer"),
    ("export_format", "bounds"),
    ("receiver", "counter"),
}
CHECKPOINT = "fit/version_0/checkpoints/epoch=2-step=24.ckpt"
"""Of the package's model, below the folder of the runs."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pip has installed the package; needs no network."""
    if not all(map(importlib.util.find_spec, ("pip", "setuptools"))):
        pytest.skip("installing a package needs pip and setuptools")
    folder = tmp_path_factory.mktemp("outside")
    copied = shutil.copytree(PROJECT, folder / "project")  # building leaves files behind
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
    words = ["install", *options, "--target", str(folder / "site"), str(copied)]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True, timeout=120)
    return folder / "site"


PROGRAM = """
import contextlib, io, json, sys
from facediff.cli.app import main
from tests.fakes.parsing import parse_imports_once

parse_imports_once()
outputs = {}
for name, words in json.load(sys.stdin).items():
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        try:
            status = main(words)
        except SystemExit as stop:  # --print_config
            status = stop.code
    assert status == 0, words
    outputs[name] = printed.getvalue()
print(json.dumps(outputs))
"""
"""Runs commands one after the other, and prints what each has printed."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the commands below write."""
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture(scope="module")
def printed(site: Path, tiny_root: Path, place: Path) -> dict[str, str]:
    """What the commands of all tests print, in one process that has the package: it begins as a user's does.

    A model and a corpus of the package go from training to a file in the package's own format; then dual-path diffusion
    of which every component is the package's, and speech, gate and acting as well, trains and performs.
    """
    trainer = ["--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false"]
    flags = ["--model.decoder=moving_average", "--model.decoder.reach=2", "--print_config"]
    corpus = ["--data=ThreeSpeakers", f"--data.root={tiny_root}", "--model.dim=16", *trainer]
    fit = ["--model=AutoregressiveTransformer", "--model.learning_rate=0.01", "--trainer.max_epochs=3"]
    own, checkpoint = [f"--trainer.logger.save_dir={place}"], str(place / CHECKPOINT)
    speech = {seconds: str(place / f"speech{seconds}.wav") for seconds in (1, 12)}
    for seconds, path in speech.items():
        soundfile.write(path, np.random.default_rng(0).normal(0, 0.1, seconds * 16_000), 16_000)
    kinds = ("audio_encoder", "identity_encoder", "motion_space", "mesh_encoder", "style_encoder", "fusion")
    names = dict(ADDED)
    parts = [f"--model.{kind}={names[kind]}" for kind in (*kinds, "decoder", "sampler")]
    parts += ["--data.augmentations=[reversed]", "--data.augmented_share=1", "--trainer.max_epochs=1"]
    whole = str(place / "whole" / "fit" / "version_0" / "checkpoints" / "last.ckpt")
    predictions = str(place / "predict" / "version_0" / "predictions")
    adapt = ["--train", "person", "--epochs", "1", "--accelerator", "cpu", "--quiet"]
    commands = {
        "components": ["components", "--json"],
        "decoder": ["fit", "--config", "configs/experiment/puppet.yaml", *flags],
        "fit": ["fit", *fit, *corpus, *own],
        "test": ["test", "--ckpt_path", checkpoint, "--model.metrics=[lip_range]", *trainer, *own],
        # Twelve seconds: longer than what is animated in one pass.
        "animate": ["animate", speech[12], "--checkpoint", checkpoint, "--identity", "C", "--quiet"]
        + ["-o", str(place / "speech.npz")],
        "help": ["--help"],
        "command": ["liveliest", str(place / "speech.npz"), "--count", "2"],
        "export": ["export", str(place / "speech.npz"), "-o", str(place / "speech.bounds")],
        "predict": ["predict", "--ckpt_path", checkpoint, *trainer, *own],
        "evaluate": ["evaluate", predictions, str(tiny_root), "--metric", "lip_range", "--quiet"]
        + ["--json", str(place / "scores.json")],
        "adapt": ["adapt", "--checkpoint", checkpoint, "--person", "C", "-o", str(place / "C.ckpt"), *adapt],
        "fit whole": ["fit", "--model=DualPathDiffusion", *corpus, *parts, f"--trainer.logger.save_dir={place}/whole"],
        "animate whole": ["animate", speech[1], "--checkpoint", whole, "--identity", "A", "--quiet"]
        + ["--voice-gate", "above_level", "-o", str(place / "whole.npz")],
        "live": ["live", whole, speech[1], "--to", "counter", "--quiet"],
    }
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        timeout=500,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]), "OMP_NUM_THREADS": "1"},
    )
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-3000:]
    return dict(json.loads(run.stdout.splitlines()[-1]))


def test_the_package_has_one_of_every_kind() -> None:
    assert {kind for kind, _ in ADDED} == registry.KINDS.keys()
    assert len(ADDED) == len(registry.KINDS)


def test_components_lists_the_extensions_of_an_installed_package(printed: dict[str, str]) -> None:
    rows = json.loads(printed["components"])
    found = {(row["kind"], row["name"]) for row in rows}
    assert found >= ADDED
    assert {(kind, name) for kind in registry.KINDS for name in registry.KINDS[kind].names()} <= found
    [row] = [row for row in rows if row["name"] == "moving_average"]
    assert row["class"] == "facediff_example.decoder.MovingAverageDecoder"
    assert row["summary"] == "Averages each frame with its neighbours and adds the mean style token."


def test_a_command_of_an_installed_package_runs_and_is_listed(printed: dict[str, str]) -> None:
    assert "liveliest           of the package facediff-example" in printed["help"]
    moments = [float(line.removesuffix(" s")) for line in printed["command"].splitlines()]
    assert len(moments) == 2
    assert 0 < moments[0] < moments[1] < 12


def test_an_installed_decoder_is_chosen_by_name(printed: dict[str, str]) -> None:
    assert "class_path: facediff_example.decoder.MovingAverageDecoder" in printed["decoder"]
    assert "reach: 2" in printed["decoder"]


def test_an_installed_model_is_trained_scored_animated_exported_and_adapted(
    printed: dict[str, str], place: Path
) -> None:
    assert "three_speakers" in printed["test"]
    assert "metric lip_range: in each sequence" in printed["test"]
    hparams = torch.load(place / CHECKPOINT, weights_only=True)["hyper_parameters"]
    assert hparams["_class_path"] == "facediff_example.model.AutoregressiveTransformer"
    assert (hparams["dim"], hparams["num_layers"], hparams["protocol"]) == (16, 1, "paper")
    assert hparams["audio_encoder"]["init_args"]["num_layers"]
    table = np.loadtxt(place / "speech.bounds")
    assert table.shape == (300, 6)
    assert (table[:, :3] < table[:, 3:]).any(1).all()
    assert len(list((place / "predict" / "version_0" / "predictions").iterdir())) == 4
    assert "lip_range" in (place / "scores.json").read_text()
    adapted = torch.load(place / "C.ckpt", weights_only=True)
    assert adapted["state_dict"]["identity_table.weight"].shape == (3, 16)


def test_all_of_its_components_train_and_animate_together(printed: dict[str, str], place: Path) -> None:
    assert 0 < int(printed["live"].split()[0]) <= 25  # of one second; those that come late are left out
    with np.load(place / "whole.npz") as archive:
        assert np.isfinite(archive["vertices"]).all()


def test_a_metric_of_its_own_needs_one_short_file() -> None:
    assert len((PROJECT / "facediff_example" / "metric.py").read_text().splitlines()) <= 40


def test_a_model_of_its_own_needs_little_more_than_network_and_loss() -> None:
    assert len((PROJECT / "facediff_example" / "model.py").read_text().splitlines()) <= 90
