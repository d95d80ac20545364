"""Damaged checkpoints, model folders, exported folders and requests are read or refused in a sentence.

Nothing of a damaged file may run, and nothing may be written beside it. Longer: ``FACEDIFF_MUTATIONS=2000 pytest
tests/robustness/test_mutated_files.py``.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import sys
import tarfile
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.models import load_model
from facediff.runtime import RuntimeModel
from facediff.runtime.graph_check import check_graph
from facediff.study.definition import DATABASE, read_study
from facediff.study.server import make_app
from facediff.study.store import AnswerStore
from tests.fakes.serving import servers
from tests.fakes.study import small_study, write_study
from tests.fakes.tiny import Tiny

FORMATS = Path(__file__).parents[1] / "formats"
ROUNDS = int(os.environ.get("FACEDIFF_MUTATIONS", "40"))
WORDS = (b"null", b"-1", b"1e999", b"[]", b'"../../x"', b'"harmful.Class"', b"18446744073709551616", b'"\\u0000"')


def mutate(data: bytes, rng: random.Random) -> bytes:
    """Flipped bits, a cut, zeros, a repeated or moved part, or another word in the place of a number or text."""
    first, last = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    kind = rng.randrange(6)
    if kind == 0:
        changed = bytearray(data)
        for _ in range(rng.choice((1, 3, 30))):
            changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return bytes(changed)
    if kind == 1:
        return data[:first]
    if kind == 2:
        return data[:first] + bytes(last - first) + data[last:]
    if kind == 3:
        return data[:last] + data[first:]
    if kind == 4:
        return data[last:] + data[first:last] + data[:first]
    begin = next((i for i in range(first, len(data)) if data[i : i + 1] in b'0123456789"'), first)
    end = next((i for i in range(begin + 1, len(data)) if data[i : i + 1] in b',}]: "'), last)
    return data[:begin] + rng.choice(WORDS) + data[end:]


def check_mutations(
    load: Callable[[Path], object], path: Path, monkeypatch: pytest.MonkeyPatch, rounds: int = ROUNDS
) -> Counter[str]:
    """Mutate a file in its folder, and count the outcomes of loading it."""
    whole, world = path.read_bytes(), path.parents[1]
    work = world / "work"
    work.mkdir()
    (work / "harmful.py").write_text("open('harm', 'w').close()\nclass Class: ...\n")
    monkeypatch.chdir(work)
    monkeypatch.syspath_prepend(str(work))
    before, counts = set(world.rglob("*")), Counter[str]()
    for seed in range(rounds):
        path.write_bytes(mutate(whole, random.Random(f"{path.name} {seed}")))  # noqa: S311 - it must repeat
        try:
            load(path)
            counts["read"] += 1
            refusal = ""
        except FaceDiffError as error:
            counts["refused"] += 1
            refusal = str(error)
        except Exception as error:
            raise AssertionError(f"mutation {seed} of {path.name}: {error!r}") from error
        assert "\n" not in refusal.strip(), (seed, refusal)
        assert len(refusal) < 1500, seed
        assert set(world.rglob("*")) == before, seed
    assert "harmful" not in sys.modules
    return counts


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """A checkpoint, a model folder and an exported folder of one small model."""
    assert Tiny.corpus_name == "tiny"  # a checkpoint names its corpus, which has to be imported
    with tarfile.open(FORMATS / "1.1.tar.xz") as archive:
        archive.extractall(tmp_path / "models")  # noqa: S202 - our own
    return tmp_path / "models"


@pytest.mark.parametrize("name", ["tiny.ckpt", "folder/config.json", "folder/model.safetensors", "folder/assets.npz"])
def test_damaged_models_load_or_are_refused(name: str, models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = models if name == "tiny.ckpt" else models / "folder"
    counts = check_mutations(lambda path: load_model(path if folder == models else folder), models / name, monkeypatch)
    assert counts["refused"] > ROUNDS / 4


@pytest.mark.parametrize("name", ["model.json", "arrays.npz", "step.onnx"])
def test_damaged_exports_open_or_are_refused(name: str, models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = models / "exported"
    shutil.rmtree(models / "folder")
    # A damaged graph is not run: ONNX Runtime may take any time for it.
    load = (lambda path: check_graph(path)) if name == "step.onnx" else (lambda _: RuntimeModel.open(folder))
    counts = check_mutations(load, folder / name, monkeypatch)
    assert counts["refused"] > ROUNDS / 4


def test_a_server_goes_on_after_any_request(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "study", small_study(clips=3))
    study = read_study(folder)
    rater = "00112233445566778899aabbccddeeff"
    begin = {"study": study.id, "rater": rater, "language": "en", "code": "", "agreed": True}
    statuses = Counter[int]()
    with servers() as running:
        address, _ = running.start(make_app(folder, study, AnswerStore(folder / DATABASE, study)))
        for seed in range(ROUNDS):
            rng = random.Random(seed)  # noqa: S311 - it must repeat
            body = json.dumps(begin).encode() if not seed else mutate(json.dumps(begin).encode(), rng)
            place = "/api/raters" if not seed else rng.choice(("/api/raters", "/api/answers", "/api/finish"))
            request = urllib.request.Request(address + place, body, {"Content-Type": "application/json"})  # noqa: S310
            try:
                with urllib.request.urlopen(request, timeout=20) as response:  # noqa: S310 - our own server
                    statuses[response.status] += 1
            except urllib.error.HTTPError as error:
                with error:
                    statuses[error.code] += 1
        with urllib.request.urlopen(address, timeout=20) as response:  # noqa: S310 - our own server
            assert response.status == 200
    assert statuses[200] >= 1
    assert {status // 100 for status in statuses} <= {2, 4}, statuses
    assert statuses[400] > ROUNDS / 4
