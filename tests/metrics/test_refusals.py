"""What would give a wrong score without a word is refused where it enters, and nothing of it is added."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torchmetrics import Metric

from facediff import metrics as fm
from tests.metrics.further_cases import CASES, Case, pair_batch


def motion(batch: int = 2, frames: int = 5, vertices: int = 4) -> Tensor:
    return torch.randn(batch, frames, vertices, 3, generator=torch.Generator().manual_seed(batch + frames + vertices))


RIGHT: dict[str, dict[str, Any]] = {
    "motion": {"prediction": motion(), "truth": motion()},
    "speech": {"prediction": motion(), "truth": motion(), "intensity": torch.rand(2, 5)},
    "closures": {"prediction": motion(), "truth": motion(), "closures": [[(0, 2)], [(1, 3), (3, 5)]]},
    "samples": {"samples": torch.stack([motion()] * 3, 1), "truth": motion()},
}
MAKE: dict[str, Callable[..., Any]] = {
    "motion": partial(fm.FaceDynamicsDeviation, [0, 3]),
    "speech": partial(fm.ClipSpeechLipCorrelation, [0], n_identities=1),
    "closures": partial(fm.BilabialClosureRate, [(0, 1)]),
    "samples": partial(fm.EnergyScore, n_samples=3),
}
NAN = float("nan")
WRONG: list[tuple[str, dict[str, Any]]] = [
    ("motion", {"truth": motion(vertices=3)}),
    ("motion", {"truth": motion(batch=1)}),
    ("motion", {"truth": motion()[0]}),
    ("motion", {"truth": motion()[..., :2], "prediction": motion()[..., :2]}),
    ("motion", {"prediction": motion()[None], "truth": motion()[None]}),
    ("motion", {"prediction": motion()[:, :, :0], "truth": motion()[:, :, :0]}),
    ("motion", {"prediction": motion(vertices=3), "truth": motion(vertices=3)}),
    ("motion", {"prediction": motion().long()}),
    ("motion", {"truth": motion() * NAN}),
    ("motion", {"template": torch.zeros(3, 3)}),
    ("motion", {"template": torch.full((4, 3), NAN)}),
    ("motion", {"lengths": [5]}),
    ("motion", {"lengths": [5, 6]}),
    ("motion", {"lengths": [5, -1]}),
    ("motion", {"lengths": [5, 0]}),
    ("motion", {"lengths": torch.tensor([5.0, 2.0])}),
    ("motion", {"lengths": torch.ones(2, 4, dtype=torch.bool)}),
    ("motion", {"lengths": torch.tensor([[True, False, True, True, True]] * 2)}),
    ("motion", {"prediction_lengths": [5, 6]}),
    ("motion", {"truth": motion(frames=6), "lengths": [5, 5]}),
    ("motion", {"clip_names": ["a"]}),
    ("speech", {"intensity": None}),
    ("speech", {"waveform": torch.ones(2, 80), "intensity": None}),
    ("speech", {"waveform": torch.ones(2, 80)}),
    ("speech", {"intensity": torch.ones(2, 4)}),
    ("speech", {"intensity": torch.ones(3, 5)}),
    ("speech", {"intensity": torch.ones(5)}),
    ("speech", {"intensity": torch.ones(2, 5, dtype=torch.int64)}),
    ("speech", {"intensity": torch.full((2, 5), NAN)}),
    ("speech", {"identities": [0]}),
    ("speech", {"identities": [0, 1]}),
    ("speech", {"identities": [0.0, 0.0]}),
    ("closures", {"closures": [[(0, 2)]]}),
    ("closures", {"closures": [[(0, 2)], [(3, 3)]]}),
    ("closures", {"closures": [[(0, 2)], [(3, 5), (4, 6)]]}),
    ("closures", {"closures": [[(-1, 2)], []]}),
    ("closures", {"closures": [[(0, 1, 2)], []]}),
    ("closures", {"closures": torch.ones(2, 5)}),
    ("closures", {"closures": torch.ones(2, 4, dtype=torch.bool)}),
    ("samples", {"samples": torch.stack([motion()] * 2, 1)}),
    ("samples", {"samples": motion()[0]}),
    ("samples", {"samples": torch.stack([motion()] * 3, 1)[:1]}),
]


@pytest.mark.parametrize(("kind", "change"), WRONG, ids="".join)
def test_misfits_are_refused_and_nothing_is_added(kind: str, change: dict[str, Any]) -> None:
    metric = MAKE[kind]()
    metric.update(**RIGHT[kind])
    before = metric.coverage()
    with pytest.raises((ValueError, TypeError)):
        metric.update(**(RIGHT[kind] | change))
    assert metric.coverage() == before
    assert before.sequences == 2 or before.left_out


@pytest.mark.parametrize(
    "make",
    [
        partial(fm.BilabialClosureRate, [(0, 1)], threshold=1.5),
        partial(fm.BlinkRateRatio, [(0, 1)], closed=0.3, reopened=0.4),
        partial(fm.BlinkRate, [(0, 1)]),
        partial(fm.ClipSpeechLipCorrelation, [0], sample_rate=10, frames_per_second=25),
        partial(fm.ClipSpeechLipCorrelation, [0], sample_rate=16000),
        partial(fm.SampleDiversity, n_samples=5),
        partial(fm.EnergyScore, n_samples=1),
        partial(fm.VertexError, scale=0.0),
        partial(fm.VertexError, scale=NAN),
        partial(fm.VertexError, root=True),
        partial(fm.VertexError, reduction="meen"),
        partial(fm.MouthOpeningDifference, [(0, 1)], pooling="frame"),
        partial(fm.ClipSpeechLipCorrelation, [0], of="both"),
    ],
    ids=str,
)
def test_options_without_a_meaning_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"expected|known are|squared"):
        make()


Corpus = Any  # the class of that name in conftest.py
Batch = Callable[[Corpus], dict[str, Any]]
PLACES = [2, 0, 3]
PAIR: Batch = partial(pair_batch, places=PLACES, extra=0)
GALLERY = fm.SpeakerGallery(torch.rand(4, 40, 3, generator=torch.Generator().manual_seed(0)), (0, 0, 1, 1))
LIDS = [(3, 9), (31, 4)]


def arguments_of(case: Case) -> Batch:
    return lambda corpus: case.arguments(corpus, PLACES, 0)


def speaker_batch(corpus: Corpus) -> dict[str, Any]:
    """Predictions, and whom they should show."""
    batch = PAIR(corpus)
    return {"prediction": batch["prediction"], "identities": [0, 1, 1], "lengths": batch["lengths"]}


EVERY: dict[str, tuple[Callable[[], Any], Batch]] = {
    **{case.name: (case.make, arguments_of(case)) for case in CASES},
    "VertexError": (fm.VertexError, PAIR),
    "ShannonIndex": (partial(fm.ShannonIndex, [0, 1]), PAIR),
    "BlinkRate": (partial(fm.BlinkRate, LIDS, frames_per_second=25), PAIR),
    "BlinkRateRatio": (partial(fm.BlinkRateRatio, LIDS), PAIR),
    "EyelidDrift": (partial(fm.EyelidDrift, LIDS), PAIR),
    "NearestSpeakerAccuracy": (partial(fm.NearestSpeakerAccuracy, GALLERY), speaker_batch),
    "RealTimeFactor": (
        partial(fm.RealTimeFactor, "one core"), lambda _: dict.fromkeys(("computing", "speech"), torch.ones(3)),
    ),
}  # fmt: skip


def faults(batch: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The same batch with one fault each, in its last sequence where that is possible."""
    for name, value in batch.items():
        yield {key: other for key, other in batch.items() if key != name}
        yield batch | {name: value[:-1]}
        if isinstance(value, Tensor) and value.is_floating_point():
            ruined = value.clone()
            ruined[-1].view(-1)[0] = NAN
            yield batch | {name: ruined}
            for kept in ((..., slice(-1)), (..., slice(-1), slice(None))):
                yield batch | ({name: value[kept]} if value.ndim > 1 else {})
        else:
            yield batch | {name: [*value[:-1], 10**6]}
    narrow = {name: value[..., :20, :] for name, value in batch.items() if isinstance(value, Tensor) and value.ndim > 2}
    yield batch | narrow  # all of a smaller mesh


@pytest.mark.parametrize("name", EVERY)
def test_a_refused_batch_leaves_every_state_as_it_was(name: str, corpus: Corpus) -> None:
    make, arguments = EVERY[name]
    batch = arguments(corpus)
    metric = make()
    metric.update(**batch)
    refused = 0
    for fault in faults(batch):
        before = copy.deepcopy(metric.metric_state)
        try:
            metric.update(**fault)
        except Exception:  # noqa: BLE001 - of whatever kind
            refused += 1
            torch.testing.assert_close(metric.metric_state, before, rtol=0, atol=0, equal_nan=True)
    assert refused > 2


def test_every_metric_is_given_faults() -> None:
    classes = [kind for kind in vars(fm).values() if inspect.isclass(kind) and issubclass(kind, Metric)]
    assert {type(make()) for make, _ in EVERY.values()} == {kind for kind in classes if not inspect.isabstract(kind)}
