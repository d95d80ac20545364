"""DiffPoseTalk against its formulas, on a tiny checkpoint in its authors' layout."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from facediff.data import Reference
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, import_checkpoint
from facediff.models.graphs import update_table
from facediff.models.inference import Style
from facediff.models.published.clip_style import ClipStyleEncoder, style_contrast
from facediff.models.published.diffposetalk import DiffPoseTalk, fitted
from facediff.models.published.diffposetalk_network import CosineProcess
from facediff.models.published.diffusion import PosteriorSampler
from tests.fakes import published_parameters as author
from tests.fakes.published import AUDIO_CONFIG


def imported(folder: Path, *, head: bool = True) -> DiffPoseTalk:
    shape = 0.5 * torch.randn(author.SHAPE, generator=torch.Generator().manual_seed(3))
    model: AnimationModel = import_checkpoint(
        author.write_diffposetalk(folder, head=head),
        audio_config=AUDIO_CONFIG,
        statistics=author.statistics(),
        templates={"A": shape},
    )
    assert isinstance(model, DiffPoseTalk)
    return model


class Noise:
    """The same random numbers in the same order, whoever draws them."""

    def __init__(self) -> None:
        self.stream = torch.Generator().manual_seed(11)

    def __call__(self, like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=self.stream)


def speech(frames: float) -> Tensor:
    stream = torch.Generator().manual_seed(2)
    return 0.1 * torch.randn(int(frames * 640), generator=stream) + 0.02


@pytest.mark.parametrize(
    ("options", "changes"),
    [
        ({}, {}),
        ({"guiding": ("audio",), "scales": {"audio": 1.15}}, {"conditions": ("audio",)}),
        ({"guiding": ()}, {"conditions": ()}),
        ({"guidance": "independent"}, {"independent": True}),
        ({"speech_context": False}, {"context": False}),
        ({"threshold": (0.9, 0.1, 4.0)}, {"threshold": (0.9, 0.1, 4.0)}),
    ],
)
def test_sampling_equals_the_formulas(options: dict[str, Any], changes: dict[str, Any], tmp_path: Path) -> None:
    model, style = imported(tmp_path), torch.randn(author.STYLE, generator=torch.Generator().manual_seed(4))
    for name, value in options.items():
        setattr(model, name, value)
    state, _ = author.diffposetalk_states(head=True)
    audio = speech(33.4)  # two windows, the second filled up
    given = None if options.get("guiding") == ("audio",) else style
    with torch.no_grad():
        motion = model.sample(audio, model.shapes[:1], None if given is None else given[None], Noise())
        expected = author.diffposetalk_reference(state, audio, model.shapes[0], given, Noise(), **changes)
    assert motion.shape == expected.shape == (33, 54)
    torch.testing.assert_close(motion, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("head", [True, False])
def test_coefficients_get_back_what_the_network_does_not_see(head: bool, tmp_path: Path) -> None:
    model, figures = imported(tmp_path, head=head), author.statistics()
    channels = 54 if head else 51
    standard = torch.randn(7, channels)
    whole = model.absolute(standard)[..., 0].numpy()
    np.testing.assert_allclose(
        whole[:, :50], standard[:, :50].numpy() * figures["exp_std"] + figures["exp_mean"], rtol=1e-5, atol=1e-6
    )
    pose = np.concatenate([standard[:, 50:].numpy() if head else np.zeros((7, 4)), np.zeros((7, 2))], 1)
    if not head:
        pose[:, 3] = standard[:, 50].numpy()
    pose = pose * figures["pose_std"] + figures["pose_mean"]
    if not head:
        pose[:, :3] = 0.0
    np.testing.assert_allclose(whole[:, 50:], pose, rtol=1e-5, atol=1e-6)
    if head:
        torch.testing.assert_close(
            model.standardised(model.absolute(standard)[None])[0], standard, rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("head", [True, False])
def test_style_equals_the_formula_and_ignores_order(head: bool, tmp_path: Path) -> None:
    model = imported(tmp_path, head=head)
    _, state = author.diffposetalk_states(head)
    motion = torch.randn(1, 30, 56, 1, generator=torch.Generator().manual_seed(9))
    with torch.no_grad():
        style = model.encode_style(motion, torch.ones(1, 30, dtype=torch.bool))
        # As many frames as a window has.
        expected = author.style_reference(state, model.standardised(motion[:, : author.WINDOW])[0], "")
        turned = model.encode_style(motion[:, : author.WINDOW].flip(1), torch.ones(1, author.WINDOW, dtype=torch.bool))
    torch.testing.assert_close(style[0], expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(turned, style, rtol=1e-4, atol=1e-5)


def test_animation_is_parameters_of_flame(tmp_path: Path) -> None:
    model = imported(tmp_path)
    wave = speech(45)
    clip = Reference("clip", torch.randn(30, 56, 1))
    by_clip = model.animate(wave, identity="A", style=clip, seed=3).vertices
    again = model.animate(wave, identity="A", style=clip, seed=3).vertices
    plain = model.animate(wave, identity="A", seed=3).vertices  # no reference is stored: no style
    with torch.no_grad():
        vector = model.encode_style(clip.motion[None], torch.ones(1, 30, dtype=torch.bool))[0]
    by_vector = model.animate(wave, identity="A", style=Style("v", vector), seed=3).vertices
    assert by_clip.shape == (45, 56, 1)
    assert not model.has_sampler("dpm_solver")
    assert torch.equal(by_clip, again)
    torch.testing.assert_close(by_vector, by_clip, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(plain, by_clip)


@pytest.mark.parametrize(
    ("guiding", "guidance", "speech", "style", "neither"),
    [
        (("audio", "style"), "incremental", 0.1, 0.45, 0.1),
        (("audio", "style"), "independent", 0.5, 0.5, 0.25),
        (("audio",), "incremental", 0.1, 0.0, 0.0),
        (("style",), "independent", 0.0, 0.1, 0.0),
        ((), "incremental", 0.0, 0.0, 0.0),
    ],
)
def test_training_drops_what_guidance_does_without(
    guiding: tuple[str, ...], guidance: str, speech: float, style: float, neither: float, tmp_path: Path
) -> None:
    model = imported(tmp_path)
    model.guiding, model.guidance = guiding, guidance  # type: ignore[assignment]
    unheard, unknown = model.dropped(40_000, torch.Generator().manual_seed(0))
    shares = [float(rows.float().mean()) for rows in (unheard, unknown, unheard & unknown)]
    assert shares == pytest.approx([speech, style, neither], abs=0.01)


def test_process_is_the_clipped_cosine_schedule() -> None:
    process, expected = CosineProcess(500), author.schedule(500)
    np.testing.assert_allclose(process.variances, expected["betas"][1:], rtol=2e-4, atol=2e-6)
    np.testing.assert_allclose(process.signal, expected["alpha_bars"][1:], rtol=2e-4, atol=2e-6)
    table = update_table(PosteriorSampler(process))
    deviations = [row[4] for row in table[:-1]]
    np.testing.assert_allclose(deviations, expected["sigmas_inflex"][:1:-1], rtol=2e-3, atol=2e-6)


def test_shapes_are_standardised_by_the_files_statistics(tmp_path: Path) -> None:
    shape, figures = torch.randn(author.SHAPE, generator=torch.Generator().manual_seed(3)), author.statistics()
    figures["shape_std"] = np.linspace(0.5, 3.0, author.SHAPE)
    files = author.write_diffposetalk(tmp_path, head=True)
    model = import_checkpoint(files, audio_config=AUDIO_CONFIG, statistics=figures, templates={"A": shape})
    expected = (shape.numpy() - figures["shape_mean"]) / figures["shape_std"]
    np.testing.assert_allclose(model.shapes[0], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("key", ["exp_std", "pose_std", "shape_std"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_deviations_that_move_nothing_are_refused(key: str, value: float, tmp_path: Path) -> None:
    figures = author.statistics()
    figures[key][1] = value
    with pytest.raises(FaceDiffError, match="deviations of .* hold"):
        import_checkpoint(author.write_diffposetalk(tmp_path, head=True), audio_config=AUDIO_CONFIG, statistics=figures)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"fps": 30}, ""), *(({"fps": rate}, "fps") for rate in (0, np.nan, 1e9)), ({"rot_repr": "6d"}, "rot_repr")],
)
def test_rate_and_rotations_are_the_files(changes: dict[str, Any], problem: str, tmp_path: Path) -> None:
    files = author.write_diffposetalk(tmp_path, head=True, **changes)
    with pytest.raises(FaceDiffError, match=problem) if problem else nullcontext():
        model = import_checkpoint(files, audio_config=AUDIO_CONFIG, statistics=author.statistics())
        assert model.frame_rate == 30
        assert len(model.animate(torch.zeros(16_000), identity="speaker").vertices) == 30


def test_one_sample_is_silence() -> None:
    assert DiffPoseTalk.standard_speech(torch.tensor([0.5])).tolist() == [0.0]


@pytest.mark.parametrize(
    ("samples", "padded"),
    [(64_000, 64_080), (641, 721), (719, 721), (900, 900), (300, 400), (80, 400), (2, 400)],
)
def test_speech_is_filled_up_to_whole_steps(samples: int, padded: int) -> None:
    wave = torch.arange(samples, dtype=torch.float32)
    result = fitted(wave)
    side = (padded - samples) // 2
    assert len(result) == padded
    assert torch.equal(result[side : side + samples], wave)


def test_style_contrast_is_a_cross_entropy_over_all_others() -> None:
    first, second = torch.randn(3, 5), torch.randn(3, 5)
    rows = torch.cat([first, second])
    rows = rows / rows.norm(dim=1, keepdim=True)
    total = 0.0
    for i in range(6):
        scores = [float(rows[i] @ rows[j]) / 0.1 for j in range(6)]
        others = np.log(sum(np.exp(scores[j]) for j in range(6) if j != i))
        total += others - scores[(i + 3) % 6]
    assert float(style_contrast(first, second)) == pytest.approx(total / 6, rel=1e-5)


def test_style_of_a_padded_clip_is_its_own() -> None:
    encoder = ClipStyleEncoder(6, 8, num_layers=1, num_heads=2, feed_forward_dim=16).eval()
    clip = torch.randn(1, 9, 6)
    mask = torch.arange(14)[None] < 9
    with torch.no_grad():
        alone, padded = encoder(clip), encoder(torch.nn.functional.pad(clip, (0, 0, 0, 5), value=3.0), mask)
    torch.testing.assert_close(padded, alone, rtol=1e-5, atol=1e-6)
