"""The published config of the second method trains, validates and animates on a FLAME-like corpus in miniature."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.cli.app import main
from facediff.cli.lightning import run_cli
from facediff.data import Batch, Vocaset
from facediff.models import Style, StyleContentDisentanglement, load_model
from tests.fakes.vocaset import TEST, TRAIN, TRAIN_2, VALIDATION, VERTICES, flame_masks, write_vocaset

EYES = np.arange(VERTICES - 6, VERTICES)
CLIPS = {
    TRAIN: ("sentence01", "sentence02"),
    TRAIN_2: ("sentence01", "sentence02"),
    VALIDATION: ("sentence01", "sentence21"),
    TEST: ("sentence01", "sentence21"),
}


class MiniVocaset(Vocaset):
    """VOCASET with few vertices."""

    n_vertices = VERTICES


def write(root: Path) -> Path:
    """Clips of 45 frames at 30 a second; the last vertices are eyeballs."""
    write_vocaset(root, clips=CLIPS, frames=90)
    masks = {**flame_masks(), "left_eyeball": EYES[:3], "right_eyeball": EYES[3:]}
    (root / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks, 2))
    (root / "regions" / "inner_lip_pairs.txt").write_text(f"{VERTICES // 2}, {VERTICES // 2 + 8}\n")
    return root


@pytest.mark.slow
def test_the_published_config_trains_and_animates(
    tmp_path: Path, ctc_source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write(tmp_path / "vocaset")
    monkeypatch.chdir(Path(__file__).parents[2])
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    seen: list[Batch] = []
    losses = StyleContentDisentanglement.losses

    def note(model: StyleContentDisentanglement, batch: Batch, generator: object = None) -> object:
        if model.training:
            seen.append(batch)
        return losses(model, batch, None)

    monkeypatch.setattr(StyleContentDisentanglement, "losses", note)
    words = ["--config", "configs/experiment/vocaset_style_content_paper.yaml"]
    words += [f"--data={__name__}.MiniVocaset", f"--data.root={root}", "--data.num_workers=0"]
    words += [f"--model.audio_encoder.source={ctc_source}", "--model.mesh_encoder.factor=2"]
    words += ["--trainer.accelerator=cpu", "--trainer.max_epochs=1", "--trainer.limit_train_batches=2"]
    words += ["--trainer.check_val_every_n_epoch=1", f"--trainer.logger.save_dir={tmp_path / 'runs'}"]
    words += ["--trainer.enable_progress_bar=false", "--trainer.enable_model_summary=false"]
    made = run_cli("fit", words)
    trainer, model = made.trainer, made.model

    assert trainer.global_step == 2
    assert {"val/lve", "train/swap", "train/cycle", "train/speech_swap"} <= trainer.callback_metrics.keys()
    assert (model.network.speech_content.window, model.network.speech_rate) == (32, 50.0)
    assert sorted(set(range(VERTICES)) - set(model.face().tolist())) == EYES.tolist()
    assert not set(model.lower_face().tolist()) & {*EYES.tolist(), *model.assets.regions["upper_face"].tolist()}
    assert len(seen) == 2
    for batch in seen:
        assert len(batch) == 4, "two pairs"
        assert batch.features is not None, "logits of whole clips, cut to the window"
        assert batch.features.shape[2] == 29
        assert batch.window is not None
        assert (batch.window[:, 1] - batch.window[:, 0]).tolist() == [20] * 4
        assert batch.window_mask.sum(1).tolist() == [20] * 4
        assert batch.partner_frames is not None
        assert batch.sentences[::2] == batch.sentences[1::2]
        assert ((batch.partner_frames >= 0) & batch.window_mask).sum() > 40, "most of the frames have a partner"
    # The styles of all motion, of seen and unseen speakers; no clip that is evaluated is among them.
    assert model.person_styles.keys() == CLIPS.keys()
    assert model.person_styles[VALIDATION].name.endswith("(1 clip)")

    best = next((tmp_path / "runs").rglob("best.ckpt"))
    loaded = load_model(best)
    style = loaded.default_style(TRAIN)
    assert isinstance(style, Style)
    parts = [torch.split(trainer.datamodule.corpus.read_motion(clip), 20) for clip in trainer.datamodule.clips("train")]
    vectors = [
        loaded.encode_style(part[None], torch.ones(1, len(part), dtype=torch.bool))[0] * len(part)
        for clip, whole in zip(trainer.datamodule.clips("train"), parts, strict=True)
        for part in whole
        if clip.identity == TRAIN
    ]
    torch.testing.assert_close(style.vector, torch.stack(vectors).sum(0).detach() / 90, rtol=1e-4, atol=1e-6)
    with torch.no_grad():
        assert not torch.equal(loaded.network.seen(torch.ones(1, 1, VERTICES, 3))[0, 0, :, 0], torch.ones(VERTICES))
    wav = root / "wav" / f"{TEST}_sentence21.wav"
    out = tmp_path / "speech.npy"
    assert main(["animate", str(wav), "--checkpoint", str(best), "--identity", TEST, "-o", str(out), "--quiet"]) == 0
    assert np.load(out).shape == (45, VERTICES, 3)
    monkeypatch.chdir(tmp_path)  # where the folder of the test is written
    assert main(["test", "--ckpt_path", str(best), "--trainer.enable_progress_bar=false"]) == 0
