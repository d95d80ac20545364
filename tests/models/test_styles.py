"""The words of --style: one style, mixtures, motions of people whom the checkpoint does not know."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from facediff.animation import Animation, write_archive
from facediff.animation.styles import Weighted, marked, split_styles, stillness_of, style_paths
from facediff.data import Reference
from facediff.errors import FaceDiffError
from facediff.models import DiffPoseTalk, DualPathDiffusion, Style, import_checkpoint
from facediff.models.styles import extract_style, style_from
from facediff.spaces.files import ParameterClip
from facediff.spaces.layouts import layout
from tests.fakes import published_parameters
from tests.fakes.published import AUDIO_CONFIG
from tests.fakes.tiny import Tiny


@pytest.fixture
def model(tiny: Tiny, make_model: Callable[..., DualPathDiffusion]) -> DualPathDiffusion:
    tiny.setup("fit")
    made = make_model()
    made.adopt(tiny.assets().with_motion_scale(50.0))
    return made.eval()


def vector(style: Reference | Style, model: DualPathDiffusion) -> np.ndarray:
    if isinstance(style, Style):
        return style.vector.numpy()
    motion = style.motion.float()[None]
    with torch.inference_mode():
        return model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool))[0].numpy()


def test_a_face_without_a_skull_is_known_by_its_stillest_vertices() -> None:
    """Faces from videos tremble everywhere; another person's neutral face is farther away than that."""
    random = np.random.default_rng(0)
    motions = random.normal(0, 0.3, (3, 40, 50, 3)).astype(np.float32)
    motions[:, :, :10] += 2 * np.sin(np.arange(40) / 3)[None, :, None, None]
    stillness = stillness_of([motions[0]])
    assert stillness is not None
    assert not any(stillness.another_face(motion) for motion in motions)
    assert stillness.another_face(motions[1] + random.normal(0, 1.2, (50, 3)).astype(np.float32))


def test_a_vector_of_another_model_is_refused(
    model: DualPathDiffusion, make_model: Callable[..., DualPathDiffusion], tmp_path: Path
) -> None:
    """By what its style encoder gives for a still face; a vector alone is taken as it is."""
    other = make_model()
    other.adopt(model.assets)
    torch.manual_seed(5)
    for weight in other.network.style_encoder.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    plain, path = vector(model.assets.references["A"], model), tmp_path / "a.npy"
    still = vector(Reference("still", torch.zeros(3, model.n_vertices, 3)), model)
    for written in (plain, marked(plain, still)):
        np.save(path, written)
        style = style_from(str(path), "B", model)
        assert isinstance(style, Style)
        np.testing.assert_array_equal(style.vector, plain)
    with pytest.raises(FaceDiffError, match=r"a\.npy: is of another model.*style extract"):
        style_from(str(path), "B", other.eval())
    np.save(path, plain)
    assert isinstance(style_from(str(path), "B", other), Style)
    shorter = len(plain) // 2
    for written in (plain[:shorter], marked(plain[:shorter], still[:shorter])):
        np.save(path, written)
        with pytest.raises(FaceDiffError, match=rf"holds {shorter} numbers.*have {len(plain)} "):
            style_from(str(path), "B", model)
    np.save(path, np.append(plain[1:], np.inf))
    with pytest.raises(FaceDiffError, match="no NaN"):
        style_from(str(path), "B", model)


def test_what_is_a_file_or_a_clip_as_a_whole_is_one_style(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one, two.npy").touch()
    assert split_styles("one, two.npy") == [Weighted("one, two.npy", None)]
    assert split_styles("A:7", ["A:7"]) == [Weighted("A:7", None)]
    assert split_styles("A:7") == [Weighted("A", 7.0)]
    assert style_paths("one, two.npy") == [Path("one, two.npy")]
    assert style_paths("F1_e03:0.5,none.npy:0.5") == []
    assert style_paths(None) == []


def test_a_mixture_is_the_weighted_mean_of_style_vectors(
    model: DualPathDiffusion, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clips = {name: reference.clip for name, reference in model.assets.references.items()}
    a, b = (vector(model.assets.references[name], model) for name in ("A", "B"))
    own = np.linspace(-1, 1, len(a), dtype=np.float32)
    np.save(tmp_path / "own.npy", own)

    mixed = style_from(f"{clips['A']}:0.25,{clips['B']}:0.5,{tmp_path / 'own.npy'}:0.25", "A", model)
    assert isinstance(mixed, Style)
    np.testing.assert_allclose(mixed.vector, 0.25 * a + 0.5 * b + 0.25 * own, atol=1e-5)
    assert mixed.name == f"0.25 {clips['A']} + 0.5 {clips['B']} + 0.25 own"
    assert not capsys.readouterr().out
    beyond = style_from(f"{clips['A']}:3,{clips['B']}:-1", "A", model)
    np.testing.assert_allclose(vector(beyond, model), 1.5 * a - 0.5 * b, atol=1e-5)
    assert capsys.readouterr().out == "note: --style: weights are divided by their sum: 1.5, -0.5\n"
    alike = style_from(f"{clips['A']},{clips['B']}", "A", model)
    np.testing.assert_allclose(vector(alike, model), (a + b) / 2, atol=1e-5)
    speech = torch.randn(16_000, generator=torch.Generator().manual_seed(0)) * 0.1
    assert torch.isfinite(model.animate(speech, identity="A", style=beyond).vertices).all()


@pytest.fixture
def unseen(model: DualPathDiffusion, tmp_path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """B's motion on a face that nobody knows: file, template, offsets."""
    offsets = model.assets.references["B"].motion.float().numpy()
    face = np.asarray(model.assets.templates["B"]) * [1.2, 0.9, 1.0] + [0.3, -0.2, 0.1]
    np.save(tmp_path / "zoe.npy", (face + offsets).astype(np.float32))
    return tmp_path / "zoe.npy", face, offsets


@pytest.mark.parametrize("suffix", ["npy", "ply", "obj"])
def test_an_unseen_speakers_style_needs_their_template(
    suffix: str, unseen: tuple[Path, np.ndarray, np.ndarray], model: DualPathDiffusion, tmp_path: Path
) -> None:
    path, face, offsets = unseen
    with pytest.raises(FaceDiffError, match="give that person's own with style_template"):
        style_from(str(path), "A", model)
    template = tmp_path / f"neutral.{suffix}"
    if suffix == "npy":
        np.save(template, face)
    else:
        trimesh.Trimesh(face, [[0, 1, 6], [22, 23, 17]], process=False).export(template)
    style = style_from(str(path), "A", model, template=template)
    assert isinstance(style, Reference)
    np.testing.assert_allclose(style.motion, offsets, atol=2e-6)
    other = model.assets.references["A"].clip
    mixed = style_from(f"{other}:0.5,{path}:0.5", "A", model, template=template)
    halves = 0.5 * vector(model.assets.references["A"], model) + 0.5 * vector(style, model)
    np.testing.assert_allclose(vector(mixed, model), halves, atol=1e-5)


def test_a_take_brings_its_template_unit_and_frame_rate(
    unseen: tuple[Path, np.ndarray, np.ndarray], model: DualPathDiffusion, tmp_path: Path
) -> None:
    _, face, offsets = unseen
    twice = np.repeat(face + offsets, 2, axis=0) * 1000
    animation = Animation("zoe", twice.astype(np.float32), (face * 1000).astype(np.float32), 50.0, unit="mm")
    write_archive(tmp_path / "zoe.npz", animation)
    style = style_from(str(tmp_path / "zoe.npz"), "A", model)
    assert isinstance(style, Reference)
    np.testing.assert_allclose(style.motion, offsets, atol=2e-6)
    write_archive(tmp_path / "slow.npz", replace(animation, frame_rate=30.0))
    with pytest.raises(FaceDiffError, match="has 30 frames a second, the model 25"):
        style_from(str(tmp_path / "slow.npz"), "A", model)
    moving = twice + 40.0 * np.sin(np.arange(len(twice)))[:, None, None]
    write_archive(tmp_path / "moving.npz", replace(animation, vertices=moving.astype(np.float32)))
    with pytest.raises(FaceDiffError, match="does not lie on its template: the head moves"):
        style_from(str(tmp_path / "moving.npz"), "A", model)


# Models of channels take motion in parameters.


@pytest.fixture(scope="module")
def of_channels(tmp_path_factory: pytest.TempPathFactory) -> DiffPoseTalk:
    folder = tmp_path_factory.mktemp("channels")
    model = import_checkpoint(
        published_parameters.write_diffposetalk(folder, head=True),
        audio_config=AUDIO_CONFIG,
        statistics=published_parameters.statistics(),
    )
    assert isinstance(model, DiffPoseTalk)
    return model


def values_of(columns: int, frames: int = 12) -> np.ndarray:
    return np.random.default_rng(columns).normal(size=(frames, columns)).astype(np.float32)


def test_motion_in_parameters_is_a_style_by_its_layout(of_channels: DiffPoseTalk, tmp_path: Path) -> None:
    values, person = values_of(56), of_channels.identities[0]
    np.savez(tmp_path / "clip.npz", exp=values[:, :50], pose=values[:, 50:], shape=np.zeros(100, np.float32))
    np.save(tmp_path / "clip.npy", values)
    for name in ("clip.npz", "clip.npy"):
        style = style_from(f"{tmp_path / name}@flame_diffposetalk", person, of_channels)
        assert isinstance(style, Reference)
        assert np.array_equal(style.motion[..., 0], values)
        with pytest.raises(FaceDiffError, match="flame_diffposetalk"):
            style_from(str(tmp_path / name), person, of_channels)
    with pytest.raises(FaceDiffError, match="no such file"):
        style_from("missing.npy@flame_artalk", person, of_channels)


def test_another_layouts_channels_are_taken_by_name(of_channels: DiffPoseTalk, tmp_path: Path) -> None:
    """ARTalk's clips have 100 expressions, of which the model knows 50, then head and jaw."""
    values = values_of(106)
    np.save(tmp_path / "natural.npy", values)
    expected = np.concatenate([values[:, :50], values[:, 100:]], 1)
    style = style_from(f"{tmp_path / 'natural.npy'}@flame_artalk", of_channels.identities[0], of_channels)
    assert isinstance(style, Reference)
    assert np.array_equal(style.motion[..., 0], expected)


def test_parameters_are_resampled_and_mixed_as_vectors(of_channels: DiffPoseTalk, tmp_path: Path) -> None:
    space, person = layout("flame_diffposetalk"), of_channels.identities[0]
    clip = ParameterClip("quick", np.repeat(values_of(56), 2, 0), space, 50.0)
    style = style_from(clip, person, of_channels)
    assert isinstance(style, Reference)
    assert np.allclose(style.motion[..., 0], values_of(56), atol=1e-6)
    np.save(tmp_path / "a.npy", values_of(56))
    np.save(tmp_path / "b.npy", 2 * values_of(56))
    words = [f"{tmp_path / name}@flame_diffposetalk" for name in ("a.npy", "b.npy")]
    mixed = style_from(f"{words[0]}:0.25,{words[1]}:0.75", person, of_channels)
    assert isinstance(mixed, Style)
    first, second = (extract_style([word], person, of_channels) for word in words)
    torch.testing.assert_close(mixed.vector, 0.25 * first + 0.75 * second)
