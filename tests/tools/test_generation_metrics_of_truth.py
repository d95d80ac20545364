"""Other truths of a clip: those that the corpus's own generator draws, alike in the lips and not in the upper face."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("espeakng_loader")

from facediff.synthetic.second_edition import generate_second
from tools.generation_metrics_of_truth import OtherTruths, other_truth, write_truths


def test_the_first_truth_is_the_corpus_and_others_differ_in_the_upper_face(tmp_path: Path) -> None:
    root = tmp_path / "corpus"
    generate_second(root, only=("F1_t03",), progress=False)
    vertices = np.load(root / "vertices_npy" / "F1_t03.npy").reshape(-1, 5875, 3)
    template = pickle.loads((root / "templates.pkl").read_bytes(), encoding="latin1")["F1"]  # noqa: S301 - made here
    recorded = vertices - template
    np.testing.assert_allclose(other_truth("F1_t03", 0).numpy(), recorded, atol=2e-6)
    other = other_truth("F1_t03", 3).numpy()
    assert other.shape == recorded.shape
    lips, upper = (
        np.array(re.findall(r"\d+", (root / "regions" / f"{name}.txt").read_text()), dtype=int)
        for name in ("lve", "fdd")
    )

    def share(region: np.ndarray) -> float:
        gap, own = other[:, region] - recorded[:, region], recorded[:, region]
        return float(np.square(gap).mean() / np.square(own - own.mean(0)).mean())

    assert share(lips) < 0.05 < 0.5 < share(upper)
    assert OtherTruths.samples

    clip = SimpleNamespace(name="F1_t03", identity="F1")
    data: Any = SimpleNamespace(
        prepare_data=lambda: None,
        setup=lambda stage: None,
        test_splits=("test_a",),
        clips=lambda split: [clip],
        corpus=SimpleNamespace(templates={"F1": template}),
    )
    write_truths(tmp_path / "truths", data, (3,))
    written = np.load(tmp_path / "truths" / "seed3" / "F1_t03.npy").reshape(other.shape)
    np.testing.assert_allclose(written, template + other, atol=1e-6)
