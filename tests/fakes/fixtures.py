"""The fixtures of all tests. Importing it takes as long as PyTorch and Lightning do: see tests/conftest.py."""

from __future__ import annotations

import gc

gc.disable()  # what is imported and collected stays; it comes back below

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from facediff.cli.lightning import keep_freed_memory
from facediff.models import DualPathDiffusion
from facediff.runtime.onnxruntime_web import VERSION
from tests.fakes.chromium import Chromium, find_chromium
from tests.fakes.parsing import parse_imports_once
from tests.fakes.tiny import Tiny, tiny_model_options, write_tiny

# Tiny tensors are faster on one thread, and much faster where something else keeps the other cores busy.
torch.set_num_threads(1)
keep_freed_memory()
parse_imports_once()


def pytest_collection_finish() -> None:
    """Thousands of tests and all modules stay until the end: the garbage collector need not look at them each time."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True)
def seed_of_the_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """A seed that one test sets, which Lightning keeps in the environment, is not that of the next one."""
    for name in ("PL_GLOBAL_SEED", "PL_SEED_WORKERS"):
        monkeypatch.setenv(name, "0")  # so that it is put back, whatever a test makes of it
        monkeypatch.delenv(name)


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("corpus") / "tiny")


@pytest.fixture
def tiny(tiny_root: Path) -> Tiny:
    return Tiny(root=str(tiny_root))


@pytest.fixture(scope="session")
def make_model() -> Callable[..., DualPathDiffusion]:
    """A model small enough to train in a test; keyword arguments override."""

    def make(**options: object) -> DualPathDiffusion:
        torch.manual_seed(0)
        return DualPathDiffusion(**{**tiny_model_options(), **options})

    return make


def quiet_trainer(folder: Path, **options: Any) -> pl.Trainer:  # noqa: ANN401
    """A trainer for one epoch that writes nothing by itself; keyword arguments override."""
    defaults: dict[str, Any] = {
        "accelerator": "cpu",
        "devices": 1,
        "max_epochs": 1,
        "logger": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "enable_checkpointing": False,
        "num_sanity_val_steps": 0,
        "default_root_dir": folder,
        "log_every_n_steps": 1,
    }
    return pl.Trainer(**{**defaults, **options})


@pytest.fixture
def make_trainer(tmp_path: Path) -> Callable[..., pl.Trainer]:
    """:func:`quiet_trainer` in a folder of the test."""
    return partial(quiet_trainer, tmp_path)


HEADS = {"num_attention_heads": 4, "num_conv_pos_embeddings": 8, "num_conv_pos_embedding_groups": 4}


def saved(network: Any, config: Any, folder: Path) -> Path:  # noqa: ANN401 - of transformers
    """The folder, with a network of random weights in it, as transformers saves one."""
    from transformers.utils import logging

    torch.manual_seed(0)
    logging.disable_progress_bar()
    network(config).save_pretrained(folder)
    logging.enable_progress_bar()
    return folder


@pytest.fixture(scope="session")
def hubert_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A HuBERT of the published shape (seven convolutions, stride 320) in miniature, with random weights."""
    from transformers import HubertConfig, HubertModel

    sizes = {"hidden_size": 32, "num_hidden_layers": 3, "intermediate_size": 48, "conv_dim": (16,) * 7}
    config = HubertConfig(**sizes, **HEADS)
    return saved(HubertModel, config, tmp_path_factory.mktemp("hubert"))


@pytest.fixture(scope="session")
def deepspeech_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """DeepSpeech's converted graph in miniature, with random weights."""
    from tests.fakes.voca import deepspeech_state, write_arrays

    return write_arrays(tmp_path_factory.mktemp("deepspeech") / "deepspeech.npz", deepspeech_state())


@pytest.fixture(scope="session")
def ctc_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wav2vec 2.0 with a CTC head over 29 letters in miniature, of the published shape, with random weights."""
    from transformers import Wav2Vec2Config, Wav2Vec2ForCTC

    sizes = {"hidden_size": 16, "num_hidden_layers": 2, "intermediate_size": 24, "conv_dim": (8,) * 7}
    config = Wav2Vec2Config(vocab_size=29, **sizes, **HEADS)
    return saved(Wav2Vec2ForCTC, config, tmp_path_factory.mktemp("ctc"))


def installed(found: Path | None, name: str) -> Path:
    """What was found; otherwise the test is skipped, or fails where FACEDIFF_REQUIRE_BROWSER is set."""
    if found is None:
        end = pytest.fail if os.environ.get("FACEDIFF_REQUIRE_BROWSER") else pytest.skip
        end(f"no {name} found: run  export FACEDIFF_CHROMIUM=$(tools/browser/install.sh DIR)")
    return found


@pytest.fixture(scope="session")
def program() -> Path:
    """A Chromium."""
    return installed(find_chromium(), "Chromium")


@pytest.fixture(scope="session")
def browser(program: Path) -> Iterator[Chromium]:
    with Chromium(program) as running:
        yield running


@pytest.fixture(scope="session")
def web_runtime_package(program: Path) -> Path:
    """ONNX Runtime for browsers, which the browser's installation brings along."""
    name = f"onnxruntime-web-{VERSION}.tgz"
    places = (folder / name for folder in (program.parent, program.parent.parent))
    return installed(next((path for path in places if path.is_file()), None), name)
