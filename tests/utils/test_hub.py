"""Models on the hub: sent there, fetched from it, and told from paths of this machine."""

from __future__ import annotations

import shutil
from pathlib import Path
from unittest.mock import Mock, create_autospec

import huggingface_hub
import pytest
from huggingface_hub.errors import HfHubHTTPError

from facediff.errors import FaceDiffError
from facediff.utils.hub import (
    ASSETS,
    CARD,
    CONFIG,
    WEIGHTS,
    check_model_source,
    fetch,
    hub_id,
    model_files,
    model_hash,
    model_name,
    push,
)

CARD_TEXT = b"---\nlicense: mit\n---\n# A face\n"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of models by name and revision behind the library's functions, with the parameters that they have."""
    root = tmp_path / "hub"

    def upload(repo_id: str, folder_path: Path, commit_message: str, allow_patterns: list[str]) -> None:
        made = shutil.copytree(folder_path, root / repo_id / "main")
        for path in made.iterdir():
            if path.name not in allow_patterns:
                path.unlink()

    def download(name: str, revision: str | None, allow_patterns: list[str], library_name: str) -> str:
        if not (root / name / (revision or "main")).is_dir():
            raise HfHubHTTPError(f"404 Client Error.\n\nRevision Not Found for {name}", response=Mock())
        assert set(allow_patterns) == {CONFIG, WEIGHTS, ASSETS, CARD}
        return str(root / name / (revision or "main"))

    api = create_autospec(huggingface_hub.HfApi)
    api.return_value.create_repo.side_effect = lambda name, private, exist_ok: f"https://hub/{name} {private}"
    api.return_value.upload_folder.side_effect = upload
    monkeypatch.setattr(huggingface_hub, "HfApi", api)
    library = create_autospec(huggingface_hub.snapshot_download, side_effect=download)
    monkeypatch.setattr(huggingface_hub, "snapshot_download", library)
    return root


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "model"
    made.mkdir()
    for name in (CONFIG, WEIGHTS, ASSETS, "training_notes.txt"):
        (made / name).write_bytes(name.encode())
    (made / CARD).write_bytes(CARD_TEXT)
    return made


def test_a_model_goes_to_the_hub_and_comes_back(hub: Path, folder: Path) -> None:
    assert push(folder, "ada/face", private=True) == "https://hub/ada/face True"
    fetched = fetch("ada/face")
    assert {path.name for path in fetched.iterdir()} == {CONFIG, WEIGHTS, ASSETS, CARD}
    shutil.copytree(fetched, hub / "ada/face/v1").joinpath(CONFIG).unlink()
    with pytest.raises(FaceDiffError, match=rf"ada/face@v1: .* no {CONFIG}, so"):
        fetch("ada/face", "v1")
    for call, name in (
        (lambda: fetch("ada/face", "v9"), "ada/face@v9"),
        (lambda: push(folder, "ada/face"), "ada/face"),
    ):
        with pytest.raises(FaceDiffError, match=f"^{name}: .*can it be") as refused:
            call()
        assert "\n" not in str(refused.value)


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
