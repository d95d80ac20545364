"""Packed corpora for the tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.data.packed.packing import pack
from facediff.utils.checksums import describe_files
from facediff.utils.plain_files import write_json
from tests.data.packed.damage import TINY
from tests.fakes.tiny import VERTICES, write_tiny


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("packed")
    pack(write_tiny(folder / "corpus", sentences=2), folder / "corpus.zarr", corpus=TINY, workers=1)
    return folder / "corpus.zarr"


@pytest.fixture(scope="session")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature corpus with a manifest, noise on its motion, and a clip that is longer than a chunk of speech."""
    root = write_tiny(tmp_path_factory.mktemp("packed") / "corpus", sentences=7)
    rng = np.random.default_rng(0)
    for path in sorted((root / "vertices_npy").glob("*.npy")):
        clip = np.load(path)
        np.save(path, (clip + rng.normal(0, 1e-4, clip.shape)).astype(np.float32))
    long = np.load(root / "vertices_npy" / "A_e01.npy")[:1] + rng.normal(0, 1e-3, (590, 3 * VERTICES))
    np.save(root / "vertices_npy" / "A_e01.npy", long.astype(np.float32))
    speech = (0.3 * np.sin(np.arange(590 * 640) / 30) * 32767).astype(np.int16)
    soundfile.write(root / "wav" / "A_e01.wav", speech, 16000, subtype="PCM_16")
    (root / "phonemes").mkdir()
    (root / "phonemes" / "A_e01.csv").write_text("start,end,ipa\n0,0.1,m\n")
    write_json(root / "manifest.json", {"format": 1, "unit": "m", "frame_rate": 25, "files": describe_files(root)})
    return root


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="session")
def packed(corpus: Path) -> Path:
    out = corpus.parent / "corpus.zarr"
    pack(corpus, out, corpus=TINY, exact="none", workers=1)
    return out
