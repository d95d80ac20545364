"""Names of files: the user's home in words, configs, options and outputs, and either form of Unicode."""

from __future__ import annotations

import pickle
import shutil
import unicodedata
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import soundfile

import facediff
from facediff.cli.app import main
from facediff.cli.configs import with_files
from facediff.data.corpus import load_template_dict
from facediff.evaluation.file_pairs import TRUTH_PATTERN, NamePattern, index_truths, list_names, pair_up
from facediff.utils.files import atomic, atomic_folder, check_writable
from facediff.utils.paths import from_home
from tests.fakes.tiny import Tiny


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty home, and a working folder in which none of that name may appear."""
    folder, work = tmp_path / "home", tmp_path / "work"
    folder.mkdir()
    work.mkdir()
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.chdir(work)
    return folder


@pytest.fixture
def speech(home: Path) -> Path:
    soundfile.write(home / "s.wav", 0.3 * np.sin(np.arange(6400) / 7) * (np.arange(6400) < 4000), 16_000)
    return home / "s.wav"


def test_words_and_configs_name_the_home(home: Path) -> None:
    expected = {
        "~/a": "/a",
        "x=~/a": "x=/a",
        "~/a.npy:0.3,~/b.npy:0.7": "/a.npy:0.3,/b.npy:0.7",
        "--o=~/c.npz": "--o=/c.npz",
    }
    for word, path in expected.items():
        assert from_home(word) == path.replace("/", f"{home}/")
    for word in ("a~/b", "~", "x ~/y", "~no-such-user/here", "a=b~"):
        assert from_home(word) == (str(home) if word == "~" else word)
    config = with_files({"data": {"root": "~/c"}, "trainer": {"callbacks": [{"init_args": {"folder": "~/d"}}]}})
    assert config == {
        "data": {"root": f"{home}/c"},
        "trainer": {"callbacks": [{"init_args": {"folder": f"{home}/d"}}]},
    }


def test_the_command_line_reads_and_writes_in_the_home(speech: Path, home: Path) -> None:
    assert main(["animate", "~/s.wav", "-o=~/new/o.npz", "--quiet"]) == 0
    assert (home / "new" / "o.npz").is_file()
    assert main(["export", "~/new/o.npz", "--output=~/o.csv"]) == 0
    assert (home / "o.csv").is_file()
    assert not list(Path.cwd().iterdir())


def test_python_reads_and_writes_in_the_home(speech: Path, home: Path) -> None:
    model = facediff.load()
    animation = model.animate("~/s.wav")
    assert animation.save("~/made/o.npz") == [home / "made" / "o.npz"]
    assert len(facediff.read("~/made/o.npz").vertices) == len(animation.vertices)
    assert animation.save(Path("~/o.csv"))[0] == home / "o.csv"
    assert facediff.read("~/o.csv").frame_rate == animation.frame_rate
    assert not list(Path.cwd().iterdir())


def test_nothing_writes_a_folder_of_that_name(home: Path) -> None:
    check_writable(Path("~/a.txt"))
    with atomic(Path("~/new/a.txt")) as temporary:
        temporary.write_text("a")
    with atomic_folder(Path("~/folder")) as folder:
        (folder / "a.txt").write_text("a")
    assert (home / "new" / "a.txt").read_text() == (home / "folder" / "a.txt").read_text() == "a"
    assert not list(Path.cwd().iterdir())


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC"), ("NFD", "NFD")])
def test_names_in_either_form_of_unicode_are_the_same(
    forms: tuple[Literal["NFC", "NFD"], Literal["NFC", "NFD"]], tiny_root: Path, tmp_path: Path
) -> None:
    def motion(name: str) -> str:
        return unicodedata.normalize(forms[0], name.replace("A", "Zoé"))

    def others(name: str) -> str:
        return unicodedata.normalize(forms[1], name.replace("A", "Zoé"))

    for file in [*tiny_root.rglob("*.npy"), *tiny_root.rglob("*.wav")]:
        new = tmp_path / "corpus" / file.parent.relative_to(tiny_root)
        new.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, new / (motion if file.suffix == ".npy" else others)(file.name))
    templates = {others(name): face for name, face in load_template_dict(tiny_root / "templates.pkl").items()}
    (tmp_path / "corpus" / "templates.pkl").write_bytes(pickle.dumps(templates))
    rows = [f"{others(path.stem)},calm" for path in tiny_root.glob("wav/*.wav")]
    (tmp_path / "corpus" / "clips.csv").write_text("\n".join(["clip,mood", *rows]), encoding="utf-8")
    data = Tiny(root=str(tmp_path / "corpus"), batch_size=2)
    original = Tiny(root=str(tiny_root), batch_size=2)
    assert len(data.corpus.clips) == len(original.corpus.clips)
    assert all(clip.attributes["mood"] == "calm" for clip in data.corpus.clips.values())
    for name, clip in data.corpus.clips.items():
        assert name == unicodedata.normalize("NFC", name)
        assert data.corpus.template(clip).shape[1] == 3
    predictions = tmp_path / "predictions"
    predictions.mkdir()
    for file in (tmp_path / "corpus" / "vertices_npy").iterdir():
        shutil.copy(file, predictions / unicodedata.normalize(forms[1], file.name))
    patterns = [NamePattern(TRUTH_PATTERN, [*templates])]
    truths = index_truths(list_names(tmp_path / "corpus" / "vertices_npy", patterns)[0])
    pairs, missing = pair_up(list_names(predictions, patterns)[0], truths, "own")
    assert len(pairs) == len(data.corpus.clips)
    assert not missing.without_prediction
    assert not missing.without_truth
