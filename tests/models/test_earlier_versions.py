"""Options that 1.x had: their one remaining value is dropped from checkpoints and configs, any other is refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
import yaml

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from facediff.models.earlier_versions import REMOVED, SHORT_NAMES, without_removed_options
from facediff.utils.hints import defaults
from tests.fakes.tiny import Tiny


def class_at(path: str) -> type:
    module, _, name = path.rpartition(".")
    return getattr(__import__(module, fromlist=[name]), name)


@pytest.mark.parametrize("path", REMOVED)
def test_a_removed_option_is_gone_and_named_in_plain_data(path: str) -> None:
    assert not REMOVED[path].keys() & defaults(class_at(path)).keys()
    values = {n: list(v) if isinstance(v, tuple) else v for n, v in REMOVED[path].items() if not callable(v)}
    assert yaml.safe_load(yaml.safe_dump(values)) == values


@pytest.mark.parametrize("name", SHORT_NAMES)
def test_short_names_are_those_of_the_registry(name: str) -> None:
    classes = [kind.get(name) for kind in registry.COMPONENTS.values() if name in kind.names()]
    assert any(f".{SHORT_NAMES[name]}" in [f".{cls.__name__}" for cls in found.__mro__] for found in classes)


def with_option(content: Mapping[str, Any], **options: Any) -> dict[str, Any]:  # noqa: ANN401
    return {**content, "hyper_parameters": {**content["hyper_parameters"], **options}}


def test_a_checkpoint_of_1_1_loads_and_one_with_what_is_gone_is_refused(
    make_model: Callable[..., DualPathDiffusion],
    make_trainer: Callable[..., pl.Trainer],
    tiny: Tiny,
    tmp_path: Path,
) -> None:
    path = tmp_path / "earlier.ckpt"
    trainer = make_trainer(max_steps=1)
    trainer.fit(make_model(), datamodule=tiny)
    trainer.save_checkpoint(path)
    content = torch.load(path, weights_only=True)
    of_tests = {"score_by": ["mood"], "unseen_identity": "adapted"}
    torch.save(with_option(content, min_snr=None, invented_gain=0.1, style_guidance=1.0, **of_tests), path)
    for model in (load_model(path), DualPathDiffusion.load_from_checkpoint(path)):
        assert not {"min_snr", "invented_gain", "style_guidance", "score_by"} & model.hparams.keys()
        assert all(torch.equal(model.state_dict()[name], value) for name, value in content["state_dict"].items())
    torch.save(with_option(content, min_snr=5.0), path)
    with pytest.raises(FaceDiffError, match=r"earlier\.ckpt: min_snr=5\.0 .*facediff 1\.1"):
        load_model(path)


def test_values_of_removed_options_may_follow_from_others_and_sizes_may_be_any() -> None:
    voca = {"class_path": "facediff.models.Voca", "init_args": {"frame_rate": 30.0, "rows_per_frame": 2}}
    assert without_removed_options(voca, "c")["init_args"] == {"frame_rate": 30.0}
    voca["init_args"]["rows_per_frame"] = 1
    with pytest.raises(FaceDiffError, match="rows_per_frame=1"):
        without_removed_options(voca, "c")
    speaker = {"class_path": "facediff.models.DiffSpeaker", "init_args": {"time_dim": 768}}
    assert without_removed_options(speaker, "c")["init_args"] == {}


@pytest.mark.parametrize("prefix", ["", "facediff.models.", "facediff.models.dual_path.model."])
def test_configs_of_1_1_are_read_however_they_name_the_class(prefix: str) -> None:
    config = {
        "model": {"class_path": f"{prefix}DualPathDiffusion", "init_args": {"dim": 8, "min_snr": None, "score_by": []}}
    }
    assert without_removed_options([config], "run/config.yaml")[0]["model"]["init_args"] == {"dim": 8}
    other = {"class_path": "mine.DualPathDiffusion", "init_args": {"min_snr": 5.0}}
    assert without_removed_options(other, "run/config.yaml") == other
