from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from facediff.cli.app import main

SMALL = [
    "--model.dim=16",
    "--model.diffusion_steps=20",
    "--model.motion_space.prior_frames=5",  # clips of the miniature corpus are short
    "--model.sampler.steps=2",
    "--trainer.max_epochs=1",
    "--trainer.check_val_every_n_epoch=1",
    "--trainer.enable_progress_bar=false",
    "--trainer.enable_model_summary=false",
    "--trainer.log_every_n_steps=1",
]


@pytest.fixture(scope="session")
def fit(tiny_root: Path) -> Callable[..., int]:
    """`facediff fit` with the bundled experiment, on the miniature corpus."""

    def run(*words: str, config: str = "configs/experiment/puppet.yaml") -> int:
        data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}"]
        given = {word.partition("=")[0] for word in words}
        small = SMALL if config == "configs/experiment/puppet.yaml" else [w for w in SMALL if "motion_space" not in w]
        usual = [word for word in [*data, *small] if word.partition("=")[0] not in given]
        return main(["fit", "--config", config, *usual, *words])

    return run


@pytest.fixture(scope="session")
def fitted(fit: Callable[..., int], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder made by the command line with another decoder than the config's."""
    folder = tmp_path_factory.mktemp("runs")
    assert fit(f"--trainer.logger.save_dir={folder}", "--model.decoder=gru", "--model.decoder.num_layers=1") == 0
    return folder / "puppet" / "version_0"


@pytest.fixture(scope="session")
def checkpoint(fitted: Path) -> Path:
    return fitted / "checkpoints" / "best.ckpt"
