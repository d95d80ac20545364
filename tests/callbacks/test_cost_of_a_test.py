"""A test that takes days says so before it begins."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger

from facediff.callbacks import outputs
from facediff.errors import Note
from facediff.models import DualPathDiffusion
from facediff.utils.plain_files import load_json
from tests.fakes.tiny import Tiny


@pytest.mark.parametrize("policy", ["style_only", "each_seen"])
@pytest.mark.parametrize("draws", [1, 2])
def test_what_a_test_generates_is_told(
    policy: str,
    draws: int,
    make_model: Callable[..., DualPathDiffusion],
    tiny: Tiny,
    make_trainer: Callable[..., Trainer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = make_model(unseen_identity=policy, test_samples=draws)
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    calls: list[int] = []
    generate = DualPathDiffusion.generate

    def counting(self: DualPathDiffusion, batch: object, **options: object) -> object:
        calls.append(len(batch))  # type: ignore[arg-type]
        return generate(self, batch, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(DualPathDiffusion, "generate", counting)
    monkeypatch.setattr(outputs, "MANY_STEPS", 0)
    trainer = make_trainer(callbacks=[outputs.ScoreTable()])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", Note)
        trainer.test(model, datamodule=tiny, verbose=False)
    (said,) = [str(each.message) for each in caught if issubclass(each.category, Note)]
    found = re.search(r"about (\d+) animations of (\d+) sampling steps", said)
    assert found is not None
    clips = sum(len(tiny.clips(split)) for split in tiny.test_splits)
    assert 0 <= sum(calls) - int(found[1]) <= clips  # a clip's usual style comes on top
    assert found[2] == "3"


def test_a_sub_sample_is_tested_and_named(
    make_model: Callable[..., DualPathDiffusion],
    tiny_root: Path,
    make_trainer: Callable[..., Trainer],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    whole, some = Tiny(root=str(tiny_root)), Tiny(root=str(tiny_root), test_share=0.3)
    for split in whole.test_splits:
        names, all_names = ([clip.name for clip in data.clips(split)] for data in (some, whole))
        assert len(names) == math.ceil(0.3 * len(all_names))
        assert names == [name for name in all_names if name in names]
    assert [some.clips(split) for split in ("train", "val")] == [whole.clips(split) for split in ("train", "val")]
    model = make_model()
    model.adopt(some.assets().with_motion_scale(some.motion_scale()))
    trainer = make_trainer(logger=CSVLogger(tmp_path), callbacks=[outputs.ScoreTable()])
    with pytest.warns(Note, match=r"a sub-sample of test_[ab], \d clips? by data.test_share"):
        trainer.test(model, datamodule=some, verbose=False)
    assert "30 % of the test clips, a sub-sample" in capsys.readouterr().out
    report = load_json(Path(trainer.log_dir or "") / "test_report.json")
    assert {row["test_share"] for row in report["scores"]} == {0.3}
    tested = {row["clip"] for row in report["sequences"]}
    assert tested == {clip.name for split in some.test_splits for clip in some.clips(split)}
