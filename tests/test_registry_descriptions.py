"""Hyper-parameters become plain data that a checkpoint gives back under ``weights_only=True``."""

from __future__ import annotations

import enum
import importlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from facediff import registry
from facediff.hyperparameters import describe, plain
from facediff.models.decoders import GruDecoder


class Colour(enum.Enum):
    RED = "red"


class Word(str, enum.Enum):  # noqa: UP042 - the form whose str() is not its value
    LOUD = "loud"


class Level(enum.IntEnum):
    HIGH = 3


GRU = "facediff.registry.decoder.gru"
CASES: list[tuple[Any, Any]] = [
    (None, None),
    (True, True),
    (3, 3),
    (0.25, 0.25),
    ("text", "text"),
    (np.float64(0.1), 0.1),
    (np.float32(1.5), 1.5),
    (np.int64(7), 7),
    (np.bool_(True), True),
    (np.str_("word"), "word"),
    (np.array(2.0), 2.0),
    (np.array([[1, 2], [3, 4]]), [[1, 2], [3, 4]]),
    (torch.tensor([0.5, 1.0]), [0.5, 1.0]),
    (Path("some/where"), str(Path("some/where"))),
    (Colour.RED, "red"),
    (Word.LOUD, "loud"),
    (Level.HIGH, 3),
    ((1, (2.0, "x")), [1, [2.0, "x"]]),
    ({5}, [5]),
    ({"a": (np.int8(1), Path("b"))}, {"a": [1, "b"]}),
    (OmegaConf.create([1, "x"]), [1, "x"]),
    (OmegaConf.create({"a": [1, {"b": None}]}), {"a": [1, {"b": None}]}),
    (registry.decoder.gru, {"class_path": GRU, "init_args": {}}),
    (GruDecoder, {"class_path": GRU, "init_args": {}}),
    (
        partial(registry.decoder.gru, num_layers=np.int64(3)),
        {"class_path": GRU, "init_args": {"num_layers": 3}},
    ),
    (torch.nn.Linear, {"class_path": "torch.nn.modules.linear.Linear", "init_args": {}}),
]


def builtin_all_the_way(value: Any) -> bool:  # noqa: ANN401
    if isinstance(value, dict):
        return type(value) is dict and all(type(k) is str and builtin_all_the_way(v) for k, v in value.items())
    if isinstance(value, list):
        return type(value) is list and all(builtin_all_the_way(item) for item in value)
    return value is None or type(value) in (bool, int, float, str)


@pytest.mark.parametrize(("value", "expected"), CASES, ids=lambda value: type(value).__name__)
def test_plain_forms_survive_a_checkpoint(value: Any, expected: Any, tmp_path: Path) -> None:  # noqa: ANN401
    result = plain(value)
    assert result == expected
    assert builtin_all_the_way(result), result
    torch.save(result, tmp_path / "hparams.pt")
    assert torch.load(tmp_path / "hparams.pt", weights_only=True) == expected


def test_a_description_rebuilds_the_component() -> None:
    factory = partial(registry.decoder.gru, num_layers=1, bidirectional=False)
    description = describe(factory, factory(dim=3, style_dim=2))
    module, _, path = description["class_path"].partition(".decoder.")
    cls = getattr(importlib.import_module(module).decoder, path)
    rebuilt = cls(dim=3, style_dim=2, **description["init_args"])
    assert isinstance(rebuilt, GruDecoder)
    assert (rebuilt.gru.num_layers, rebuilt.gru.bidirectional) == (1, False)


def test_a_component_may_add_to_its_description() -> None:
    class Loaded:
        def checkpoint_init_args(self) -> dict[str, Any]:
            return {"config": {"width": np.int64(4), "path": Path("x")}}

    description = describe(partial(registry.decoder.gru, num_layers=1), Loaded())
    usual = {"bidirectional": True, "dropout": 0.1}
    assert description["init_args"] == {"num_layers": 1, **usual, "config": {"width": 4, "path": "x"}}


def test_options_left_at_their_defaults_are_written_down_too() -> None:
    """Else a component that is rebuilt takes equally named options of the one that usually stands in its place."""
    described = describe(partial(registry.decoder.gru, num_layers=1), object())["init_args"]
    assert described == {"num_layers": 1, "bidirectional": True, "dropout": 0.1}
    assert describe(registry.style_encoder.lstm, object())["init_args"] == {
        "style_dim": 32,
        "num_layers": 1,
        "pooling": "last",
    }
