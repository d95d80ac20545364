"""The products of the linear ends against their definition, and the cache against changed weights."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import nn

from facediff.models import folding
from facediff.models.folding import Fold, WeightCache, fold


def ends(dim: int, coordinates: int, dtype: torch.dtype = torch.float64) -> tuple[nn.Linear, nn.Linear]:
    torch.manual_seed(0)
    return nn.Linear(coordinates, dim, dtype=dtype), nn.Linear(dim, coordinates, dtype=dtype)


@pytest.mark.parametrize(("dim", "coordinates"), [(6, 30), (6, 4), (5, 5), (1, 7)])
@pytest.mark.parametrize("chunk", [3, 1000])
def test_fold_products(dim: int, coordinates: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folding, "CHUNK", chunk)
    first, last = ends(dim, coordinates)
    made = fold(first.weight.detach(), last.weight.detach(), last.bias.detach())
    e, u, b = first.weight.detach(), last.weight.detach(), last.bias.detach()
    torch.testing.assert_close(made.product, e @ u, rtol=0, atol=1e-14)
    torch.testing.assert_close(made.offset, e @ b, rtol=0, atol=1e-14)
    # With fewer coordinates than channels E Eᵀ is singular; square roots of rounding are 1e-8.
    torch.testing.assert_close(made.root @ made.root.T, e @ e.T, rtol=0, atol=1e-14)
    torch.testing.assert_close(made.root, made.root.T, rtol=0, atol=1e-14)
    assert torch.linalg.eigvalsh(made.root).min() > -1e-7


def test_fold_multiplies_float32_weights_in_float64() -> None:
    first, last = ends(4, 20_000, torch.float32)
    made = fold(first.weight.detach(), last.weight.detach(), last.bias.detach())
    exact = (first.weight.double() @ last.weight.double()).float()
    assert made.product.dtype == torch.float32
    torch.testing.assert_close(made.product, exact, rtol=1e-6, atol=1e-9)


def test_fold_without_bias_has_offset_zero() -> None:
    first, last = ends(3, 8)
    assert not fold(first.weight.detach(), last.weight.detach(), None).offset.any()


CHANGES: dict[str, Callable[[nn.Linear, nn.Linear], object]] = {
    "in place": lambda first, _: first.weight.detach().mul_(1.001),
    # As weight averages are swapped: no version counter sees it.
    "through data": lambda first, _: first.weight.data.copy_(first.weight.data.flip(0)),
    "last map through data": lambda _, last: last.weight.data.mul_(1 + 1e-6),
    "one number": lambda _, last: last.weight.data[3, 2].add_(0.01),
    "rows exchanged": lambda first, _: first.weight.data.copy_(first.weight.data.flip(1)),
    "bias": lambda _, last: last.bias.data[0].add_(1e-3),
    "state dict": lambda first, _: first.load_state_dict({k: 2 * v for k, v in first.state_dict().items()}),
    "type": lambda first, last: (first.float(), last.float()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_weight_cache_sees_every_change(change: str) -> None:
    calls: list[int] = []
    first, last = ends(4, 12)
    cache: WeightCache[Fold] = WeightCache()

    def compute() -> Fold:
        calls.append(1)
        return fold(first.weight, last.weight, last.bias)

    for _ in range(3):
        cache.get([first.weight, last.weight, last.bias], "fold", compute)
    assert len(calls) == 1
    CHANGES[change](first, last)
    found = cache.get([first.weight, last.weight, last.bias], "fold", compute)
    assert len(calls) == 2
    expected = fold(first.weight.detach(), last.weight.detach(), last.bias.detach())
    for name in ("product", "offset", "root"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_weight_cache_filled_in_inference_mode_serves_outside_of_it() -> None:
    first, last = ends(4, 12)
    cache: WeightCache[Fold] = WeightCache()
    with torch.inference_mode():
        made = cache.get([first.weight], "fold", lambda: fold(first.weight, last.weight, last.bias))
    assert not made.product.is_inference()
    weight = torch.ones(4, 4, dtype=torch.float64, requires_grad=True)
    (made.product @ weight).sum().backward()


def test_weight_cache_keeps_the_value_of_one_key() -> None:
    cache: WeightCache[int] = WeightCache()
    weights = [torch.ones(2, 2)]
    assert [cache.get(weights, key, lambda key=key: key) for key in (1, 1, 2)] == [1, 1, 2]


def test_fold_root_does_not_depend_on_the_signs_of_eigenvectors(monkeypatch: pytest.MonkeyPatch) -> None:
    first, last = ends(4, 12)
    maps = first.weight.detach(), last.weight.detach(), None
    once = fold(*maps).root
    real = torch.linalg.eigh

    def other(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, vectors = real(matrix)
        return values.flip(0), -vectors.flip(1)

    monkeypatch.setattr(torch.linalg, "eigh", other)
    torch.testing.assert_close(fold(*maps).root, once, rtol=0, atol=1e-14)
