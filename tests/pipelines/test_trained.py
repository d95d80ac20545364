"""A model of channels as a pipeline: decoded vertices, weights as they are, and how the head turns."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from lightning.pytorch import Trainer

from facediff.animation import Animation
from facediff.animation.archives import read_animation
from facediff.animation.options import AnimationOptions, ExportOptions
from facediff.cli.app import main
from facediff.data import Reference
from facediff.errors import FaceDiffError
from facediff.export import check_export
from facediff.models import DiffPoseTalk, DualPathDiffusion, import_checkpoint, load_model
from facediff.models.published.importing import save_model
from facediff.pipelines.trained import TrainedPipeline
from facediff.spaces.rotations import convert
from facediff.speech.audio import read_speech, speech_of
from facediff.synthetic.known_faces import built_in_rig
from tests.fakes import published_parameters
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.fakes.published import AUDIO_CONFIG

SPEECH = np.sin(np.arange(16_000) / 9).astype(np.float32)


@pytest.fixture
def checkpoint(
    make_model: Callable[..., DualPathDiffusion], make_trainer: Callable[..., Trainer], tmp_path: Path
) -> Path:
    data = TinyChannels(root=str(write_channels(tmp_path / "channels")), batch_size=4)
    trainer = make_trainer(max_steps=1, limit_val_batches=0)
    trainer.fit(make_model(n_vertices=6, space=CHANNELS), data)
    trainer.save_checkpoint(tmp_path / "channels.ckpt")
    return tmp_path / "channels.ckpt"


def animate(checkpoint: Path, **options: object) -> Animation:
    pipeline = TrainedPipeline(AnimationOptions(checkpoint=str(checkpoint), seed=3, quiet=True, **options))  # type: ignore[arg-type]
    with pipeline.animations(speech_of(SPEECH, 16_000)) as (animation,):
        return animation


def test_the_animation_is_what_the_rig_makes_of_its_channels(checkpoint: Path) -> None:
    animation, assets = animate(checkpoint), load_model(checkpoint).assets
    assert animation.values is not None
    assert animation.values.shape == (25, 6)
    decoded = (
        assets.to_scored(torch.from_numpy(animation.values)[..., None], "A").numpy() + assets.mesh.template("A").numpy()
    )
    np.testing.assert_allclose(animation.still().vertices, decoded, atol=1e-6)
    assert animation.head is not None
    np.testing.assert_allclose(
        animation.head[:, :3], convert(animation.values[:, 3:], "euler", "axis_angle"), atol=1e-6
    )


def test_weights_are_written_as_they_are(checkpoint: Path, tmp_path: Path) -> None:
    animation = animate(checkpoint)
    assert animation.values is not None
    animation.save(tmp_path / "speech.csv")
    with (tmp_path / "speech.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    written = np.array([[float(row[name]) for name in ("JawOpen", "BrowInnerUp", "MouthLeft")] for row in rows])
    np.testing.assert_allclose(written[: len(animation.values)], animation.values[:, :3], atol=1e-7)
    animation.save(tmp_path / "speech.npz")
    again = read_animation(tmp_path / "speech.npz")
    np.testing.assert_array_equal(again.values, animation.values)
    assert again.space == CHANNELS
    assert again.part([3, 4]).values is not None


def test_changed_vertices_have_no_channels_any_more(checkpoint: Path, tmp_path: Path) -> None:
    animation = animate(checkpoint, expressiveness="2")
    assert animation.values is None
    assert animation.space.is_vertices
    with pytest.raises(FaceDiffError, match="blendshapes"):
        check_export(tmp_path / "a.csv", ExportOptions())
    with pytest.raises(FaceDiffError, match="blendshapes"):
        animation.save(tmp_path / "a.csv")


def test_a_stream_gives_what_the_file_has(checkpoint: Path) -> None:
    """Pauses, decoded vertices and the turning head, however the speech is cut."""
    speech = np.concatenate([SPEECH, 0 * SPEECH, *[SPEECH] * 9])
    pipeline = TrainedPipeline(AnimationOptions(checkpoint=str(checkpoint), seed=3, quiet=True, window=1, overlap=0.4))
    with pipeline.animations(speech_of(speech, 16_000)) as (animation,):
        assert animation.values is not None
        stream = pipeline.stream()
        pieces = [stream.feed(piece) for piece in np.split(speech, [1, 20_000, 20_001])]
        np.testing.assert_allclose(np.concatenate([*pieces, stream.finish()]), animation.vertices, atol=1e-6)
        stream = pipeline.stream(channels=True)
        channels = np.concatenate([stream.feed(speech), stream.finish()])
        np.testing.assert_allclose(channels[..., 0], animation.values, atol=1e-6)
    still = animation.values[40]
    assert not still[[0, 2]].any()
    assert still[[1, 3]].all()  # pauses rest the lower face


def test_arkit_channels_without_a_rig_move_the_built_in_face(
    make_model: Callable[..., DualPathDiffusion], make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    data = TinyChannels(root=str(write_channels(tmp_path / "channels")), batch_size=4)
    data.mesh_corpus = None  # type: ignore[assignment]
    trainer = make_trainer(max_steps=1, limit_val_batches=0)
    trainer.fit(make_model(n_vertices=6, space=CHANNELS), data)
    trainer.save_checkpoint(tmp_path / "bare.ckpt")
    animation = animate(tmp_path / "bare.ckpt")
    rig = built_in_rig()
    assert animation.values is not None
    decoded = rig.only(CHANNELS.channels[:3]).decode(animation.values[:, :3])
    np.testing.assert_allclose(animation.still().vertices, decoded, atol=1e-5)
    assert {"lips", "upper_face"} <= animation.regions.keys()


def test_channels_without_a_face_are_written_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """FLAME's coefficients without FLAME, from the command line, in the style of a clip of a stated layout."""
    monkeypatch.chdir(tmp_path)
    model = import_checkpoint(
        published_parameters.write_diffposetalk(tmp_path, head=True),
        audio_config=AUDIO_CONFIG,
        statistics=published_parameters.statistics(),
    )
    assert isinstance(model, DiffPoseTalk)
    save_model(model, tmp_path / "dpt.ckpt")
    values = np.random.default_rng(0).normal(size=(12, 56)).astype(np.float32)
    np.savez(tmp_path / "clip.npz", exp=values[:, :50], pose=values[:, 50:])
    soundfile.write(tmp_path / "a.wav", SPEECH[:13_000], 16_000)
    words = ["animate", "a.wav", "--checkpoint", "dpt.ckpt", "--seed", "3", "--style", "clip.npz@flame_diffposetalk"]
    for name in ("x.npz", "x.npy"):
        assert main([*words, "--quiet", "-o", name]) == 0
    heard = torch.from_numpy(read_speech(tmp_path / "a.wav"))
    clip = Reference("clip", torch.from_numpy(values)[..., None])
    expected = model.animate(heard, identity=model.identities[0], style=clip, seed=3).vertices[..., 0].numpy()
    written = read_animation(tmp_path / "x.npz")
    assert written.values is not None
    assert written.without_face
    assert np.allclose(written.values, expected, atol=1e-5)
    assert np.array_equal(np.load(tmp_path / "x.npy"), written.values)
    assert main([*words, "--quiet", "-o", "x.glb"]) == 2
    assert "--mesh" in capsys.readouterr().err
