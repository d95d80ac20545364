"""Mesh encoders, whatever their name; and the spiral one against its definition, vertex by vertex."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable
from functools import cache
from typing import Any, Literal

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.mesh.hierarchy import MeshHierarchy, mesh_hierarchy
from facediff.models.mesh_encoders import ComponentMeshEncoder, MeshEncoder, SpiralMeshEncoder
from facediff.models.motion_space import PrincipalComponents
from tests.fakes.meshes import relief

DIM, ROWS, COLUMNS = 7, 14, 12
VERTICES = ROWS * COLUMNS
NAMES = registry.mesh_encoder.names()
Hierarchy = Callable[..., MeshHierarchy]


@pytest.fixture(scope="module")
def hierarchy() -> Hierarchy:
    return cache(lambda **options: mesh_hierarchy(*relief(ROWS, COLUMNS), **options))


@pytest.fixture
def make(hierarchy: Hierarchy) -> Callable[..., MeshEncoder]:
    def build(name: str, seed: int = 0, **options: Any) -> MeshEncoder:  # noqa: ANN401
        torch.manual_seed(seed)
        encoder: MeshEncoder = registry.mesh_encoder.get(name)(dim=DIM, n_vertices=VERTICES, dims=3, **options)
        if not encoder.attached:
            encoder.attach(hierarchy(**encoder.mesh_options))
        for part in encoder.modules():
            if isinstance(part, PrincipalComponents):
                frames = motion(1, 80)[0].flatten(1)
                _, sizes, shapes = torch.linalg.svd(frames - frames.mean(0), full_matrices=False)
                part.attach(frames.mean(0), sizes[:, None] * shapes / len(frames) ** 0.5, torch.ones(3 * VERTICES))
        assert encoder.attached
        return encoder

    return build


def motion(batch: int = 2, frames: int = 3, seed: int = 5) -> Tensor:
    return torch.randn(batch, frames, VERTICES, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", NAMES)
def test_mesh_encoder_shape_and_independence_of_frames(name: str, make: Callable[..., MeshEncoder]) -> None:
    encoder, inputs = make(name).eval(), motion()
    before = inputs.clone()
    out = encoder(inputs)
    assert out.shape == (2, 3, DIM)
    assert out.dtype == torch.float32
    assert torch.equal(inputs, before)
    for clip in range(2):
        for frame in range(3):
            alone = encoder(inputs[clip : clip + 1, frame : frame + 1])
            torch.testing.assert_close(out[clip, frame], alone[0, 0], rtol=0, atol=1e-5)
    spoilt = inputs.clone()
    spoilt[1, 2] = torch.nan  # a padded frame
    torch.testing.assert_close(encoder(spoilt)[0], out[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(encoder(spoilt)[1, :2], out[1, :2], rtol=0, atol=1e-5)


def test_components_see_small_movements_as_large_ones(make: Callable[..., MeshEncoder]) -> None:
    encoder = make("components")
    assert isinstance(encoder, ComponentMeshEncoder)
    part, names = encoder.components, range(0, 64, 9)
    still = part.mean.view(1, 1, VERTICES, 3)
    for k in names:  # one deviation of a component, in whatever size, is one unit of its own input of the map
        moved = still + (part.deviations[k] * part.basis[k]).view(1, 1, VERTICES, 3)
        change = encoder(moved) - encoder(still)
        torch.testing.assert_close(change[0, 0], encoder.map.weight[:, k], rtol=1e-3, atol=1e-5)


def test_mean_pooling_sees_every_vertex(make: Callable[..., MeshEncoder]) -> None:
    inputs = motion().requires_grad_()
    make("spiral", pooling="mean")(inputs).square().sum().backward()
    assert inputs.grad is not None
    assert inputs.grad.abs().sum((0, 1, 3)).all()


@pytest.mark.parametrize("name", NAMES)
def test_mesh_encoder_state_dict_needs_no_mesh(name: str, make: Callable[..., MeshEncoder]) -> None:
    expected = make(name)(motion())
    file = io.BytesIO()
    torch.save(make(name).state_dict(), file)
    file.seek(0)
    fresh: nn.Module = registry.mesh_encoder.get(name)(dim=DIM, n_vertices=VERTICES, dims=3)
    fresh.load_state_dict(torch.load(file, weights_only=True))
    assert fresh.attached
    assert torch.equal(fresh(motion()), expected)
    assert not torch.equal(make(name, seed=1)(motion()), expected)


def naive(encoder: SpiralMeshEncoder, mesh: MeshHierarchy, frame: np.ndarray) -> np.ndarray:
    """A frame (V, 3) through [spiral convolution at every vertex → selection → leaky ReLU] …, in float64 loops."""
    features = frame.astype(np.float64)
    for step, level in zip(encoder.steps, mesh.levels, strict=False):
        weight = step.map.weight.detach().double().numpy()
        bias = step.map.bias.detach().double().numpy()
        convolved = np.empty((len(features), len(weight)))
        for vertex, spiral in enumerate(level.spirals):
            convolved[vertex] = weight @ np.concatenate([features[near] for near in spiral]) + bias
        assert level.down is not None
        pooled = np.zeros((level.down.shape[0], len(weight)))
        for row, column, share in zip(level.down.rows, level.down.columns, level.down.weights, strict=True):
            pooled[row] += share * convolved[column]
        features = np.where(pooled > 0, pooled, 0.2 * pooled)
    weight = encoder.map.weight.detach().double().numpy()
    flat: np.ndarray = weight @ features.ravel() + encoder.map.bias.detach().double().numpy()
    return flat


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"channels": (4,), "factor": 3},
        {"channels": (4, 5), "spiral_length": 9, "dilation": 2},
        {"channels": ()},
        {"pooling": "mean"},
    ],
    ids=str,
)
def test_spiral_against_its_definition(
    options: dict[str, Any], make: Callable[..., MeshEncoder], hierarchy: Hierarchy
) -> None:
    torch.manual_seed(0)
    encoder = make("spiral", **options)
    assert isinstance(encoder, SpiralMeshEncoder)
    for step in encoder.steps:
        nn.init.normal_(step.map.bias)
    mesh, inputs = hierarchy(**encoder.mesh_options), 0.3 * motion()
    out = encoder.double()(inputs.double()).detach().numpy()
    for clip in range(2):
        for frame in range(3):
            np.testing.assert_allclose(out[clip, frame], naive(encoder, mesh, inputs[clip, frame].numpy()), atol=1e-6)


@pytest.mark.parametrize("pooling", ["select", "mean"])
def test_spiral_without_a_mesh_is_an_error(hierarchy: Hierarchy, pooling: Literal["select", "mean"]) -> None:
    encoder = SpiralMeshEncoder(dim=DIM, n_vertices=VERTICES, dims=3, pooling=pooling)
    assert not encoder.attached
    with pytest.raises(FaceDiffError, match="mesh is not known yet"):
        encoder(motion())
    shapes = {name: buffer.shape for name, buffer in encoder.named_buffers()}
    other = copy.deepcopy(encoder)  # as weight averaging does before a corpus is known
    encoder.attach(hierarchy(**encoder.mesh_options))
    assert {name: buffer.shape for name, buffer in encoder.named_buffers()} == shapes
    assert not other.attached
    for mine, theirs in zip(other.buffers(), encoder.buffers(), strict=True):
        mine.copy_(theirs)
    other.load_state_dict(dict(encoder.named_parameters()), strict=False)
    assert torch.equal(other(motion()), encoder(motion()))
