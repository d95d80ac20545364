"""The benchmark of long speech on the miniature corpus: it must see a joint where there is one."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from facediff.models import DualPathDiffusion
from facediff.speech.windows import WindowPlan
from tests.fakes.tiny import Tiny

FOLDER = Path(__file__).parents[2] / "tools" / "benchmarks"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    spec = importlib.util.spec_from_file_location("long_speech_benchmark", FOLDER / "long_speech.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_every_minute_and_both_ways_of_joining_are_told(
    tool: ModuleType,
    make_model: Callable[..., DualPathDiffusion],
    tiny: Tiny,
    tiny_root: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = make_model()
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    model.data_source = {"class_path": "tests.fakes.tiny.Tiny", "root": str(tiny_root)}
    model.windows = WindowPlan(1.2, 0.4, 0.5, 0.2, 2.0)
    with torch.inference_mode():
        tool.judged(model.eval(), "A", 65.0, plans=False)
    told = capsys.readouterr().out
    assert "test sentences of A" in told
    assert len(re.findall(r"^ +1  \d\.\d{4}$", told, re.MULTILINE)) == 1
    assert len(re.findall(r"(joined|hard cuts) +joints", told)) == 2


def test_the_measure_sees_a_jump_at_a_joint_and_none_where_there_is_none(
    tool: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = WindowPlan(4, 1)
    time = torch.arange(1000)[:, None, None] / 25
    smooth = torch.sin(5 * time + torch.arange(6).view(1, 2, 3))
    jumping = smooth.clone()
    for start in range(75, 1000, 75):
        jumping[start:] += 0.3
    marked = tool.joints_of(1000, plan, 25.0)
    assert marked[73:77].all()
    assert marked[98:102].all()
    assert not marked[80:95].any()
    for motion, low, high in ((smooth, 0.9, 1.1), (jumping, 2.0, np.inf)):
        tool.tell_joints("x", tool.acceleration(motion), marked, [500])
        ratio = float(re.findall(r"ratio ([\d.]+)", capsys.readouterr().out)[0])
        assert low < ratio < high


def test_the_material_is_the_sentences_in_time(
    tool: ModuleType, make_model: Callable[..., DualPathDiffusion], tiny: Tiny, tiny_root: Path
) -> None:
    model = make_model()
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    model.data_source = {"class_path": "tests.fakes.tiny.Tiny", "root": str(tiny_root)}
    made = tool.material(model, "B", 10.0)
    samples = [s for split in tiny.test_splits for s in tiny.dataset(split) if s.identity_name == "B"]
    assert made.clip.motion.shape[1] >= 250
    assert made.clip.audio.shape[1] == made.clip.motion.shape[1] * 640
    second = samples[1]
    start = made.joints[0]
    assert torch.equal(made.clip.motion[0, start : start + len(second.motion)], second.motion)
    assert torch.equal(made.clip.audio[0, start * 640 : start * 640 + len(second.audio)], second.audio)
