"""The dashboard shows what docs/monitoring.md lists, and is made without a network."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.fakes.processes import run

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tools" / "wandb_dashboard.py"
SECTIONS = ["Losses", "Metrics", "Optimisation", "Throughput", "Previews", "Test"]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    pytest.importorskip("wandb_workspaces")
    spec = importlib.util.spec_from_file_location("wandb_dashboard", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def documented(head: str) -> list[str]:
    lines = (ROOT / "docs" / "monitoring.md").read_text(encoding="utf-8").splitlines()
    start = lines.index(head) + 2
    end = next(place for place, line in enumerate(lines) if place >= start and not line.startswith("|"))
    return [line.split("`")[1] for line in lines[start:end]]


def texts(value: object) -> Iterator[str]:
    """Every text in a JSON value, keys left out."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from texts(item)


@pytest.fixture
def view(tool: ModuleType, tmp_path: Path) -> dict[str, Any]:
    path = tmp_path / "dashboard.json"
    assert tool.main(["--entity=team", "--project=faces", "--clips", "A_e05", f"--output={path}"]) == 0
    return json.loads(path.read_text())


def test_every_documented_name_is_shown(view: dict[str, Any]) -> None:
    panels = [
        panel["config"]
        for section in view["spec"]["section"]["panelBankConfig"]["sections"]
        for panel in section["panels"]
    ]
    shown = set(texts([{**panel, "chartTitle": ""} for panel in panels]))
    patterns = [panel["metricRegex"] for panel in panels if panel.get("useMetricRegex")]
    examples = {"gradient/<component>": "gradient/decoder", "preview/<clip>": "preview/A_e05"}
    for name in documented("| name | meaning | logged |"):
        name = examples.get(name, name)
        assert name in shown or any(re.fullmatch(pattern, name) for pattern in patterns), name


def test_sections_columns_and_groups(view: dict[str, Any]) -> None:
    section = view["spec"]["section"]
    assert (view["entity"], view["project"]) == ("team", "faces")
    assert [part["name"] for part in section["panelBankConfig"]["sections"]] == SECTIONS
    known = {*documented("| name | meaning | logged |"), *documented("| name | meaning |")}
    columns = [name.partition(":")[2] for name in section["runSets"][0]["runFeed"]["columnPinned"]]
    assert set(columns) - {"displayName"} <= known
    groups = [group["name"].removesuffix(".value") for group in section["runSets"][0]["grouping"]]
    assert groups == ["data/corpus", "protocol"]
    lines = [p for part in section["panelBankConfig"]["sections"] for p in part["panels"] if "xAxis" in p["config"]]
    assert {panel["config"]["xAxis"] for panel in lines} == {"trainer/global_step"}


def test_other_loss_terms(tool: ModuleType, tmp_path: Path) -> None:
    assert tool.main(["--entity=team", "--output", str(tmp_path / "view.json"), "--terms", "cycle"]) == 0
    shown = set(texts(json.loads((tmp_path / "view.json").read_text())))
    assert {"train/loss", "train/cycle", "val/cycle"} <= shown
    assert "train/velocity" not in shown


def test_without_the_package(
    tool: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "wandb_workspaces"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "wandb_workspaces", None)
    assert tool.main(["--entity=team", "--output=view.json"]) == 2
    assert "pip install wandb wandb-workspaces" in capsys.readouterr().err


def test_saving_without_a_key_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb_workspaces")
    for name in [name for name in os.environ if name.startswith(("WANDB", "NETRC"))]:
        monkeypatch.delenv(name)
    done = run(SCRIPT, "--entity=team", env={"HOME": str(tmp_path)})
    assert done.returncode == 2
    assert done.stderr.startswith("error: the dashboard of team/facediff was not saved: no API key found")
    assert len(done.stderr.splitlines()) == 1
