"""ARTalk against its formulas, on a tiny checkpoint in its authors' layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import savgol_coeffs
from torch import Tensor

from facediff.data import Reference, Sample, collate
from facediff.mesh.flame import Flame
from facediff.models import import_checkpoint
from facediff.models.published.artalk import ARTalk, smoothed
from facediff.models.published.artalk_codec import BitCodec
from facediff.pipelines.animator import Animator
from facediff.spaces import layout
from facediff.spaces.rigs import decode_flame
from tests.fakes import published_parameters as author
from tests.fakes.flame import write_flame
from tests.fakes.published import AUDIO_CONFIG


@pytest.fixture(scope="module")
def state() -> dict[str, Tensor]:
    return author.artalk_state()


@pytest.fixture(scope="module")
def model(state: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> ARTalk:
    path = tmp_path_factory.mktemp("artalk") / "ARTalk_wav2vec.pt"
    torch.save(state, path)
    options: dict[str, Any] = {"codec_heads": 2, "audio_config": AUDIO_CONFIG}
    imported = import_checkpoint(path, **options)
    assert isinstance(imported, ARTalk)
    return imported


def speech(frames: float) -> Tensor:
    return 0.1 * torch.randn(int(frames * 640), generator=torch.Generator().manual_seed(2)) + 0.02


def style_clip() -> Tensor:
    return torch.randn(50, 106, generator=torch.Generator().manual_seed(6))


def token(model: ARTalk, motion: Tensor | None) -> Tensor:
    if motion is None:
        return model.generator.no_style
    vector = model.encode_style(motion[None, :, :, None], torch.ones(1, len(motion), dtype=torch.bool))
    return model.generator.style_in(vector)[:, None] * 1.1 - model.generator.no_style * (1.1 - 1.0)


@pytest.mark.parametrize(("frames", "styled"), [(23.2, True), (23.2, False), (10, True), (4.5, False)])
def test_generation_equals_the_formulas(frames: float, styled: bool, model: ARTalk, state: dict[str, Tensor]) -> None:
    motion, audio = style_clip() if styled else None, speech(frames)
    with torch.no_grad():
        result, scores = model.animate_wave(audio, token(model, motion))
        expected, expected_scores = author.artalk_reference(state, audio, motion)
    torch.testing.assert_close(scores, expected_scores, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)


def test_animation_is_smoothed_and_its_jaw_only_opens(model: ARTalk) -> None:
    audio, clip = speech(23), Reference("clip", style_clip()[..., None])
    finished = model.animate(audio, identity="0", style=clip).vertices[..., 0]
    with torch.no_grad():
        raw, _ = model.animate_wave(audio, token(model, clip.motion[..., 0]))
    assert finished.shape == (23, 106)
    assert not finished[:, 104:].any()
    inner = raw.numpy()
    five, nine = savgol_coeffs(5, 2), savgol_coeffs(9, 3)
    np.testing.assert_allclose(finished[8, 7], inner[6:11, 7] @ five[::-1], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(finished[8, 101], inner[4:13, 101] @ nine[::-1], rtol=1e-3, atol=1e-5)
    assert np.array_equal(smoothed(inner[:3], (100, 101, 102)), inner[:3])


def test_bits_give_back_what_they_stand_for() -> None:
    codec = BitCodec(6, (1, 2, 4), code_dim=4, dim=8, depth=1, num_heads=2)
    codes = torch.randn(2, 4, 4)
    total, bits, _ = codec.quantise(codes)
    torch.testing.assert_close(codec.sums(bits)[-1], total, rtol=1e-5, atol=1e-6)
    assert bits.shape == (2, 7, 4)
    assert codec.inputs_of_next(bits).shape == (2, 6, 4)


def test_chunk_before_does_not_see_the_next() -> None:
    codec = BitCodec(6, (1, 2, 4), code_dim=4, dim=8, depth=2, num_heads=2)
    motion = torch.randn(1, 8, 6)
    changed = torch.cat([motion[:, :4], motion[:, 4:] + 1.0], 1)
    with torch.no_grad():
        torch.testing.assert_close(codec.encode(motion)[:, :4], codec.encode(changed)[:, :4])
        torch.testing.assert_close(codec.encode(motion)[:, :4], codec.encode(motion[:, :4]), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("pieces", [[14_720], [100, 3000, 6400, 5220], [6400, 6400, 1920]])
def test_stream_equals_the_file_bit_for_bit(pieces: list[int], model: ARTalk) -> None:
    audio, clip = speech(23), Reference("clip", style_clip()[..., None])
    whole = model.animate(audio, identity="0", style=clip).vertices
    stream = model.stream(identity="0", style=clip)
    parts = [stream.feed(part) for part in audio.split(pieces)]
    assert sum(part.shape[1] for part in parts) == 16  # two chunks but for half of a filter
    parts.append(stream.finish())
    assert torch.equal(torch.cat(parts, 1)[0], whole)


def test_stream_has_the_frames_of_the_file_where_a_chunk_is_no_whole_samples(
    model: ARTalk, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = Reference("clip", style_clip()[..., None])
    cases = [(29.97, samples) for samples in (11_745, 11_800, 2 * 5338, 2 * 5338 + 1)]  # chunks of 5338
    for rate, samples in [*cases, (388.37, 43 * 411)]:  # of which 43 chunks last 429 frames
        monkeypatch.setattr(model, "frame_rate", rate)
        audio = speech(28)[:samples]
        whole, stream = model.animate(audio, identity="0", style=clip).vertices, model.stream(identity="0", style=clip)
        parts = [stream.feed(audio), stream.finish()]
        assert torch.equal(torch.cat(parts, 1)[0], whole)


def test_imported_with_flame_animates_to_parameters_and_vertices(state: dict[str, Tensor], tmp_path: Path) -> None:
    torch.save(state, tmp_path / "ARTalk_wav2vec.pt")
    flame = write_flame(tmp_path / "flame.npz", form="npz")
    options: dict[str, Any] = {"codec_heads": 2, "audio_config": AUDIO_CONFIG, "mesh": flame}
    imported = import_checkpoint(tmp_path / "ARTalk_wav2vec.pt", **options)
    audio = speech(12)
    raw = imported.animate(audio, identity="0").vertices[..., 0].numpy()
    finished = Animator(imported).animate(audio.numpy(), 16_000, identity="0", voice_gate="off")
    assert finished.values is not None
    assert finished.space == layout("flame_artalk")
    np.testing.assert_allclose(finished.values, raw, atol=1e-5)
    exact = decode_flame(Flame.read(flame), raw, layout("flame_artalk"))
    assert finished.vertices.shape == exact.shape
    assert any("MIT" in str(licence) for licence in imported.licences)


def test_before_the_first_frame_stands_the_face_at_rest(model: ARTalk) -> None:
    """A chunk that begins before its clip has a chunk before it sees motion that is zero, as generation does."""
    frames = model.scales[-1]
    sample = clip_of(model, frames + 1)
    seen: list[Tensor] = []
    hook = model.codec.encoder.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    model.losses(collate([sample]), torch.Generator().manual_seed(0))
    hook.remove()
    past = seen[0][0, :frames] - model.codec.encoder_positions[0, :frames]
    torch.testing.assert_close(past, (-model.codec.motion_mean / model.codec.motion_std).expand(frames, -1))


def clip_of(model: ARTalk, frames: int) -> Sample:
    """A training clip of motion that is never zero."""
    motion = 1.0 + torch.rand(frames, 106, 1, generator=torch.Generator().manual_seed(3))
    return Sample(
        audio=speech(frames),
        motion=motion,
        template=torch.zeros(106, 1),
        identity=0,
        reference=motion,
        name="clip",
        identity_name=model.identities[0],
        sentence="",
        reference_name="",
    )
