"""Windows that continue motion which is given out already, against a loop in NumPy and by what a stream promises."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.models.dual_path.model import DualPathDiffusion
from facediff.models.inference import SpeechStream, WindowNoise
from facediff.speech.voice_activity import QUICK_GATE, Openness, read_gate
from facediff.speech.windows import LOW_LATENCY, LOW_LATENCY_AHEAD, LOW_LATENCY_STEPS, WindowPlan
from tests.fakes.tiny import Tiny
from tests.models.test_inference import CPU, Echo, clip, expected

PLANS = [
    WindowPlan(0.04, 0.0, before=0.2, after=0.12, above=0, past=0.4),  # a frame each, after ten frames of the past
    WindowPlan(0.16, 0.08, before=0.2, after=0.04, above=0, past=0.4),
    WindowPlan(0.2, 0.16, before=0.0, after=0.0, above=0, past=0.12),  # shares more than it hops
    WindowPlan(0.12, 0.0, before=0.6, after=0.08, above=0, past=0.04),
]


@pytest.mark.parametrize("plan", PLANS)
@pytest.mark.parametrize("frames", [1, 2, 5, 11, 37])
def test_windows_with_a_past_are_the_loop_over_windows(plan: WindowPlan, frames: int) -> None:
    speech = 0.2 * np.random.default_rng(frames).standard_normal(frames * 640)
    stream, place, parts = SpeechStream(Echo(), clip(), plan=plan), 0, []
    for size in (100, 3_000, 641, 10**6):
        parts.append(stream.feed(torch.from_numpy(speech[place : place + size]).float()))
        place += size
    made = torch.cat([*parts, stream.finish()], 1)[0, :, 0, 0].numpy()
    np.testing.assert_allclose(made, expected(speech, frames, plan.in_frames(25.0)), rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("plan", [*PLANS, LOW_LATENCY, LOW_LATENCY_AHEAD])
def test_windows_with_a_past_share_its_noise(plan: WindowPlan) -> None:
    whole: dict[int, torch.Tensor] = {}
    for index in range(40):
        window = plan.in_frames(25.0).window(index)
        noise = WindowNoise("a", window, [5], CPU)(torch.empty(1, window.frames, 32))[0]
        assert len(noise) == window.frames + window.plan.ahead
        for place, row in enumerate(noise, window.start):
            assert torch.equal(whole.setdefault(place, row), row)
    every = torch.stack([whole[place] for place in sorted(whole)]).double()
    assert float((every @ every.T / 32 - torch.eye(len(every))).abs().max()) < 6.5 * (2 / 32) ** 0.5


@pytest.mark.parametrize("plan", [*PLANS, LOW_LATENCY, LOW_LATENCY_AHEAD, WindowPlan()])
def test_speech_ahead_stays_as_it_is_heard_last(plan: WindowPlan) -> None:
    frames = plan.in_frames(25.0)
    for index in range(40):
        window = frames.window(index)
        places = window.start - window.context + window.encoded  # in the recording
        heard = min(window.end + frames.after, window.end + frames.ahead)
        assert places[: heard - window.start].tolist() == [*range(window.start, heard)]
        assert places[heard - window.start :].tolist() == [heard - 1] * (window.end + frames.ahead - heard)


@pytest.fixture(params=["frames by themselves", "prior over time"])
def model(ready: Callable[..., DualPathDiffusion], tiny: Tiny, request: pytest.FixtureRequest) -> DualPathDiffusion:
    if request.param == "frames by themselves":
        return ready()
    made = ready(motion_space=partial(registry.motion_space.components, count=6, prior_frames=7))
    made.measure(tiny)
    torch.nn.init.normal_(made.network.unembed.weight)
    return made


@pytest.mark.slow
def test_frames_that_are_given_out_do_not_change(model: DualPathDiffusion) -> None:
    """Each window sees the motion that was given out, and goes on from it."""
    model.choose_low_latency()
    decode, given, looked = model.decode, [], 0

    def spied(space, sample, wanted):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
        nonlocal looked
        whole, first = decode(space, sample, slice(None)), wanted.start
        for place in range(first):
            torch.testing.assert_close(whole[0, place], given[place - first], rtol=1e-4, atol=1e-5)
            looked += 1
        given.append(whole[0, first])
        return whole[:, wanted]

    model.decode = spied  # type: ignore[method-assign]
    speech = torch.randn(2 * 16_000, generator=torch.Generator().manual_seed(0)) * 0.2
    made = model.animate(speech, identity=model.identities[0]).vertices
    assert len(given) == len(made) == 50
    assert looked == sum(min(12, index) for index in range(50))


def test_a_low_latency_stream_is_the_file_and_keeps_its_promise(model: DualPathDiffusion) -> None:
    model.choose_low_latency()
    speech = torch.randn(24_000, generator=torch.Generator().manual_seed(1)) * 0.2
    with torch.inference_mode():
        stream = model.stream(identity=model.identities[0])
        parts, heard = [], 0
        for piece in speech.split(160):
            parts.append(stream.feed(piece))
            heard += len(piece)
            # At most 0.12 s of speech lie between the start of a frame and the sample that makes it certain.
            assert stream.frames >= (heard / 16_000 - 0.12) * 25 - 1e-9
        parts.append(stream.finish())
    template = model.assets.template(model.identities[0])
    wanted = model.animate(speech, identity=model.identities[0]).vertices - template
    torch.testing.assert_close(torch.cat(parts, 1)[0], wanted, rtol=1e-4, atol=1e-6)


def test_low_latency_takes_few_steps_and_is_forgotten(model: DualPathDiffusion) -> None:
    before = model.windows, model.sampler.steps
    with model.choosing():
        model.choose_low_latency()
        assert (model.windows, model.sampler.steps) == (LOW_LATENCY_AHEAD, LOW_LATENCY_STEPS)
    assert (model.windows, model.sampler.steps) == before
    with model.choosing():
        model.choose_sampler(steps=1)  # as many as the model has learnt to need
        model.choose_low_latency()
        assert model.sampler.steps == 1
    model.low_latency_steps = 1
    sampling = model.graphs().sampling
    assert sampling is not None
    assert (len(sampling.quick_steps), len(sampling.quick_table), len(sampling.steps)) == (1, 1, before[1])
    assert (model.windows, model.sampler.steps) == before


@pytest.mark.parametrize("rate", [12.0, 15.0, 24.0, 25.0, 29.97, 30.0, 48.0, 60.0, 120.0])
def test_low_latency_waits_less_than_the_goal_at_every_rate(rate: float) -> None:
    plan = LOW_LATENCY.in_frames(rate)
    waited = plan.look_ahead / rate
    assert plan.overlap == 0
    assert plan.look_ahead == plan.frames + plan.after
    assert 0.08 < waited < (0.13 if rate >= 24 else 0.17)
    gate = read_gate(QUICK_GATE)
    assert gate is not None
    # A frame's middle lies half a frame after its start: the gate must be certain of it by then.
    assert Openness(gate, rate).look_ahead <= waited - 0.5 / rate
