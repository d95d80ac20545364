"""``facediff publish``, and what takes its folder in place of a checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import main
from facediff.utils.arrays import read_arrays


@pytest.fixture(scope="module")
def published(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published") / "face"
    assert main(["publish", str(checkpoint), str(folder), "--license", "mit"]) == 0
    return folder


@pytest.fixture
def speech(tiny_root: Path) -> str:
    return str(tiny_root / "wav" / "A_e01.wav")


def test_a_folder_animates_as_its_checkpoint_and_states_its_licence(
    checkpoint: Path, published: Path, speech: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = {}
    for name, source in (("ckpt", checkpoint), ("folder", published)):
        made[name] = tmp_path / f"{name}.npz"
        assert main(["animate", speech, "--checkpoint", str(source), "--quiet", "-o", str(made[name])]) == 0
    arrays = {name: read_arrays(path) for name, path in made.items()}
    assert np.array_equal(arrays["ckpt"]["vertices"], arrays["folder"]["vertices"])
    metadata = json.loads(str(arrays["folder"]["about"]))["metadata"]
    assert metadata["checkpoint"] == "face"
    assert metadata["commercial_use"] == "unknown"
    assert "weights: mit" in metadata["licence"]
    assert "corpus tiny" in metadata["licence"]
    assert metadata["licence"] in capsys.readouterr().out


def test_a_glb_states_the_licence_where_programs_show_it(published: Path, speech: str, tmp_path: Path) -> None:
    import pygltflib

    path = tmp_path / "face.glb"
    assert main(["animate", speech, "--checkpoint", str(published), "--quiet", "-o", str(path)]) == 0
    document = pygltflib.GLTF2().load(str(path))
    assert document is not None
    assert "weights: mit" in document.asset.copyright
    assert document.nodes[0].extras["metadata"]["commercial_use"] == "unknown"


@pytest.mark.parametrize("command", ["animate", "style extract", "publish"])
def test_commercial_only_refuses_what_is_not_cleared(
    command: str, published: Path, speech: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = {
        "animate": ["animate", speech, "--checkpoint", str(published), "-o", str(tmp_path / "out.npz")],
        "style extract": ["style", "extract", "A_e01", "--checkpoint", str(published), "-o", str(tmp_path / "s.npy")],
        "publish": ["publish", str(published), str(tmp_path / "again")],
    }[command]
    assert main([*words, "--commercial-only"]) == 2
    assert "corpus tiny" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_corpus_of_a_folder_is_scored_where_the_user_says(
    published: Path, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["test", "--ckpt_path", str(published), "--trainer.accelerator=cpu", "--trainer.logger=false"]
    words += [f"--trainer.default_root_dir={tmp_path}", "--trainer.enable_progress_bar=false"]
    assert main(words) == 2
    assert "--data.root" in capsys.readouterr().err
    assert main([*words, f"--data.root={tiny_root}"]) == 0
    assert (tmp_path / "test_scores.csv").is_file()


def test_training_cannot_go_on_from_a_folder(published: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fit", "--config", "configs/experiment/puppet.yaml", "--ckpt_path", str(published)]
    assert main(words) == 2
    assert "--ckpt_path" in capsys.readouterr().err
