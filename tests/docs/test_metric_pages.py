"""The pages on metrics: their code prints what they say, their tables agree with the code and with arithmetic."""

from __future__ import annotations

import doctest
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from torchmetrics import Metric

import facediff.metrics as fm

DOCS = Path(__file__).parents[2] / "docs"
METRICS, WHICH, PARAMETERS = (DOCS / name for name in ("metrics.md", "which_lve.md", "parameters.md"))
OF_VERTICES = [name for name, setting in fm.PROTOCOLS.items() if not setting.of_parameters]
BASES = {"ExactMetric", "LipMetric", "OpeningMetric", "SamplesMetric", "SequenceMetric", "SpeechLipMetric"}
BASES |= {"RatioMetric", "VertexError"}
Array = NDArray[np.float64]


def rows(page: Path, heading: str) -> list[list[str]]:
    """Cells of the first table whose head begins with a word, without the head."""
    lines = page.read_text().splitlines()
    start = next(place for place, line in enumerate(lines) if line.startswith(heading))
    found = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        found.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
    return found


@pytest.mark.parametrize(("page", "examples"), [(METRICS, 30), (WHICH, 15)])
def test_the_examples_run(page: Path, examples: int) -> None:
    failed, attempted = doctest.testfile(str(page), module_relative=False)
    assert attempted >= examples
    assert failed == 0


def test_every_metric_is_in_the_table_with_its_function_and_options() -> None:
    public = {name for name, thing in vars(fm).items() if inspect.isclass(thing) and issubclass(thing, Metric)}
    table = rows(METRICS, "| class |")
    assert {row[0].strip("`") for row in table} == public - BASES
    for made, function, _, _, options, _ in table:
        name = made.strip("`")
        assert function.strip("`") == re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
        assert callable(getattr(fm, function.strip("`")))
        named = set(re.findall(r"`(\w+)`", options))
        assert named <= inspect.signature(getattr(fm, name)).parameters.keys(), name


def test_the_table_of_protocols_is_that_of_the_code() -> None:
    table = rows(METRICS, "| protocol |")
    assert [row[0].strip("`") for row in table] == OF_VERTICES
    of_parameters = [row[0].strip("`") for row in rows(PARAMETERS, "| protocol |")]
    assert sorted(of_parameters) == sorted(set(fm.PROTOCOLS) - set(OF_VERTICES))
    for name, _, mve, lve, fdd, pooling, lengths in table:
        setting = fm.PROTOCOLS[name.strip("`")]
        assert {"mean": "mean", "largest of a frame": "max", "": None}[mve] == setting.mve
        assert not setting.mve_squared
        assert {"squared": True, "not squared": False}[lve] == setting.lve_squared
        assert tuple(re.findall("signed|absolute", fdd)) == setting.fdd
        assert pooling == setting.pooling
        assert lengths.startswith("prediction cut") == (setting.length_rule == "prediction")


def along_x(*frames: tuple[float, ...]) -> Array:
    return np.stack([np.array(frames, float), np.zeros((len(frames), 4)), np.zeros((len(frames), 4))], -1)


def scores(truths: list[Array], predictions: list[Array]) -> dict[str, dict[str, float]]:
    """Every protocol by its formulas, in NumPy; vertices 0 and 1 are lips, 2 and 3 upper face, the template is 0."""
    pairs = [(g, p[: len(g)]) for g, p in zip(truths, predictions, strict=True)]
    distances = [np.linalg.norm(g - p, axis=-1) for g, p in pairs]
    lips = [d[:, :2].max(1) for d in distances]
    spread = [[(x**2).sum(-1)[:, 2:].std(0).mean() for x in pair] for pair in pairs]
    gaps = np.array([g - p for g, p in spread])
    everything = np.concatenate(distances)
    mean, largest = everything.mean(), everything.max(1).mean()
    squared, plain = (np.concatenate(lips) ** 2).mean(), np.concatenate(lips).mean()
    signed, absolute = gaps.mean(), np.abs(gaps).mean()
    return {
        "paper": {"mve": mean, "lve": squared, "fdd": absolute},
        "paper_text": {"mve": largest, "lve": plain, "fdd": absolute},
        "codetalker": {"lve": squared, "fdd": signed},
        "facediffuser": {"mve": mean, "lve": squared, "fdd": signed, "fdd_absolute": absolute},
        "diffspeaker": {"lve": float(np.mean([(m**2).mean() for m in lips])), "fdd": signed},
        "meshtalk": {"lve": plain},
        "unitalker": {"mve": mean, "lve": squared},
    }


def test_the_worked_example_is_right() -> None:
    rest = (0, 0, 0, 0)
    truths = [along_x(rest, (0, 0, 2, 2)), along_x(rest, rest, rest, rest)]
    calm, lively = (1, 1, 0, 0), (1, 1, 2, 2)
    one = [along_x((3, 1, 0, 0), (3, 1, 0, 0)), along_x(calm, lively, calm, lively, (9, 9, 9, 9))]
    two = [along_x(*[(2, 2, 0, 0)] * frames) for frames in (2, 4)]
    printed = re.findall(r"^protocol +(mve.*)\n((?:\w+ .*\n){7})", WHICH.read_text(), re.MULTILINE)
    assert len(printed) == 2
    for (head, body), prediction in zip(printed, (one, two), strict=True):
        expected = scores(truths, prediction)
        lines = [line.split() for line in body.splitlines()]
        assert [line[0] for line in lines] == list(expected) == OF_VERTICES
        for name, *cells in lines:
            shown = {key: cell for key, cell in zip(head.split(), cells, strict=True) if cell != "-"}
            assert shown == {key: f"{value:.4f}" for key, value in expected[name].items()}


def test_the_published_figures_in_the_code_are_those_of_the_table() -> None:
    text = WHICH.read_text()
    for row in rows(WHICH, "| | BIWI MVE |"):
        method = row[0].removesuffix(" method")
        pairs = re.findall(rf'"{re.escape(method)}": \((\S+)e-3, (\S+)e-4\)', text)
        assert pairs == [(mve, lve) for mve, lve in ((row[1], row[2]), (row[4], row[5])) if mve]
