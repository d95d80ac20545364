"""``facediff adapt`` and ``facediff style``: a checkpoint that knows one person more, a style as a vector."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.cli.app import main
from facediff.data import collate
from facediff.data.preparation import write_templates
from facediff.models import load_model
from facediff.models.adaptation import grow
from facediff.models.audio_distillation import encoder_weights
from facediff.models.checkpoint import read_checkpoint
from facediff.models.checkpoint_content import IMPORTED, PROVENANCE_KEY
from facediff.models.styles import still_style
from facediff.utils.pickles import load_pickle
from tests.fakes.tiny import Tiny

FAST = ["--epochs", "3", "--accelerator", "cpu", "--quiet"]


@pytest.fixture(scope="module")
def adapted(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature dual-path checkpoint, adapted to the unseen C."""
    path = tmp_path_factory.mktemp("adapted") / "C.ckpt"
    words = ["--checkpoint", str(checkpoint), "--person", "C", "-o", str(path), "--learning-rate", "1e-3"]
    assert main(["adapt", *words, *FAST]) == 0
    return path


def error_of_c(path: Path, tiny: Tiny) -> float:
    """Mean squared error of C's test clips, conditioned on C where C is known."""
    model, total = load_model(path), 0.0
    dataset = tiny.dataset("test_b")
    for index in range(len(dataset)):
        sample = dataset[index]
        sample.identity = model.assets.identity_index("C")
        with torch.inference_mode():
            total += float((model.generate(collate([sample]))[0] - sample.motion).square().mean())
    return total


def test_new_speaker_starts_as_the_mean_of_the_others() -> None:
    before = torch.randn(3, 4)
    after = grow(before, torch.empty(4, 4))
    torch.testing.assert_close(after[0], before.mean(0))
    assert torch.equal(after[1:], before)
    assert grow(before, torch.empty(3, 4)) is before


def test_adapting_helps(adapted: Path, checkpoint: Path, tiny: Tiny, tmp_path: Path) -> None:
    """More epochs than the fixture's, so that a model of one epoch has something to gain."""
    path = tmp_path / "more.ckpt"
    words = ["--checkpoint", str(checkpoint), "--person", "C", "-o", str(path), "--learning-rate", "3e-3"]
    assert main(["adapt", *words, *FAST[2:], "--epochs", "30"]) == 0
    assert error_of_c(path, tiny) < 0.8 * error_of_c(checkpoint, tiny)


def test_new_speaker_is_tested_and_animated_by_name(
    adapted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--trainer.accelerator=cpu", f"--trainer.logger.save_dir={tmp_path}"]
    assert main(["test", "--ckpt_path", str(adapted), *words]) == 0
    soundfile.write(tmp_path / "speech.wav", np.random.default_rng(0).normal(0, 0.1, 16_000), 16_000)
    out = tmp_path / "speech.npy"
    words = ["--checkpoint", str(adapted), "--identity", "C", "-o", str(out), "--quiet"]
    assert main(["animate", str(tmp_path / "speech.wav"), *words]) == 0
    assert "identity C" in capsys.readouterr().out
    assert np.load(out).shape == (25, 24, 3)


@pytest.mark.slow
def test_train_person_leaves_the_rest_alone(checkpoint: Path, tmp_path: Path) -> None:
    path = tmp_path / "C.ckpt"
    words = ["--checkpoint", str(checkpoint), "--person", "C", "-o", str(path), "--train", "person"]
    assert main(["adapt", *words, *FAST]) == 0
    before, after = load_model(checkpoint).state_dict(), load_model(path).state_dict()
    parts = ("identity_encoder", "mesh_encoder", "style_encoder", "style_tokens", "speech_style")
    personal = tuple(f"network.{part}" for part in parts)
    moved = {name for name in before if before[name].shape == after[name].shape}
    moved = {name for name in moved if not torch.equal(before[name], after[name])}
    assert moved
    assert all(name.startswith(personal) for name in moved)
    assert all(p.requires_grad for p in load_model(path).parameters())


def test_joint_training_uses_the_corpus_too(checkpoint: Path, tmp_path: Path) -> None:
    path, imported = tmp_path / "C.ckpt", tmp_path / "imported.ckpt"
    torch.save({**torch.load(checkpoint), PROVENANCE_KEY: {IMPORTED: "FaceFormer"}}, imported)
    words = ["--checkpoint", str(imported), "--person", "C", "-o", str(path), "--mode", "joint"]
    assert main(["adapt", *words, *FAST[2:], "--epochs", "1"]) == 0
    assert load_model(path).provenance.items() >= {IMPORTED: "FaceFormer", "parent": "imported.ckpt"}.items()
    printed = read_checkpoint(path)["datamodule_hyper_parameters"]
    assert (printed["extra_identities"], printed["train_identities"]) == (["C"], None)


def test_a_style_vector_does_what_its_clip_does(checkpoint: Path, tmp_path: Path, fit: Callable[..., int]) -> None:
    path = checkpoint
    soundfile.write(tmp_path / "speech.wav", np.random.default_rng(0).normal(0, 0.1, 16_000), 16_000)
    vector = tmp_path / "B.npy"
    assert main(["style", "extract", "B_e02", "--checkpoint", str(path), "-o", str(vector)]) == 0
    written = np.load(vector)
    assert written.ndim == 1
    np.testing.assert_allclose(written[len(written) // 2 + 1 :], still_style(load_model(path)), atol=1e-6)
    made = []
    for style in ("B_e02", str(vector)):
        out = tmp_path / "out.npy"
        words = ["--checkpoint", str(path), "--style", style, "-o", str(out), "--quiet"]
        assert main(["animate", str(tmp_path / "speech.wav"), *words]) == 0
        made.append(np.load(out))
    np.testing.assert_allclose(made[0], made[1], atol=1e-5)


def test_the_mean_of_several_clips(checkpoint: Path, tmp_path: Path) -> None:
    for name, clips in (("a", ["B_e01"]), ("b", ["B_e02"]), ("both", ["B_e01", "B_e02"])):
        words = ["--checkpoint", str(checkpoint), "-o", str(tmp_path / f"{name}.npy")]
        assert main(["style", "extract", *clips, *words]) == 0
    one, two, both = (np.load(tmp_path / f"{name}.npy") for name in ("a", "b", "both"))
    np.testing.assert_allclose(both, (one + two) / 2, rtol=1e-5, atol=1e-6)


def test_what_cannot_work_is_said_before_training(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for words, said in (
        ("--person A", "the checkpoint knows A"),
        ("--person nobody", "neither a person's folder"),
        ("--voices 2 --mode joint", "--mode: has no effect without --person"),
        ("", "expected one of them"),
    ):
        assert main(["adapt", "--checkpoint", str(checkpoint), "-o", "out.ckpt", *words.split()]) == 2
        assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def person_folder(corpus: Path, root: Path, subject: str = "C", name: str = "Maria") -> Path:
    """The clips of a subject of the miniature corpus, as `facediff data import-person` lays out a person's."""
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True)
    rows = ["clip,subject,sentence,split"]
    for number, source in enumerate(sorted((corpus / "vertices_npy").glob(f"{subject}_*.npy")), 1):
        clip = f"{name}_s{number:02d}"
        shutil.copy(source, root / "vertices_npy" / f"{clip}.npy")
        shutil.copy(corpus / "wav" / f"{source.stem}.wav", root / "wav" / f"{clip}.wav")
        rows.append(f"{clip},{name},s{number:02d},{'test' if number == 7 else 'train'}")
    (root / "clips.csv").write_text("\n".join(rows) + "\n")
    template = load_pickle(corpus / "templates.pkl")[subject]
    write_templates(root / "templates.pkl", {name: template})
    (root / "manifest.json").write_text(json.dumps({"corpus": "person", "person": name, "frame_rate": 25}))
    return root


@pytest.mark.slow
def test_a_persons_folder_is_learnt_by_name(checkpoint: Path, tiny_root: Path, tmp_path: Path) -> None:
    """And a second person after the first; the folders are named in the checkpoint, so that it is tested as ever."""
    folder = person_folder(tiny_root, tmp_path / "maria")
    first, second = tmp_path / "first.ckpt", tmp_path / "second.ckpt"
    assert main(["adapt", "--checkpoint", str(checkpoint), "--person", str(folder), "-o", str(first), *FAST]) == 0
    model = load_model(first)
    assert model.identities == ["Maria", "A", "B"]
    assert "Maria" in model.assets.templates
    assert model.assets.references["Maria"].clip.startswith("Maria_")
    words = ["--trainer.accelerator=cpu", f"--trainer.logger.save_dir={tmp_path}"]
    assert main(["test", "--ckpt_path", str(first), *words]) == 0
    (table,) = tmp_path.rglob("test_sequences.csv")
    assert "Maria_s07" in table.read_text()
    other = person_folder(tiny_root, tmp_path / "eve", name="Eve")
    assert main(["adapt", "--checkpoint", str(first), "--person", str(other), "-o", str(second), *FAST]) == 0
    assert load_model(second).identities == ["Eve", "Maria", "A", "B"]


def test_voices(checkpoint: Path, tmp_path: Path) -> None:
    """Everything but the encoder's weights, and whose child it is, is what it was, bit for bit."""
    out = tmp_path / "voices.ckpt"
    words = ["adapt", "--checkpoint", str(checkpoint), "-o", str(out), "--accelerator", "cpu", "--quiet"]
    assert main([*words, "--voices", "2", "--augmentation", "noise:share=1"]) == 0
    before, after = read_checkpoint(checkpoint), read_checkpoint(out)
    assert after[PROVENANCE_KEY]["parent"] == checkpoint.name
    encoder = set(encoder_weights(load_model(out)))
    fitted = "network.speech_style."  # to the features of the encoder, and again
    for key in ("state_dict", "current_model_state"):
        for name, value in before.get(key, {}).items():
            assert torch.equal(value, after[key][name]) or name in encoder or name.startswith(fitted)
    assert not all(torch.equal(before["state_dict"][name], after["state_dict"][name]) for name in encoder)
    assert main([*words, "--voices", "2", "--augmentation", "noise:share=1", "--interpolation", "0.425"]) == 0
    half = read_checkpoint(out)["state_dict"]
    for name in encoder:  # half of the usual 0.85
        middle = torch.lerp(before["state_dict"][name], after["state_dict"][name], 0.5)
        torch.testing.assert_close(half[name], middle, atol=1e-6, rtol=1e-4)
    assert before["optimizer_states"]
    assert set(before) <= set(after)
