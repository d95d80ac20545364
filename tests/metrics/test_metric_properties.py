"""Laws that hold for any motion: scaling, symmetry, and the traps of signs and pooling."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.metrics import face_dynamics_deviation, lip_vertex_error, mean_vertex_error

seeds = st.integers(0, 2**31)
frames = st.integers(1, 9)
scales = st.floats(0.01, 100.0)
few = settings(max_examples=25, deadline=None)


def pair(seed: int, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    first, second = torch.randn(2, length, 6, 3, dtype=torch.float64, generator=torch.manual_seed(seed)).unbind(0)
    return first, second


@few
@given(seeds, frames, scales)
def test_scaling_laws(seed: int, length: int, scale: float) -> None:
    p, g = pair(seed, length)
    torch.testing.assert_close(
        mean_vertex_error(scale * p, scale * g), scale * mean_vertex_error(p, g), rtol=1e-9, atol=1e-12
    )
    for squared, power in ((True, 2), (False, 1)):
        found = lip_vertex_error(scale * p, scale * g, [0, 2], squared=squared)
        torch.testing.assert_close(
            found, scale**power * lip_vertex_error(p, g, [0, 2], squared=squared), rtol=1e-9, atol=1e-12
        )
    found = face_dynamics_deviation(scale * p, scale * g, [0, 2], sign="signed")
    expected = scale**2 * face_dynamics_deviation(p, g, [0, 2], sign="signed")
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * scale**2)


@few
@given(seeds, frames)
def test_zero_on_equal_inputs(seed: int, length: int) -> None:
    p, _ = pair(seed, length)
    assert mean_vertex_error(p, p) == 0
    assert lip_vertex_error(p, p, [0, 1]) == 0
    assert face_dynamics_deviation(p, p, [0, 1], template=p[0]) == 0


@few
@given(seeds, frames)
def test_swapping_the_roles(seed: int, length: int) -> None:
    p, g = pair(seed, length)
    assert mean_vertex_error(p, g) == mean_vertex_error(g, p)
    assert lip_vertex_error(p, g, [0, 1]) == lip_vertex_error(g, p, [0, 1])
    signed = [face_dynamics_deviation(*roles, [0, 1], sign="signed") for roles in ((p, g), (g, p))]
    assert signed[0] == -signed[1]
    assert face_dynamics_deviation(p, g, [0, 1]) == signed[0].abs()


@few
@given(seeds, frames)
def test_order_of_vertices_and_frames_does_not_matter(seed: int, length: int) -> None:
    p, g = pair(seed, length)
    vertices = torch.randperm(6, generator=torch.manual_seed(seed))
    time = torch.randperm(length, generator=torch.manual_seed(seed))
    moved = [motion[time][:, vertices] for motion in (p, g)]
    region = [int((vertices == index).nonzero()) for index in (0, 4)]
    torch.testing.assert_close(mean_vertex_error(moved[0], moved[1]), mean_vertex_error(p, g))
    torch.testing.assert_close(lip_vertex_error(moved[0], moved[1], region), lip_vertex_error(p, g, [0, 4]))
    torch.testing.assert_close(
        face_dynamics_deviation(moved[0], moved[1], region),
        face_dynamics_deviation(p, g, [0, 4]),
        rtol=1e-9,
        atol=1e-12,
    )


@few
@given(seeds, frames)
def test_triangle_inequality_of_unsquared_errors(seed: int, length: int) -> None:
    (a, b), (c, _) = pair(seed, length), pair(seed + 1, length)
    assert mean_vertex_error(a, c) <= mean_vertex_error(a, b) + mean_vertex_error(b, c) + 1e-12
    direct = lip_vertex_error(a, c, [1, 2], squared=False)
    detour = lip_vertex_error(a, b, [1, 2], squared=False) + lip_vertex_error(b, c, [1, 2], squared=False)
    assert direct <= detour + 1e-12


def test_signed_deviations_cancel_and_absolute_ones_do_not() -> None:
    lively, still = pair(0, 8)[0], torch.zeros(8, 6, 3, dtype=torch.float64)
    truth, prediction = torch.stack([lively, still]), torch.stack([still, lively])
    assert face_dynamics_deviation(prediction, truth, [0], sign="signed") == 0
    assert face_dynamics_deviation(prediction, truth, [0], sign="absolute") > 0


def test_pooling_by_frames_and_by_sequences_differ() -> None:
    truth = torch.zeros(2, 3, 1, 3)
    prediction = torch.zeros(2, 3, 1, 3)
    prediction[1, ..., 0] = 4.0  # one frame of error 4 beside three frames of error 0
    by_frames = mean_vertex_error(prediction, truth, lengths=[3, 1])
    by_sequences = mean_vertex_error(prediction, truth, lengths=[3, 1], pooling="sequences")
    assert [by_frames.item(), by_sequences.item()] == pytest.approx([1.0, 2.0])
