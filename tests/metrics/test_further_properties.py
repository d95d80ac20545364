"""Laws of metrics for any motion: scaling, symmetry, and the traps of signs and pooling."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from facediff.metrics import (
    bilabial_closure_rate,
    face_dynamics_deviation,
    frame_speech_lip_correlation,
    lip_opening_correlation,
    lip_speed_correlation,
    lip_vertex_error,
    lip_warping_distance,
    mean_vertex_error,
    mouth_opening_difference,
    temporal_misalignment,
    upper_face_vertex_error,
)
from facediff.metrics.by_name import OF_ALL_FRAMES
from tests.metrics.conftest import Corpus
from tests.metrics.further_cases import CASES, Case

seeds = st.integers(0, 2**31)
frames = st.integers(3, 15)
scales = st.floats(0.01, 100.0)
few = settings(max_examples=25, deadline=None)
PAIRS, LIPS = [(0, 1), (2, 5)], [0, 2, 3]
Score = Callable[[Tensor, Tensor], Tensor]
DISTANCES: dict[str, Score] = {
    "mve": mean_vertex_error,
    "lve": partial(lip_vertex_error, lips=LIPS, squared=False),
    "uve": partial(upper_face_vertex_error, upper=LIPS),
    "uve_max": partial(upper_face_vertex_error, upper=LIPS, reduction="max"),
    "mod": partial(mouth_opening_difference, pairs=PAIRS),
    "dtw": partial(lip_warping_distance, lips=LIPS),
}
FOLLOWING: dict[str, Score] = {
    "opening": partial(lip_opening_correlation, pairs=PAIRS),
    "speed": partial(lip_speed_correlation, lips=LIPS),
}


def motions(seed: int, length: int, count: int = 2) -> list[Tensor]:
    generator = torch.manual_seed(seed)
    return list(torch.randn(count, length, 6, 3, dtype=torch.float64, generator=generator))


@pytest.mark.parametrize("name", DISTANCES)
@few
@given(seed=seeds, length=frames, scale=scales)
def test_distances_are_zero_on_equals_symmetric_and_scale(name: str, seed: int, length: int, scale: float) -> None:
    score = DISTANCES[name]
    p, g = motions(seed, length)
    value = score(p, g)
    assert score(g, g) == 0 < value
    torch.testing.assert_close(score(scale * p, scale * g), scale * value, rtol=1e-9, atol=1e-12)
    if name == "dtw":  # the path of least sum is the same, only ties are broken for one side
        torch.testing.assert_close(score(g, p), value, rtol=1e-9, atol=0)
    else:
        assert score(g, p) == value
    shift = torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(score(p + shift, g + shift), value, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in DISTANCES if name != "dtw"])
@few
@given(seed=seeds, length=frames)
def test_triangle_inequality(name: str, seed: int, length: int) -> None:
    score = DISTANCES[name]
    a, b, c = motions(seed, length, 3)
    assert score(a, c) <= score(a, b) + score(b, c) + 1e-12


@few
@given(seeds, frames)
def test_warping_never_costs_more_than_staying_in_time(seed: int, length: int) -> None:
    p, g = motions(seed, length)
    in_time = (p - g)[:, LIPS].square().sum(-1).mean(1).sqrt().mean()
    assert lip_warping_distance(p, g, LIPS) <= in_time + 1e-12
    assert lip_warping_distance(p.flip(0), g.flip(0), LIPS).item() == pytest.approx(
        lip_warping_distance(p, g, LIPS).item(), rel=1e-9
    )


@pytest.mark.parametrize("name", FOLLOWING)
@few
@given(seed=seeds, length=frames, scale=scales)
def test_correlations_see_neither_size_nor_role(name: str, seed: int, length: int, scale: float) -> None:
    score = FOLLOWING[name]
    p, g = motions(seed, length)
    value = score(p, g)
    assert -1 <= value <= 1
    torch.testing.assert_close(score(scale * p, g), value, rtol=0, atol=1e-9)
    torch.testing.assert_close(score(g, p), value, rtol=0, atol=1e-12)
    torch.testing.assert_close(score(scale * g, g), torch.ones_like(value), rtol=0, atol=1e-12)


@few
@given(seeds, frames, scales)
def test_speech_correlation_sees_neither_loudness_nor_size(seed: int, length: int, scale: float) -> None:
    p, g = motions(seed, length)
    loud = torch.rand(length, dtype=torch.float64, generator=torch.manual_seed(seed)) + 0.1
    follow = partial(frame_speech_lip_correlation, lips=LIPS)
    value = follow(p, g, intensity=loud)
    torch.testing.assert_close(follow(scale * p, g, intensity=scale * loud), value, rtol=0, atol=1e-9)
    assert follow(g, g, intensity=loud, of="gap") == 0
    difference = value - follow(p, g, intensity=loud, of="truth")
    torch.testing.assert_close(follow(p, g, intensity=loud, of="gap"), difference, rtol=0, atol=1e-12)


@few
@given(seeds, frames, st.floats(0, 1), st.floats(0, 1))
def test_closure_rates_grow_with_the_threshold(seed: int, length: int, one: float, other: float) -> None:
    p, g = motions(seed, length)
    low, high = sorted((one, other))
    everywhere = [(0, length)]
    rates = [bilabial_closure_rate(p, g, PAIRS, everywhere, threshold=share) for share in (low, high)]
    assert rates[0] <= rates[1]
    assert bilabial_closure_rate(p, g, PAIRS, everywhere, threshold=1.0, of="truth") == 1
    assert bilabial_closure_rate(g, g, PAIRS, everywhere, of="gap") == 0
    assert bilabial_closure_rate(4 * p, 4 * g, PAIRS, everywhere, threshold=low) == rates[0]


@few
@given(seeds, st.integers(8, 30), st.sampled_from(["extrema", "path"]))
def test_misalignment_is_none_with_itself_and_sees_no_size(seed: int, length: int, at: str) -> None:
    p, g = motions(seed, length)
    lag = partial(temporal_misalignment, pairs=PAIRS, smoothing=0.0, at=at)
    try:
        value = lag(p, g)
    except ValueError:
        assert at == "extrema"  # noise may have no extrema that are paired
    else:
        assert lag(4 * p, 4 * g) == value
        assert 0 <= value < length
    assert lag(g, g) == 0


@few
@given(seeds, frames, scales)
def test_dynamics_have_a_sign_and_scale_by_squares(seed: int, length: int, scale: float) -> None:
    p, g = motions(seed, length)
    assert face_dynamics_deviation(p, p, [0, 1], template=p[0]) == 0
    signed = [face_dynamics_deviation(*roles, [0, 1], sign="signed") for roles in ((p, g), (g, p))]
    assert signed[0] == -signed[1]
    assert face_dynamics_deviation(p, g, [0, 1]) == signed[0].abs()
    found = face_dynamics_deviation(scale * p, scale * g, [0, 1], sign="signed")
    torch.testing.assert_close(found, scale**2 * signed[0], rtol=1e-9, atol=1e-9 * scale**2)
    found = lip_vertex_error(scale * p, scale * g, LIPS)
    torch.testing.assert_close(found, scale**2 * lip_vertex_error(p, g, LIPS), rtol=1e-9, atol=1e-12)


@few
@given(seeds, frames)
def test_order_of_vertices_and_frames_does_not_matter(seed: int, length: int) -> None:
    p, g = motions(seed, length)
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


def test_signed_deviations_cancel_and_absolute_ones_do_not() -> None:
    lively, still = motions(0, 8)[0], torch.zeros(8, 6, 3, dtype=torch.float64)
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


@pytest.mark.parametrize(
    "case", {type(case.make()): case for case in CASES if "FramePair" not in case.name}.values(), ids=str
)
def test_metrics_that_depend_on_the_order_of_frames_say_so(case: Case, corpus: Corpus) -> None:
    """But for pairs of frames that are drawn at random; those that read the time of speech are not asked."""
    scores = [case.make(), case.make()]
    taken = inspect.signature(scores[0].update).parameters.keys()
    if not {"prediction", "truth"} <= taken or OF_ALL_FRAMES & taken:
        return
    batch = case.arguments(corpus, range(len(corpus.truths)), 0)
    mixed = {name: batch[name].clone() for name in ("prediction", "truth", "partner") if name in batch}
    for place, truth in enumerate(corpus.truths):
        order = torch.randperm(len(truth), generator=torch.Generator().manual_seed(place))
        for motion in mixed.values():
            motion[place, : len(truth)] = motion[place, order]
    scores[0].update(**batch)
    scores[1].update(**batch | mixed)
    one, other = (score.compute().item() for score in scores)
    assert (one != pytest.approx(other, rel=1e-3)) == scores[0].in_order
