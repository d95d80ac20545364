"""Two sources of chance: sentences and training runs; what evaluate says of folders whose training run is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.utils.provenance import Provenance, next_to, read_provenance
from tests.fakes.tiny import write_tiny


def predict(folder: Path, corpus: Path, moved: float, provenance: Provenance | None) -> Path:
    """A folder of predictions that are off by a constant, so that no interval of a difference contains 0."""
    folder.mkdir()
    for number in (1, 2, 3, 4):
        truth = np.load(corpus / "vertices_npy" / f"A_e{number:02d}.npy")
        np.save(folder / f"A_e{number:02d}_condition_A.npy", truth + np.float32(moved * (1 + number / 100)))
    if provenance is not None:
        provenance.write_next_to(folder)
    return folder


def run_of(seed: int, *, recipe: str = "same", steps: int = 10) -> Provenance:
    return Provenance("FaceFormer", {"audio_encoder": "mel"}, recipe, seed, steps, checkpoint=f"{recipe} {seed}")


@pytest.mark.parametrize(
    ("one", "other", "starred"),
    [
        (run_of(0), run_of(1), False),
        (run_of(0), run_of(1, recipe="another"), True),
        (run_of(0), run_of(1, steps=20), True),
        (None, None, True),
        (run_of(0), None, True),
    ],
)
def test_two_runs_of_one_method_get_no_star(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    one: Provenance | None,
    other: Provenance | None,
    starred: bool,
) -> None:
    corpus = write_tiny(tmp_path / "corpus")
    words = ["evaluate", str(predict(tmp_path / "a", corpus, 0.001, one)), str(corpus), "--quiet", "--bootstrap", "50"]
    words += ["--method", str(predict(tmp_path / "b", corpus, 0.003, other))]
    assert main(words) == 0
    printed = capsys.readouterr().out
    (row,) = [line for line in printed.splitlines() if line.startswith("b − a")]
    assert ("*" in row) == starred
    assert ("training runs of one method" in printed) == (not starred)
    assert main([*words, "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["comparisons"][0]["same_method"] == (not starred)
    assert found["methods"][0]["provenance"] == (None if one is None else json.loads(json.dumps(vars(one))))


def test_what_a_folder_says_of_itself_is_read_back_or_refused(tmp_path: Path) -> None:
    folder = tmp_path / "predictions"
    folder.mkdir()
    assert read_provenance(folder) is None
    run_of(3).write_next_to(folder)
    assert read_provenance(folder) == run_of(3)
    run_of(4).write(folder)
    assert read_provenance(folder) == run_of(4)
    assert run_of(3).columns() == {"seed": "3", "checkpoint": "same 3", "components": "FaceFormer audio_encoder=mel"}
    (folder / "provenance.json").unlink()
    for content in (
        "[]",
        "{}",
        '{"format": 9}',
        '{"format": 1, "model": 3}',
        '{"format": 1, "model": "a", "seed": "x"}',
    ):
        next_to(folder).write_text(content)
        with pytest.raises(FaceDiffError, match="provenance"):
            read_provenance(folder)
