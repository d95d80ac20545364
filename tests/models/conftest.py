"""Small components of every kind, and clips to feed them, alone or padded in a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny

DIM = 16
STYLE_DIM = 12
IDENTITIES = 5
LENGTHS = (9, 21, 1, 40)
SAMPLES_PER_FRAME = 640
SIZES: dict[str, dict[str, int]] = {
    "audio_encoder": {"dim": DIM},
    "identity_encoder": {"dim": DIM, "n_identities": IDENTITIES},
    "style_encoder": {"dim": DIM},
    "fusion": {"dim": DIM},
    "decoder": {"dim": DIM, "style_dim": STYLE_DIM},
}
Make = Callable[..., nn.Module]
Arguments = tuple[Tensor, ...]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Every registered component of every kind, so that a new one is tested by existing."""
    if {"kind", "name"} <= set(metafunc.fixturenames):
        cases = [(kind, name) for kind in SIZES for name in registry.COMPONENTS[kind].names()]
        metafunc.parametrize(("kind", "name"), cases)


@pytest.fixture
def batch(tiny: Tiny) -> Batch:
    """Two clips, the first padded."""
    dataset = tiny.dataset("train")
    return collate([dataset[0], dataset[7]])


@pytest.fixture
def ready(make_model: Callable[..., DualPathDiffusion], tiny: Tiny) -> Callable[..., DualPathDiffusion]:
    """Models that know the miniature corpus; keyword arguments override."""

    def build(**options: object) -> DualPathDiffusion:
        model = make_model(**options)
        model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
        return model.eval()

    return build


@pytest.fixture
def make(hubert_source: Path, ctc_source: Path, deepspeech_source: Path) -> Make:
    """A small component by kind and name, with reproducible weights."""
    sources = {
        "hubert": hubert_source,
        "wav2vec2": hubert_source,
        "ctc": ctc_source,
        "deepspeech": deepspeech_source,
    }

    def build(kind: str, name: str, seed: int = 0, **options: Any) -> nn.Module:  # noqa: ANN401
        if name in sources:
            options = {"source": str(sources[name]), **options}
        torch.manual_seed(seed)
        module: nn.Module = registry.COMPONENTS[kind].get(name)(**SIZES[kind], **options)
        return module

    return build


def clip(i: int, *shape: int) -> Tensor:
    """Random numbers that belong to clip ``i``."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(1000 + i))


def padded(sequences: Sequence[Tensor], extra: int, garbage: float) -> Tensor:
    size = max(len(s) for s in sequences) + extra
    out = garbage * torch.randn(len(sequences), size, *sequences[0].shape[1:])
    for row, sequence in enumerate(sequences):
        out[row, : len(sequence)] = sequence
    return out


def arguments(kind: str, clips: Sequence[int], extra: int = 0, garbage: float = 0.0) -> Arguments:
    """What a component of a kind is called with for some of the clips, padded by ``extra`` frames of garbage.

    The audio encoder's contract names no number of frames beyond the longest clip's, so only its samples are padded.
    """
    lengths = torch.tensor([LENGTHS[i] for i in clips])
    mask = torch.arange(int(lengths.max()) + extra)[None] < lengths[:, None]

    def frames(salt: int) -> Tensor:
        return padded([clip(i + salt, LENGTHS[i], DIM) for i in clips], extra, garbage)

    if kind == "audio_encoder":
        # Clips need not be cut at a frame's end.
        sizes = [LENGTHS[i] * SAMPLES_PER_FRAME - (11 if i == 1 else 0) for i in clips]
        waves = [0.1 * clip(i, size) for i, size in zip(clips, sizes, strict=True)]
        return padded(waves, extra * SAMPLES_PER_FRAME, garbage), torch.tensor(sizes), lengths
    if kind == "identity_encoder":
        return (torch.tensor([-1 if i == 3 else i for i in clips]),)
    if kind == "style_encoder":
        return frames(0), mask
    if kind == "fusion":
        return frames(0), frames(50), mask
    tokens = torch.stack([clip(i + 70, 3, STYLE_DIM) for i in clips])
    return frames(0), tokens, mask


def no_dropout(module: nn.Module) -> nn.Module:
    """Training mode, but nothing random."""
    for part in module.modules():
        if isinstance(part, nn.Dropout):
            part.p = 0.0
        elif isinstance(getattr(part, "dropout", None), float):
            part.dropout = 0.0
    return module.train()


@pytest.fixture
def call() -> Callable[..., Arguments]:
    """See :func:`arguments`."""
    return arguments


@pytest.fixture
def without_dropout() -> Callable[[nn.Module], nn.Module]:
    """See :func:`no_dropout`."""
    return no_dropout
