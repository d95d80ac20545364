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


def facediff(site: Path, *commands: list[str]) -> str:
    """Run commands one after the other in a process that has the package; what they print."""
    program = (
        "import json, sys\nfrom facediff.cli.app import main\n"
        "for words in json.loads(sys.argv[1]):\n    status = main(words)\n    assert status == 0, words\n"
    )
    path = os.pathsep.join([str(site), str(ROOT)])
    run = subprocess.run(
        [sys.executable, "-c", program, json.dumps(commands)],
        capture_output=True,
        text=True,
        timeout=500,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
    )
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-3000:]
    return run.stdout


def test_the_package_has_one_of_every_kind() -> None:
    assert {kind for kind, _ in ADDED} == registry.KINDS.keys()
    assert len(ADDED) == len(registry.KINDS)


def test_components_lists_the_extensions_of_an_installed_package(site: Path) -> None:
    rows = json.loads(facediff(site, ["components", "--json"]))
    found = {(row["kind"], row["name"]) for row in rows}
    assert found >= ADDED
    assert {(kind, name) for kind in registry.KINDS for name in registry.KINDS[kind].names()} <= found
    [row] = [row for row in rows if row["name"] == "moving_average"]
    assert row["class"] == "facediff_example.decoder.MovingAverageDecoder"
    assert row["summary"] == "Averages each frame with its neighbours and adds the mean style token."


def test_an_installed_decoder_is_chosen_by_name(site: Path) -> None:
    flags = ["--model.decoder=moving_average", "--model.decoder.reach=2"]
    words = ["fit", "--config", "configs/experiment/puppet.yaml", *flags, "--print_config"]
    printed = facediff(site, words)
    assert "class_path: facediff.registry.decoder.moving_average" in printed
    assert "reach: 2" in printed


def test_an_installed_model_is_trained_scored_animated_exported_and_adapted(
    site: Path, tiny_root: Path, tmp_path: Path
) -> None:
    """A model and a corpus of a package, from training to a file in the package's own format."""
    trainer = [
        "--trainer.accelerator=cpu",
        "--trainer.enable_progress_bar=false",
        f"--trainer.logger.save_dir={tmp_path}",
    ]
    fit = ["--model=AutoregressiveTransformer", "--model.dim=16", "--model.learning_rate=0.01"]
    fit += ["--data=ThreeSpeakers", f"--data.root={tiny_root}", "--trainer.max_epochs=3"]
    checkpoint = tmp_path / "fit" / "version_0" / "checkpoints" / "epoch=2-step=24.ckpt"
    speech, archive, boxes = (tmp_path / f"speech.{suffix}" for suffix in ("wav", "npz", "bounds"))
    predictions, scores = tmp_path / "predict" / "version_0" / "predictions", tmp_path / "scores.json"
    adapted, adapt = tmp_path / "C.ckpt", ["--train", "person", "--epochs", "1", "--accelerator", "cpu", "--quiet"]
    soundfile.write(speech, np.random.default_rng(0).normal(0, 0.1, 12 * 16_000), 16_000)
    printed = facediff(
        site,
        ["fit", *fit, *trainer],
        ["test", "--ckpt_path", str(checkpoint), "--model.metrics=[lip_range]", *trainer],
        # Twelve seconds: longer than what is animated in one pass.
        ["animate", str(speech), "--checkpoint", str(checkpoint), "--identity", "C", "-o", str(archive), "--quiet"],
        ["export", str(archive), "-o", str(boxes)],
        ["predict", "--ckpt_path", str(checkpoint), *trainer],
        ["evaluate", str(predictions), str(tiny_root), "--metric", "lip_range", "--json", str(scores), "--quiet"],
        ["adapt", "--checkpoint", str(checkpoint), "--person", "C", "-o", str(adapted), *adapt],
    )
    assert "three_speakers" in printed
    assert "metric lip_range: in each sequence" in printed
    hparams = torch.load(checkpoint, weights_only=True)["hyper_parameters"]
    assert hparams["_class_path"] == "facediff_example.model.AutoregressiveTransformer"
    assert (hparams["dim"], hparams["num_layers"], hparams["protocol"]) == (16, 1, "paper")
    assert hparams["audio_encoder"]["init_args"]["num_layers"]
    table = np.loadtxt(boxes)
    assert table.shape == (300, 6)
    assert (table[:, :3] < table[:, 3:]).any(1).all()
    assert len(list(predictions.iterdir())) == 4
    assert "lip_range" in scores.read_text()
    assert torch.load(adapted, weights_only=True)["state_dict"]["identity_table.weight"].shape == (3, 16)


def test_all_of_its_components_train_and_animate_together(site: Path, tiny_root: Path, tmp_path: Path) -> None:
    """Dual-path diffusion of which every component is the package's; speech, gate and acting are as well."""
    kinds = ("audio_encoder", "identity_encoder", "motion_space", "mesh_encoder", "style_encoder", "fusion")
    names = dict(ADDED)
    fit = ["--model=DualPathDiffusion", "--model.dim=16", "--data=ThreeSpeakers", f"--data.root={tiny_root}"]
    fit += [f"--model.{kind}={names[kind]}" for kind in (*kinds, "decoder", "sampler")]
    fit += ["--data.augmentations=[reversed]", "--data.augmented_share=1", "--trainer.max_epochs=1"]
    fit += ["--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false", f"--trainer.logger.save_dir={tmp_path}"]
    checkpoint = tmp_path / "fit" / "version_0" / "checkpoints" / "last.ckpt"
    speech = tmp_path / "speech.wav"
    soundfile.write(speech, np.random.default_rng(0).normal(0, 0.1, 16_000), 16_000)
    animate = ["animate", str(speech), "--checkpoint", str(checkpoint), "--identity", "A", "--quiet"]
    facediff(site, ["fit", *fit], [*animate, "--voice-gate", "above_level", "-o", str(tmp_path / "speech.npz")])
    printed = facediff(site, ["live", str(checkpoint), str(speech), "--to", "counter", "--quiet"])
    assert "25 frames" in printed
    with np.load(tmp_path / "speech.npz") as archive:
        assert np.isfinite(archive["vertices"]).all()


def test_a_metric_of_its_own_needs_one_short_file() -> None:
    assert len((PROJECT / "facediff_example" / "metric.py").read_text().splitlines()) <= 40


def test_a_model_of_its_own_needs_little_more_than_network_and_loss() -> None:
    assert len((PROJECT / "facediff_example" / "model.py").read_text().splitlines()) <= 90
