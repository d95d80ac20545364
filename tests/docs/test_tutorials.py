"""The classes and the plan that the pages have their readers save train and are valid, on a miniature of a corpus."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from facediff.benchmark.plan import read_plan
from facediff.cli.lightning import words_of_checkpoint
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel
from facediff.models.audio_encoders import MelEncoder
from tests.fakes.tiny import Tiny

ROOT = Path(__file__).parents[2]
PAGES = {name: (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8") for name in ("tutorial_research", "losses")}
SAVED = {
    "tutorial_research": ("my_method", "SpeechGRU", {"dim": 16}),
    "losses": ("my_losses", "LipFaceFormer", {"dim": 16, "audio_encoder": MelEncoder, "audio_dim": 16}),
}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working folder of both pages."""
    for page, (module, _, _) in SAVED.items():
        (tmp_path / f"{module}.py").write_text(blocks(page, "python")[0])
    for name, block in zip(("mine", "plan"), blocks("tutorial_research", "yaml"), strict=True):
        (tmp_path / f"{name}.yaml").write_text(block)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for module, _, _ in SAVED.values():
        sys.modules.pop(module, None)


@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize("page", SAVED)
def test_the_class_of_the_page_trains_and_generates(
    page: str, tiny: Tiny, make_trainer: Callable[..., pl.Trainer]
) -> None:
    module, name, options = SAVED[page]
    made: type[AnimationModel] = getattr(importlib.import_module(module), name)
    model: Any = made.for_data(tiny, **options)
    make_trainer(max_steps=1, limit_val_batches=0).fit(model, datamodule=tiny)
    batch = collate([tiny.dataset("test_a")[0]])
    terms = model.losses(batch)
    assert set(terms) >= {"reconstruction", "loss"}
    motion = model.eval().generate(batch)
    assert motion.shape[2:] == (tiny.n_vertices, 3)
    assert torch.isfinite(motion).all()


@pytest.mark.usefixtures("workplace")
def test_the_plan_of_the_tutorial_is_valid() -> None:
    plan = read_plan(Path("plan.yaml"))
    assert [*plan.methods] == ["mine", "faceformer", "selftalk", "facediffuser"]


@pytest.mark.usefixtures("workplace")
def test_a_model_of_the_working_folder_is_scored_where_its_user_names_it(
    tiny: Tiny, tmp_path: Path, make_trainer: Callable[..., pl.Trainer]
) -> None:
    trainer = make_trainer(max_steps=1, limit_val_batches=0)
    trainer.fit(importlib.import_module("my_method").SpeechGRU.for_data(tiny, dim=16), datamodule=tiny)
    checkpoint = tmp_path / "last.ckpt"
    trainer.save_checkpoint(checkpoint)
    del sys.modules["my_method"]
    with pytest.raises(FaceDiffError, match="--model=my_method.SpeechGRU"):
        words_of_checkpoint("test", checkpoint, [])
    assert "my_method" not in sys.modules
    with pytest.raises(FaceDiffError, match="--model.dim"):
        words_of_checkpoint("test", checkpoint, ["--model=my_method.SpeechGRU", "--model.dim=8"])
    for words in (["--model", "my_method.SpeechGRU"], ["--config", "mine.yaml"]):
        sys.modules.pop("my_method", None)
        option, config = words_of_checkpoint("test", checkpoint, words)
        assert option == "--config"
        assert "class_path: my_method.SpeechGRU" in config
