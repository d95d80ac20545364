"""Whether a metric depends on the order of frames, as it says."""

from __future__ import annotations

import inspect

import pytest
import torch

from facediff.metrics.by_name import OF_ALL_FRAMES
from tests.metrics.conftest import Corpus
from tests.metrics.further_cases import CASES, Case


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
