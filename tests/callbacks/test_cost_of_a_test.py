"""A test that takes days says so before it begins."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable

import pytest
from lightning.pytorch import Trainer

from facediff.callbacks import outputs
from facediff.errors import Note
from facediff.models import DualPathDiffusion
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
    trainer = make_trainer(callbacks=[outputs.ScoreTable(media_clips=0)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", Note)
        trainer.test(model, datamodule=tiny, verbose=False)
    (said,) = [str(each.message) for each in caught if issubclass(each.category, Note)]
    found = re.search(r"about (\d+) animations of (\d+) sampling steps", said)
    assert found is not None
    assert int(found[1]) <= sum(calls) <= 2 * int(found[1])  # a clip's usual style comes on top
    assert found[2] == "3"
