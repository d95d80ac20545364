"""Protocols: their settings, names, words, and the collection they build."""

from __future__ import annotations

import json
import pickle
from functools import partial
from typing import Any

import pytest
import torch

from facediff.metrics import PROTOCOLS, Protocol, ProtocolMetrics, Region, protocol
from tests.metrics.further_cases import dynamics_off, pooled, vertex_error

Corpus = Any  # the class of that name in conftest.py, which test files cannot import
SCORES = {
    "paper": ["mve", "lve", "fdd"],
    "paper_text": ["mve", "lve", "fdd"],
    "codetalker": ["lve", "fdd"],
    "facediffuser": ["mve", "lve", "fdd", "fdd_absolute"],
    "diffspeaker": ["lve", "fdd"],
    "meshtalk": ["lve"],
    "unitalker": ["mve", "lve"],
}


def build(name: str, lips: tuple[int, ...], upper: tuple[int, ...]) -> ProtocolMetrics:
    return protocol(name).build(Region.from_indices("lips", lips), Region.from_indices("upper", upper))


@pytest.mark.parametrize("name", SCORES)
def test_scores_follow_the_definitions(
    name: str,
    corpus: Corpus,
    lips: tuple[int, ...],
    upper: tuple[int, ...],
) -> None:
    metrics = build(name, lips, upper)
    for places in ([0, 1], [2], [3, 4]):
        metrics.update(**corpus.batch(places))
    pooling = "sequences" if name == "diffspeaker" else "frames"
    per_frame = "max" if name == "paper_text" else "mean"
    squared = name not in ("paper_text", "meshtalk")
    mve = partial(vertex_error, region=range(40), reduction=per_frame, squared=False)
    lve = partial(vertex_error, region=lips, reduction="max", squared=squared)
    fdd = partial(dynamics_off, sign="absolute" if "paper" in name else "signed")
    expected = {
        "mve": pooled(mve, pooling)(corpus),
        "lve": pooled(lve, pooling)(corpus),
        "fdd": pooled(fdd, "sequences")(corpus),
        "fdd_absolute": pooled(partial(dynamics_off, sign="absolute"), "sequences")(corpus),
    }
    found = {score: value.item() for score, value in metrics.compute().items()}
    assert list(found) == SCORES[name]
    assert found == pytest.approx({score: expected[score] for score in SCORES[name]}, rel=1e-6)


def test_there_are_these_of_vertices_and_paper_is_the_default() -> None:
    assert [name for name, setting in PROTOCOLS.items() if not setting.of_parameters] == list(SCORES)
    assert protocol() is PROTOCOLS["paper"]
    assert not protocol("dualtalk").lve  # its tables have channels and no lips
    with pytest.raises(ValueError, match=r'unknown protocol .codtalker.: did you mean "codetalker".*meshtalk'):
        protocol("codtalker")


@pytest.mark.parametrize("name", SCORES)
def test_a_protocol_says_what_its_numbers_are(name: str) -> None:
    text = protocol(name).describe()
    assert [line.split(":")[0].strip() for line in text.splitlines()[1:-1]] == SCORES[name]
    assert "frames of all sequences" in text or "mean over sequences" in text


def test_own_protocols_are_checked() -> None:
    mine = Protocol("mine", "here", mve="mean", mve_squared=True, fdd=("absolute", "signed"))
    assert list(mine.build(Region("a", (0,)), Region("b", (1,))).keys()) == [
        "mve",
        "lve",
        "fdd",
        "fdd_signed",
    ]
    with pytest.raises(ValueError, match="unknown sign"):
        Protocol("mine", "here", fdd=("sined",)).build([0], [1])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="give the upper-face region"):
        mine.build(Region("a", (0,)))


def test_summary_names_regions_frames_and_cuts(corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...]) -> None:
    metrics = build("paper", lips, upper)
    batch = corpus.batch([0, 2])
    metrics.update(**batch, prediction_lengths=[5, 30])
    summary = metrics.summary()
    assert str(summary).startswith("protocol paper: lips lips (4 vertices, ")
    assert str(summary).endswith("; frames 35, sequences 2; frames cut: prediction 0, truth 2")
    plain = json.loads(json.dumps(summary.as_dict()))
    assert plain["regions"]["upper"] == {
        "name": "upper",
        "count": 5,
        "hash": Region.from_indices("", upper).hash,
        "duplicates": 0,
    }
    assert (plain["frames"], plain["sequences"], plain["cut_truth"]) == (35, 2, 2)
    assert "lips (4 vertices" in metrics.describe()
    bare = protocol("paper").build(lips, upper)  # indices, which the metrics take too
    bare.update(**batch, prediction_lengths=[5, 30])
    assert str(bare.summary()) == str(summary)


def test_a_topology_tells_usual_regions_from_others() -> None:
    lips, upper = Region.from_indices("lve", range(4996)), Region.from_indices("fdd", range(9000, 9000 + 7784))
    summary = protocol("codetalker", topology="biwi").build(lips, upper).summary()
    assert summary.remarks == [
        "lips of 4996 vertices are usual on biwi: lve.txt of BIWI",
        "upper of 7784 vertices is usual on biwi: fdd.txt of BIWI",
    ]
    assert str(summary).endswith("; ".join(summary.remarks))
    assert json.loads(json.dumps(summary.as_dict()))["remarks"] == summary.remarks
    flame = protocol("codetalker", topology="vocaset")
    small = flame.build(Region.from_indices("mask", range(250)), Region.from_indices("x", range(300, 400)))
    assert "250 vertices are usual on vocaset: lips of FLAME's masks" in small.summary().remarks[0]
    assert small.summary().remarks[1].startswith("upper of 100 vertices is not usual on vocaset (827: ")
    assert "topology" not in protocol("codetalker").build(lips, upper).summary().as_dict()


def test_a_topology_refuses_regions_and_motion_of_another() -> None:
    flame = protocol("meshtalk", topology="mead3d")
    with pytest.raises(ValueError, match="index 5023, a mesh of 5023 vertices ends at 5022"):
        flame.build(Region("lips", (1, 5023)))
    with pytest.raises(ValueError, match="belongs to a mesh of 23370 vertices"):
        flame.build(Region("lips", (1,), 23370))
    metrics = flame.build(Region("lips", (1,)))
    with pytest.raises(ValueError, match="belongs to a mesh of 5023 vertices, not of 40"):
        metrics.update(torch.zeros(2, 40, 3), torch.zeros(2, 40, 3))
    with pytest.raises(ValueError, match='unknown topology .biwy.: did you mean "biwi"'):
        protocol("meshtalk", topology="biwy")


def test_codetalker_refuses_a_shorter_prediction(corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...]) -> None:
    metrics = build("codetalker", lips, upper)
    with pytest.raises(ValueError, match="'prediction' refuses this"):
        metrics.update(**corpus.batch([0, 2]), prediction_lengths=[5, 30])
    assert metrics.summary().coverage.sequences == 0


@pytest.mark.parametrize("call", ["update", "forward"])
def test_a_refused_batch_changes_no_metric(
    corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...], call: str
) -> None:
    metrics = build("paper", lips, upper)
    metrics.update(**corpus.batch([2]))
    before = metrics.compute()
    for changes in ({"template": torch.zeros(3)}, {"truth": torch.full((1, 30, 40, 3), float("nan"))}):
        with pytest.raises(ValueError, match="template has shape|holds NaN"):
            getattr(metrics, call)(**(corpus.batch([2]) | changes))
    assert metrics.compute() == before
    assert metrics.summary().coverage.sequences == 1


def test_the_collection_resets_pickles_clones_and_forwards(
    corpus: Corpus, lips: tuple[int, ...], upper: tuple[int, ...]
) -> None:
    metrics = build("facediffuser", lips, upper)
    batch_scores = metrics(**corpus.batch([2]))
    assert metrics.compute() == batch_scores
    twin = pickle.loads(pickle.dumps(metrics))  # noqa: S301
    assert twin.compute() == batch_scores
    assert list(metrics.clone(prefix="test/").compute()) == [f"test/{name}" for name in batch_scores]
    metrics.reset()
    assert metrics.summary().coverage.frames == 0
    assert not metrics.state_dict()
