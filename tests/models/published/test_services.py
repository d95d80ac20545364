"""What every published method gets of training: processes, 16 bits, kept features, adaptation, policies, previews."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from lightning.pytorch import Callback, LightningModule, Trainer, seed_everything

from facediff.callbacks import SpeechFeatureCache
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, load_model
from facediff.models.published.importing import save_model
from facediff.models.speech_networks import Wav2Vec2Encoder
from tests.fakes.tiny import RATE, SEEN, UNSEEN, VERTICES, Tiny
from tests.models.published.conftest import METHODS, TEXT
from tests.models.published.test_laws import with_assets

MakeMethod = Callable[..., AnimationModel]
MakeTrainer = Callable[..., Trainer]
WORKER = Path(__file__).with_name("distributed_worker.py")
SPEECH: dict[str, Any] = {"audio_encoder": partial(Wav2Vec2Encoder, config=TEXT), "audio_dim": None}


class Losses(Callback):
    def __init__(self) -> None:
        self.found: list[float] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: object) -> None:  # noqa: ANN401
        self.found.append(float(outputs["loss"]))


def train_together(methods: list[str], root: Path, prior: Path, folder: Path) -> list[dict[str, Any]]:
    """What two processes made of some methods."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    outs = [folder / f"{rank}.json" for rank in range(2)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    processes = [
        subprocess.Popen(  # noqa: S603
            [sys.executable, str(WORKER), str(rank), port, str(root), str(prior), str(outs[rank]), *methods],
            cwd=folder,
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        for process in processes:
            _, errors = process.communicate(timeout=240)
            assert process.returncode == 0, errors[-3000:]
    finally:
        for process in processes:
            process.kill()
    return [json.loads(out.read_text(encoding="utf-8")) for out in outs]


@pytest.mark.slow
@pytest.mark.parametrize("methods", [["DiffSpeaker"], sorted(METHODS.keys() - {"DiffSpeaker"})], ids=["one", "others"])
def test_two_processes_train_one_model(methods: list[str], tiny_root: Path, prior_file: Path, tmp_path: Path) -> None:
    """Though in each of them other layers are skipped and other steps are masked."""
    one, other = train_together(methods, tiny_root, prior_file, tmp_path)
    assert one == other
    assert set(one) == set(methods)
    for method, made in one.items():
        assert made["finite"], method
        assert made["steps"] == 2, method
        assert made["after"] != made["before"], method


@pytest.mark.two_methods
def test_kept_speech_features_change_no_loss(
    method: str, make_method: MakeMethod, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path
) -> None:
    found, encoded = [], []
    for callbacks in ([], [SpeechFeatureCache(str(tmp_path))], [SpeechFeatureCache(str(tmp_path))]):
        seed_everything(1, verbose=False)
        model, clips, losses = make_method(method, **SPEECH), [], Losses()
        if callbacks and not model.encodes_whole_clips:
            with pytest.raises(FaceDiffError, match=f"SpeechFeatureCache: {method}"):
                make_trainer(callbacks=callbacks).fit(model, datamodule=tiny)
            return
        model.audio_encoder.network.feature_extractor.register_forward_pre_hook(
            lambda _, given, clips=clips: clips.append(len(given[0]))
        )
        make_trainer(limit_train_batches=2, limit_val_batches=0, callbacks=[losses, *callbacks]).fit(
            model, datamodule=tiny
        )
        found.append(losses.found)
        encoded.append(len(clips))
    assert len(found[0]) == 2
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert found[2] == found[1]
    assert encoded[0] > 0
    assert encoded[2] == 0  # not even once


def test_speech_features_of_an_encoder_without_a_frozen_part_are_not_kept(
    method: str, make_method: MakeMethod, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path
) -> None:
    with pytest.raises(FaceDiffError, match="SpeechFeatureCache"):
        make_trainer(callbacks=[SpeechFeatureCache(str(tmp_path))]).fit(make_method(method), datamodule=tiny)


@pytest.mark.two_methods
def test_the_command_line_adapts_animates_in_windows_and_exports(
    method: str, make_method: MakeMethod, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = with_assets(make_method(method))
    checkpoint, adapted = tmp_path / "model.ckpt", tmp_path / "adapted.ckpt"
    model.data_source = {"class_path": "tests.fakes.tiny.Tiny", "root": str(tiny_root)}
    save_model(model, checkpoint)
    words = ["--checkpoint", str(checkpoint), "--person", UNSEEN, "-o", str(adapted), "--quiet"]
    words += [
        "--epochs",
        "1",
        "--accelerator",
        "cpu",
        "--corpus",
        "tests.fakes.tiny.Tiny",
        "--data-root",
        str(tiny_root),
    ]
    assert main(["adapt", *words]) == 0
    grown = load_model(adapted)
    assert grown.identities == [UNSEEN, *SEEN]
    wave = np.sin(np.arange(3 * 16_000) / 9.0)
    soundfile.write(tmp_path / "speech.wav", 0.1 * wave, 16_000)
    spoken = [str(tmp_path / "speech.wav"), "--checkpoint", str(adapted), "--identity", UNSEEN, "--window", "1"]
    assert main(["animate", *spoken, "-o", str(tmp_path / "face.glb"), "--quiet"]) == 0
    frames = re.search(r"(\d+) frames", capsys.readouterr().out)
    assert frames is not None
    assert int(frames[1]) in (3 * RATE, 3 * RATE - 1)
    assert (tmp_path / "face.glb").stat().st_size > int(frames[1]) * VERTICES
