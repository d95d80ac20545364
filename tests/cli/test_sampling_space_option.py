"""The sampling space may differ from the checkpoint's."""

from __future__ import annotations

from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.models import DualPathDiffusion

spaces = pytest.mark.parametrize("space", ["folded", "vertices"])


@spaces
@pytest.mark.slow
def test_it_is_chosen_at_test_time(
    checkpoint: Path, tmp_path: Path, space: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    real = DualPathDiffusion.generate

    def generate(self: DualPathDiffusion, *given: object, **named: object) -> object:
        seen.append(self.options.sampling_space)
        return real(self, *given, **named)

    monkeypatch.setattr(DualPathDiffusion, "generate", generate)
    words = ["--trainer.accelerator=cpu", f"--trainer.logger.save_dir={tmp_path}"]
    assert main(["test", "--ckpt_path", str(checkpoint), f"--model.sampling_space={space}", *words]) == 0
    assert set(seen) == {space}
