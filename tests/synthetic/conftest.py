"""A few clips of the built-in corpus, made once."""

from pathlib import Path

import pytest

from facediff.synthetic.corpus import generate

CLIPS = ("F1_e01", "F1_e02", "F1_e03", "M3_e01", "F4_e05")


@pytest.fixture(scope="session")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("espeakng_loader")
    root = tmp_path_factory.mktemp("puppet") / "corpus"
    generate(root, only=CLIPS, progress=False)
    return root
