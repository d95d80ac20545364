"""Metrics of channels beyond the formulas in `further_cases`: k-means, moments of speaking, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.cluster.vq import vq

from facediff.metrics import (
    ChannelDynamicsDeviation,
    Context,
    FrechetDistance,
    Region,
    ShannonIndex,
    feed,
    lip_vertex_error,
    mean_vertex_error,
    parse,
    residual_partner_correlation,
    shannon_index,
    split_frames,
)
from facediff.metrics.channels import cluster_centres


def blobs(count: int, each: int) -> torch.Tensor:
    """Frames (count · each, 2, 1) around points that lie far apart."""
    random = torch.Generator().manual_seed(0)
    centres = 100 * torch.cartesian_prod(torch.arange(count, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    frames = centres.repeat_interleave(each, 0) + torch.randn(count * each, 2, generator=random, dtype=torch.float64)
    return frames[..., None]


def test_centres_are_a_fixed_point_of_lloyd_and_do_not_depend_on_the_order() -> None:
    frames = torch.randn(300, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    centres = cluster_centres(frames, 7, seed=0)
    labels, _ = vq(frames.numpy(), centres.numpy())
    means = np.stack([frames.numpy()[labels == k].mean(0) for k in range(7)])
    np.testing.assert_allclose(centres.numpy(), means, rtol=1e-10)
    assert torch.equal(cluster_centres(frames.flip(0), 7, seed=0), centres)
    assert not torch.equal(cluster_centres(frames, 7, seed=1), centres)
    assert len(cluster_centres(frames[:1].expand(9, 3), 4, seed=0)) == 1
    assert cluster_centres(torch.tensor([[0.0], [3.0], [3.0]]).double(), 1, seed=0).item() == 2


def test_entropy_of_clusters_that_lie_apart() -> None:
    truth = blobs(4, 25)
    assert shannon_index(truth, truth, clusters=4).item() == pytest.approx(2.0)
    shares = np.array([10, 10, 20, 60]) / 100
    prediction = blobs(4, 60)[[k * 60 + i for k, n in enumerate((10, 10, 20, 60)) for i in range(n)]]
    expected = -(shares * np.log2(shares)).sum()
    assert shannon_index(prediction, truth, clusters=4).item() == pytest.approx(expected)
    assert shannon_index(prediction, truth, clusters=4, of="truth").item() == pytest.approx(2.0)
    index = ShannonIndex(clusters=4)
    index.update(prediction[:50], truth[:50])
    index.reset()
    index.update(prediction[None], truth[None], lengths=[100])
    assert index.compute().item() == pytest.approx(expected)
    assert index.latest is None


def test_rooted_and_scaled_errors() -> None:
    truth, prediction = torch.zeros(5, 3, 3), torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(0))
    squares = (prediction.double() ** 2).sum(-1)
    lve = lip_vertex_error(prediction, truth, [0, 2], squared=True, root=True, scale=1000.0)
    assert lve.item() == pytest.approx(1000 * squares[:, [0, 2]].amax(1).mean().sqrt().item())
    mhd = mean_vertex_error(prediction, truth, squared=True, root=True)
    assert mhd.item() == pytest.approx(squares.mean().sqrt().item())
    squared = lip_vertex_error(prediction, truth, [0, 2], scale=10.0)
    assert squared.item() == pytest.approx(100 * squares[:, [0, 2]].amax(1).mean().item())
    with pytest.raises(ValueError, match="root"):
        mean_vertex_error(prediction, truth, root=True)


def test_moments_of_speaking_and_listening() -> None:
    random = torch.Generator().manual_seed(0)
    truth, prediction = torch.randn(2, 3, 9, 4, 1, generator=random).unbind()
    speaking = torch.rand(3, 9, generator=random) > 0.5
    speaking[1] = True  # who never listens has no score of listening
    inputs = {"prediction": prediction, "truth": truth, "lengths": [9, 7, 5], "clip_names": ["a", "b", "c"]}
    for moment, names in (("speaking", ["a", "b", "c"]), ("listening", ["a", "c"])):
        parts = split_frames(inputs, speaking, moment)  # type: ignore[arg-type]
        assert parts["clip_names"] == names
        metric = ChannelDynamicsDeviation([1, 2])
        context = Context({"channels": {}, "speaking": {}}, channels={"head": Region("head", (1, 2))})
        request = parse(f"{moment[0]}_channel_dynamics_deviation:region=head")
        named = request.build(context)
        feed(named, inputs | {"speaking": speaking}, request.moment)
        expected = []
        for place, length in enumerate((9, 7, 5)):
            mask = speaking[place, :length].numpy() == (moment == "speaking")
            if mask.any():
                p, g = (x[place, :length, 1:3, 0].double().numpy()[mask] for x in (prediction, truth))
                expected.append(100 * np.abs(p.std(0) - g.std(0)).mean())
        metric.update(parts["prediction"], parts["truth"], lengths=parts["lengths"])
        assert metric.compute().item() == pytest.approx(np.mean(expected), rel=1e-6)
        assert named.compute() == metric.compute()
        assert len(named.latest) == 3  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="mask"):
        split_frames(inputs, speaking[:, :6], "speaking")


def test_what_is_missing_is_named() -> None:
    motion = torch.randn(4, 2, 1, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="partner"):
        FrechetDistance([0], with_partner=True).update(motion, motion)
    for partner in (motion[:, :1], motion[:2]):
        with pytest.raises(ValueError, match="partner has the shape"):
            residual_partner_correlation(motion, motion, partner=partner)
    metric = FrechetDistance([0, 1])
    with pytest.raises(ValueError, match="set dims"):
        metric.update(motion.expand(4, 2, 3), motion.expand(4, 2, 3))
    assert metric.coverage().frames == 0
    index = ShannonIndex(clusters=2)
    index.update(motion, motion)
    with pytest.raises(ValueError, match="frames of 1 numbers after others of 2"):
        index.update(motion[:, :1], motion[:, :1])
    assert index.coverage().frames == 4
    metric.update(motion[:1], motion[:1])
    assert metric.compute().isnan(), "one frame has no covariance"
