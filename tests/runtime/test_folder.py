"""Folders of models of channels: what they hold, what is made of it, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from facediff.animation.options import AnimationOptions
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.pipelines.exported import ExportedPipeline
from facediff.runtime import RuntimeModel, styles
from facediff.runtime.folder import ARRAYS, DESCRIPTION, copy_exported, packed_deltas
from facediff.runtime.site import make_site
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters
from facediff.spaces.layouts import layout
from facediff.spaces.rotations import convert
from facediff.speech.audio import speech_of
from tests.fakes.exported import CHANNELS, STATE, fit_sizes, write_exported
from tests.runtime.test_runtime import sound


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_exported(tmp_path / "channels", space=CHANNELS)


def test_a_folder_animates_in_channels(folder: Path) -> None:
    """Files, streams and streams of channels have the same frames, pauses included."""
    speech = np.concatenate([sound(6.0), np.zeros(32_000, np.float32), sound(4.0)])
    pipeline = ExportedPipeline(AnimationOptions(checkpoint=folder, seed=2, quiet=True))
    with pipeline.animations(speech_of(speech, 16_000)) as (animation,):
        assert animation.values is not None
        assert animation.space == CHANNELS
        assert animation.head is not None
        turns = convert(animation.values[:, -3:], "euler", "axis_angle")
        np.testing.assert_allclose(animation.head[:, :3], turns, atol=1e-6)
        decoder = RuntimeModel.open(folder).decoder(0)
        assert decoder is not None
        decoded = decoder.vertices(animation.values[..., None])
        np.testing.assert_allclose(animation.still().vertices, decoded, atol=1e-5)
        stream = pipeline.stream()
        pieces = [stream.feed(piece) for piece in np.split(speech, [1, 20_000, 20_001])]
        np.testing.assert_allclose(np.concatenate([*pieces, stream.finish()]), animation.vertices, atol=1e-5)
        stream = pipeline.stream(channels=True)
        channels = np.concatenate([stream.feed(speech), stream.finish()])
        np.testing.assert_array_equal(channels[..., 0], animation.values)


def test_the_command_writes_weights_as_they_are(folder: Path, tmp_path: Path) -> None:
    import soundfile

    soundfile.write(tmp_path / "speech.wav", sound(1.0), 16_000)
    arguments = ["animate", str(tmp_path / "speech.wav"), "--checkpoint", str(folder), "--seed", "1", "-o"]
    assert main([*arguments, str(tmp_path / "out.csv")]) == 0
    clip = read_parameters(tmp_path / "out.csv")
    pipeline = ExportedPipeline(AnimationOptions(checkpoint=folder, seed=1, quiet=True))
    with pipeline.animations(speech_of(sound(1.0), 16_000)) as (animation,):
        assert animation.values is not None
        written = clip.values[: len(animation.values)]
        jaw, head = clip.space.index("jawOpen"), list(clip.space.head)
        np.testing.assert_allclose(written[:, jaw], animation.values[:, CHANNELS.index("jawOpen")], atol=1e-3)
        # Angles beyond 90 degrees are written as others of the same rotation.
        turns = [convert(angles, "euler", "six_d") for angles in (written[:, head], animation.values[:, -3:])]
        np.testing.assert_allclose(turns[0], turns[1], atol=1e-3)
    assert main([*arguments, str(tmp_path / "louder.csv"), "--expressiveness", "1.5"]) != 0


def test_a_recording_in_weights_is_a_style(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    live_link = layout("live_link")
    values = np.random.default_rng(0).random((25, 61)).astype(np.float32) / 4
    write_parameters(tmp_path / "take.csv", ParameterClip("take", values, live_link, 25.0))
    model, encoded = RuntimeModel.open(folder), []
    monkeypatch.setattr(styles, "encode_style", lambda _, motion, name: encoded.append((motion, name)))
    styles.style_from(str(tmp_path / "take.csv"), model, "A")
    ((motion, name),) = encoded
    assert (name, motion.shape) == ("take", (25, STATE, 1))
    jaw = values[:, live_link.index("jawOpen")]
    np.testing.assert_allclose(motion[:, CHANNELS.index("jawOpen"), 0], jaw, atol=1e-6)
    np.save(tmp_path / "motion.npy", np.zeros((5, 6, 3), np.float32))
    with pytest.raises(FaceDiffError, match=r"motion\.npy"):
        styles.style_from(str(tmp_path / "motion.npy"), model, "A")


def test_the_page_says_that_it_plays_vertices_only(folder: Path) -> None:
    with pytest.raises(FaceDiffError, match="channels"):
        make_site(folder, {})


def test_displacements_take_16_bits() -> None:
    rigs = np.random.default_rng(0).normal(size=(2, 3, 40, 3)) * np.array([1e-6, 1.0, 0.0])[:, None, None]
    packed, scales = packed_deltas(rigs)
    sizes = np.abs(rigs).max((2, 3))[..., None, None]
    assert (np.abs(packed * scales[..., None, None] - rigs) <= sizes / 65_000).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("resting", None),
        ("deltas", None),
        ("deltas", np.zeros((1, STATE - 3, 5, 3), np.int16)),
        ("deltas", np.zeros((0, STATE - 3, 6, 3), np.int16)),
        ("delta_scales", np.full((1, STATE - 3), np.nan, np.float32)),
        ("rigs", np.array([0, 1], np.int32)),
        ("rigs", np.array([-1, 0], np.int32)),
        ("rest_weights", np.ones((2, 6), np.float32)),
    ],
)
def test_arrays_that_do_not_fit_are_refused(folder: Path, name: str, value: np.ndarray | None) -> None:
    with np.load(folder / ARRAYS) as stored:
        arrays = {**stored, name: value}
    np.savez_compressed(folder / ARRAYS, **{key: array for key, array in arrays.items() if array is not None})
    fit_sizes(folder)
    with pytest.raises(FaceDiffError, match=f"arrays.npz: .*({name}|delta)"):
        RuntimeModel.open(folder)


def test_a_copy_holds_the_files_of_the_model_and_nothing_that_its_description_names_besides(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "place").mkdir()
    (tmp_path / "deep").mkdir()
    (tmp_path / "secret").write_text("secret")
    folder = folder.rename(tmp_path / "deep" / "channels")
    path = folder / DESCRIPTION
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "sizes": {**content["sizes"], "../../secret": 6}}))
    copied = copy_exported(folder, tmp_path / "place" / "copy")
    assert {path.name for path in (tmp_path / "place" / "copy").iterdir()} == {DESCRIPTION, *content["sizes"]}
    assert [path.name for path in (tmp_path / "place").iterdir()] == ["copy"]
    assert copied == path.stat().st_size + sum(content["sizes"].values())
    RuntimeModel.open(tmp_path / "place" / "copy")
