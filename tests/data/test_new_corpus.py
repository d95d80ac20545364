"""The documentation's fourth corpus: its file is taken out of the page, and trained on as the page says."""

from __future__ import annotations

import pickle
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import main

PAGE = (Path(__file__).parents[2] / "docs" / "own_data.md").read_text()
VERTICES = 62
FRAMES = 32  # of a clip; the prior over time of the small configs takes 25
(SOURCE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's file as an importable module, and a folder for it; with few vertices, so that it trains quickly."""
    assert "n_vertices = 6172" in SOURCE
    (tmp_path / "multiface.py").write_text(SOURCE.replace("6172", str(VERTICES)))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "MULTIFACE"
    for folder in ("wav", "vertices_npy", "regions"):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    templates = {name: rng.uniform(-1, 1, (VERTICES, 3)) for name in ("2", "13", "1")}
    for subject, numbers in {"2": (1, 40, 41, 46), "13": (2, 3, 45, 50), "1": (5, 48)}.items():
        for number in numbers:
            motion = templates[subject].ravel() + rng.normal(0, 0.01, (FRAMES, VERTICES * 3))
            np.save(root / "vertices_npy" / f"{subject}_{number:02d}.npy", motion)
            soundfile.write(root / "wav" / f"{subject}_{number:02d}.wav", rng.uniform(-0.1, 0.1, FRAMES * 1600), 48000)
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    (root / "regions" / "lve.txt").write_text("0,1,2")
    (root / "regions" / "fdd.txt").write_text("3, 4, 5")
    yield root
    sys.modules.pop("multiface", None)


def test_the_file_is_short() -> None:
    assert len(SOURCE.splitlines()) < 80


def test_its_splits_are_multifaces(root: Path) -> None:
    import multiface

    data = multiface.Multiface(root=str(root))
    names = {split: [clip.name for clip in data.clips(split)] for split in ("train", "val", "test_a", "test_b")}
    assert names == {
        "train": ["13_02", "13_03", "2_01", "2_40"],
        "val": ["13_45", "2_41"],
        "test_a": ["13_50", "2_46"],
        "test_b": ["1_48"],
    }
    assert data.dataset("test_b")[0].reference_name == "1_05"


def test_what_a_class_lacks_is_named(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Facts and methods; a mesh is needed for pictures only."""
    source = Path("multiface.py").read_text()
    for name, pattern, words in (
        ("NoUnit", r"    unit = .*\n", "NoUnit: the class states no unit"),
        ("NoSplits", r"    def split_of(.|\n)*", "the class lacks split_of"),
        ("NoMesh", r"    mesh_files.*\n", ""),
    ):
        Path(f"lacking_{name}.py").write_text(re.sub(pattern, "", source.replace("Multiface(", f"{name}(")))
        assert (main(["data", "check", str(root), "--corpus", f"lacking_{name}.{name}"]) == 2) == bool(words)
        assert words in capsys.readouterr().err
    assert main(["fit", "--config", "configs/experiment/puppet.yaml", "--data=lacking_NoSplits.NoSplits"]) == 2
    assert "--data lacking_NoSplits.NoSplits: the class lacks split_of" in capsys.readouterr().err


@pytest.mark.slow
def test_it_trains_and_tests_from_the_command_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--config", "configs/experiment/puppet.yaml", "--data=multiface.Multiface", f"--data.root={root}"]
    words += ["--model.dim=16", "--model.sampler.steps=2", "--trainer.max_epochs=1", "--trainer.log_every_n_steps=1"]
    words += ["--trainer.check_val_every_n_epoch=1", "--trainer.enable_progress_bar=false"]
    assert main(["fit", *words, "--trainer.enable_model_summary=false"]) == 0
    (checkpoint,) = Path("runs").rglob("best.ckpt")
    assert main(["test", "--ckpt_path", str(checkpoint), "--trainer.enable_progress_bar=false"]) == 0
    assert "multiface/lips: 3 vertices" in capsys.readouterr().out
