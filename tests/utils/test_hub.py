"""Models on the hub: sent to a fake one on the loopback, fetched from it, and found again without network."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.utils.hub import (
    ASSETS,
    CARD,
    CONFIG,
    WEIGHTS,
    check_model_source,
    hub_id,
    model_files,
    model_hash,
    model_name,
)
from tests.fakes.hub import FakeHub, Repository, fake_hub

TRY = """
import json, os, sys
from pathlib import Path
from facediff.errors import FaceDiffError
from facediff.utils import hub
for function, *words in json.loads(sys.argv[1]):
    try:
        found = hub.push(Path(words[0]), words[1]) if function == "push" else hub.fetch(*words)
        print(json.dumps(["done", str(found)]))
    except FaceDiffError as error:
        print(json.dumps(["error", str(error)]))
"""
CARD_TEXT = b"---\nlicense: mit\n---\n# A face\n"


def attempts(hub_address: str, home: Path, *calls: list[str], **environment: str) -> list[list[str]]:
    """What comes of calls in a process of their own, since the hub's library reads its environment when imported."""
    settings = {
        "HF_ENDPOINT": hub_address, "HF_HOME": str(home), "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_ETAG_TIMEOUT": "2",
    }  # fmt: skip
    kept = {name: value for name, value in os.environ.items() if not name.startswith("HF_")}
    done = subprocess.run(
        [sys.executable, "-c", TRY, json.dumps(calls)],
        env={**kept, **settings, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture
def hub() -> Iterator[FakeHub]:
    with fake_hub() as found:
        yield found


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "model"
    made.mkdir()
    for name in (CONFIG, WEIGHTS, ASSETS, "training_notes.txt"):
        (made / name).write_bytes(name.encode())
    (made / CARD).write_bytes(CARD_TEXT)
    return made


def test_a_model_goes_to_the_hub_and_comes_back_and_stays(hub: FakeHub, folder: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    sent, fetched, absent, unknown = attempts(
        hub.address,
        home,
        ["push", str(folder), "ada/face"],
        ["fetch", "ada/face"],
        ["fetch", "ada/face", "v9"],
        ["fetch", "bob/nothing"],
        HF_TOKEN=hub.token,
    )
    assert sent == ["done", f"{hub.address}/ada/face"]
    assert hub.models["ada/face"].commits[-1][1].keys() == {".gitattributes", CONFIG, WEIGHTS, ASSETS, CARD}
    assert hub.cards == [CARD_TEXT.decode()]
    assert fetched[0] == "done"
    for name in (CONFIG, WEIGHTS, ASSETS, CARD):
        assert (Path(fetched[1]) / name).read_bytes() == (folder / name).read_bytes()
    assert absent[0] == unknown[0] == "error"
    assert "ada/face@v9" in absent[1]
    assert "revision" in absent[1]
    assert "bob/nothing" in unknown[1]
    # The cache has it where nobody answers, and where nobody may be asked.
    asked = len(hub.asked)
    offline = attempts(hub.address, home, ["fetch", "ada/face"], ["fetch", "eva/face"], HF_HUB_OFFLINE="1")
    assert len(hub.asked) == asked
    assert offline[0] == fetched
    assert offline[1][0] == "error"
    assert "HF_HUB_OFFLINE" in offline[1][1]
    nobody = attempts("http://127.0.0.1:9", home, ["fetch", "ada/face"], ["fetch", "eva/face"])
    assert nobody[0] == fetched
    assert nobody[1][0] == "error"


def test_what_the_hub_refuses_is_said_with_the_models_name(hub: FakeHub, folder: Path, tmp_path: Path) -> None:
    hub.models["ada/other"] = Repository()
    hub.models["ada/other"].commit({"pytorch_model.bin": b"x"})
    hub.models["ada/gated"] = Repository(gated=True)
    hub.models["ada/gated"].commit({CONFIG: b"{}"})
    other, gated, sent = attempts(
        hub.address,
        tmp_path / "home",
        ["fetch", "ada/other"],
        ["fetch", "ada/gated"],
        ["push", str(folder), "ada/face"],
        HF_TOKEN="hf_wrong",  # noqa: S106 - no account
    )
    for (status, text), words in ((other, ["ada/other", CONFIG]), (gated, ["ada/gated"]), (sent, ["ada/face"])):
        assert status == "error"
        assert all(word in text for word in [*words]), text
        assert "\n" not in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ada/face", ("ada/face", None)),
        ("ada/face@v1.0", ("ada/face", "v1.0")),
        ("ada/face@refs/pr/1", ("ada/face", "refs/pr/1")),
        ("demo/puppet.ckpt", None),
        ("./ada/face", None),
        ("/ada/face", None),
        ("~/face", None),
        ("ada", None),
        ("a/b/c", None),
        ("../face", None),
        ("ada/face@", None),
        ("http://ada/face", None),
    ],
)
def test_only_names_of_the_hub_are_taken_for_such(text: str, expected: object) -> None:
    assert hub_id(text) == expected


def test_a_path_of_this_machine_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ada").mkdir()
    folder.rename(tmp_path / "ada" / "face")
    assert hub_id("ada/face") is None
    check_model_source("ada/face")
    assert model_files("ada/face") == [Path("ada/face") / name for name in (CONFIG, WEIGHTS, ASSETS)]
    assert model_name("ada/face") == "face"
    assert model_name("eva/face@v1") == "eva/face@v1"
    (tmp_path / "ada" / "face" / WEIGHTS).unlink()
    with pytest.raises(FaceDiffError, match=WEIGHTS):
        check_model_source("ada/face", "--checkpoint")


def test_a_models_hash_is_of_what_it_makes_and_not_of_its_card(tmp_path: Path) -> None:
    (tmp_path / "model.ckpt").write_bytes(b"abc")  # the digest of FIPS 180-2, appendix B.1
    assert model_hash(tmp_path / "model.ckpt").startswith("ba7816bf8f01cfea")
    folder = tmp_path / "published"
    folder.mkdir()
    for name in (CONFIG, WEIGHTS, ASSETS, CARD):
        (folder / name).write_bytes(name.encode())
    first = model_hash(folder)
    assert len(first) == 64
    (folder / CARD).write_bytes(CARD_TEXT)
    assert model_hash(folder) == first
    for name in (CONFIG, WEIGHTS, ASSETS):
        (folder / name).write_bytes(b"changed")
        assert model_hash(folder) != first
        (folder / name).write_bytes(name.encode())
    assert model_hash(folder) == first
