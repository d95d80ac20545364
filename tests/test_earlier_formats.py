"""What earlier versions wrote is read, and moves as it did then.

The archives of ``formats/`` hold what the versions in their names wrote of the miniature corpus ``tests.fakes.tiny``:
a checkpoint, and from 0.2 on a model folder and an exported folder of the same model (``tests.fakes.formats`` wrote
them). ``animation.npz`` is what that version's ``facediff animate docs/examples/question.wav`` gave.
"""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest

import facediff
from tests.fakes.tiny import Tiny

ROOT = Path(__file__).parents[1]
RECORDING = ROOT / "docs" / "examples" / "question.wav"
STYLES = {"tiny.ckpt": "A_e01", "folder": "A_e01", "exported": "A"}  # an exported folder keeps one for each identity
WRITTEN = [
    ("0.1", "tiny.ckpt", "A_e01", "off"),  # which had no voice gate
    *((version, *kind, "energy") for version in ("0.2", "1.0", "1.1", "2.0") for kind in STYLES.items()),
]


@pytest.fixture(scope="module")
def formats(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("formats")
    for archive in sorted((ROOT / "tests" / "formats").glob("*.tar.xz")):
        with tarfile.open(archive) as file:
            # Python 3.11.2, which Debian has, knows no filters yet; these archives are our own.
            filters = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
            file.extractall(folder / archive.name.removesuffix(".tar.xz"), **filters)  # noqa: S202
    return folder


@pytest.mark.parametrize(("version", "name", "style", "voice_gate"), WRITTEN)
def test_a_model_of_an_earlier_version_moves_as_it_did(
    formats: Path, version: str, name: str, style: str, voice_gate: str
) -> None:
    assert Tiny.corpus_name == "tiny"  # a checkpoint names its corpus, which has to be imported
    then = facediff.read(formats / version / "animation.npz")
    model = facediff.load(formats / version / name)
    now = model.animate(RECORDING, identity="A", style=style, seed=0, voice_gate=voice_gate)
    assert now.frame_rate == then.frame_rate
    extent = np.ptp(then.vertices, axis=0).max()
    assert np.abs(now.vertices - then.vertices).max() < 1e-4 * extent


def test_every_archive_is_tried(formats: Path) -> None:
    held = {(path.parent.name, path.name) for path in formats.glob("*/*") if path.name != "animation.npz"}
    assert held == {(version, name) for version, name, *_ in WRITTEN}
