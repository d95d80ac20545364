"""What `facediff benchmark` finds wrong with a plan's checkpoints before anything runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from facediff.benchmark import cells_of, read_plan
from facediff.cli.app import main
from facediff.cli.benchmark import check_cells, data_class
from facediff.errors import FaceDiffError


@pytest.fixture
def published(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A model folder, which knows its corpus but no folder of it."""
    assert main(["publish", str(checkpoint), str(tmp_path / "published"), "--license", "mit"]) == 0
    capsys.readouterr()
    return tmp_path / "published"


def test_a_model_folder_is_tested_where_the_plans_data_are(published: Path, tiny_root: Path) -> None:
    folder = published.parent
    (folder / "data.yaml").write_text(f"class_path: tests.fakes.tiny.Tiny\ninit_args: {{root: {tiny_root}}}\n")
    (folder / "plan.yaml").write_text("corpora: {tiny: {data: data.yaml}}\nmethods: {a: {checkpoint: published}}\n")
    plan = read_plan(folder / "plan.yaml")
    cells = cells_of(plan)
    found, _ = check_cells(plan, cells, folder / "out", dry_run=True)
    assert (found.roots, found.classes) == ({"tiny": str(tiny_root)}, {"tiny": "tests.fakes.tiny.Tiny"})
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("corpus", "named"),
    [
        ("tiny: {data: data.yaml}", "--root tiny=FOLDER"),
        ("tiny: {data: data.yaml, root: published}", ""),
        ("biwi: {data: configs/data/biwi.yaml}", "biwi"),
        ("puppet: {data: configs/data/puppet.yaml}", "puppet"),
    ],
)
def test_a_checkpoint_of_another_corpus_or_of_none_is_refused(
    published: Path, capsys: pytest.CaptureFixture[str], corpus: str, named: str
) -> None:
    folder = published.parent
    (folder / "data.yaml").write_text("class_path: tests.fakes.tiny.Tiny\n")
    plan = f"corpora: {{{corpus}}}\nmethods: {{row_1: {{checkpoint: published}}}}\n"
    (folder / "plan.yaml").write_text(plan)
    status = main(["benchmark", str(folder / "plan.yaml"), "-o", str(folder / "out"), "--dry-run"])
    (line, *more) = [text for text in capsys.readouterr().err.splitlines() if text.startswith("facediff: error")] or [
        ""
    ]
    assert status == (2 if named else 0)
    assert named in line
    assert not more
    assert ("row_1" in line) == bool(named)
    assert not (folder / "out").exists()


def test_a_dry_run_tells_what_tests_generate(tiny_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, tests = tiny_root.parent / "plan", {"a": "", "b": "model.unseen_identity: each_seen"}
    tests |= {"c": "model.test_samples: 3, model.sampler.steps: 4", "d": "data.test_share: 0.2"}
    folder.mkdir()
    (folder / "data.yaml").write_text(f"class_path: tests.fakes.tiny.Tiny\ninit_args: {{root: {tiny_root}}}\n")
    rows = [f"  {k}: {{config: configs/experiment/puppet.yaml, test_options: {{{o}}}}}" for k, o in tests.items()]
    head = ["seeds: [0, 1]", "corpora: {tiny: {data: data.yaml}}", "methods:"]
    (folder / "plan.yaml").write_text("\n".join([*head, *rows]))
    assert main(["benchmark", str(folder / "plan.yaml"), "-o", str(folder / "out"), "--dry-run"]) == 0
    told = dict(re.findall(r"^(\w) on tiny, seed 1 +fit +(\d+ × \d+ steps)", capsys.readouterr().out, re.MULTILINE))
    # 4 clips of A and B, 2 of C, whom each_seen turns into A and into B; each once more with another's speech.
    assert told == {"a": "12 × 10 steps", "b": "14 × 10 steps", "c": "30 × 4 steps", "d": "4 × 10 steps"}


@pytest.mark.parametrize("name", ["facediff.data.Biwii", "tests.fakes.tiny.Tinyy"])
def test_a_wrong_class_of_a_config_is_named_as_the_config_does(name: str) -> None:
    with pytest.raises(FaceDiffError, match="^class_path"):
        data_class(name)


def test_a_built_in_corpus_that_was_never_made_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    for corpus in ("puppet", "puppet_mask"):
        (tmp_path / "plan.yaml").write_text(
            f"corpora: {{{corpus}: {{data: configs/data/{corpus}.yaml}}}}\n"
            "methods: {voca: {config: configs/experiment/puppet_voca.yaml}}\nseeds: [0]\n"
        )
        assert main(["benchmark", str(tmp_path / "plan.yaml"), "-o", str(tmp_path / "out"), "--dry-run"]) == 0
        assert f"voca on {corpus}, seed 0" in capsys.readouterr().out
    assert not (tmp_path / "cache").exists()
