"""Every reader obeys the law of :mod:`tests.robustness.mutations` on a fixed seed; the long run is a command there."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import FrameType

import pytest

import facediff
from facediff.errors import FaceDiffError
from facediff.mesh import files as mesh_files
from facediff.speech import audio
from tests.robustness.mutations import EVIL, Law, mutate, run, small_world
from tests.robustness.readers import READERS

PACKAGE = Path(facediff.__file__).parent
DECODERS = {
    "json.loads",
    "json.load",
    "np.load",
    "yaml.safe_load",
    "yaml.load",
    "h5py.File",
    "av.open",
    "soundfile.read",
    "soundfile.SoundFile",
    "torch.load",
    "csv.reader",
    "csv.DictReader",
    "load_json",
    "parse_json",
    "load_pickle",
    "open_array",
    "read_arrays",
    "read_text",
    "read_bytes",
}
NOT_FROM_ELSEWHERE = {
    "facediff/synthetic/speakers.py": "part of the package",
    "facediff/study/texts.py": "part of the package",
    "facediff/study/page.py": "part of the package",
    "facediff/study/store.py": "what the server has checked and stored itself",
    "facediff/utils/server.py": "hands bodies over to the reader of answers",
    "facediff/speech/espeak.py": "the answer of a process of our own",
    "facediff/synthetic/voices.py": "the answer of a synthesiser that was started for it",
    "facediff/export/viewer/page.py": "part of the package",
    "facediff/registry.py": "part of the package",
    "facediff/data/augmentation.py": "what it has just encoded itself",
    "facediff/cli": "hands files over to the readers of other packages",
    "facediff/pipelines": "hands files over to the readers of other packages",
    "facediff/render": "writes",
    "facediff/models/styles.py:given_face": "hands files over to the readers of meshes and arrays",
    "facediff/models/published/importing.py:read_value": "a word of the command line",
    "facediff/utils/cluster.py:slurm_options": "a word of the command line",
    "facediff/benchmark/published.py": "part of the package",
    "facediff/benchmark/running.py": "what a command of our own has just written",
    "facediff/benchmark/writing.py:replace_block": "a page of text, which is not decoded",
    "facediff/export/glb_to_fbx.py": "runs in Blender, on a file of our own",
    "facediff/export/viewer/channels.py": "what the page's own animation holds",
    "facediff/export/viewer/posing.py": "likewise",
    "facediff/callbacks": "the log of a run of our own, which the fault drill covers",
    "facediff/data/prepare": "hands files over to readers that have entries, or to the command drilled as a whole",
    "facediff/data/person": "likewise",
    "facediff/evaluation": "likewise",
}
"""Modules whose functions need no entry, and why."""
TAKES_LONG = ("hubert", "config", "m4a", "mov", "mkv", "webm", "avi", "aac")
"""Readers that reach no function of their own and are slow where every call is traced."""


def decoding_functions() -> set[str]:
    """``module.py:function`` of all functions that call a decoder of files."""
    found = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE.parent).as_posix()
        if any(name.startswith(each) for each in NOT_FROM_ELSEWHERE):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef):
                continue
            for call in ast.walk(node):
                if isinstance(call, ast.Call):
                    words = ast.unparse(call.func)
                    if words in DECODERS or words.rpartition(".")[2] in ("read_text", "read_bytes"):
                        found.add(f"{name}:{node.name}")
    return found - NOT_FROM_ELSEWHERE.keys()


@pytest.mark.parametrize("count", [3, pytest.param(10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_read_or_refused_in_one_sentence(name: str, count: int, tmp_path: Path) -> None:
    law = run(name, count, 1, tmp_path)
    assert law.broken == []
    assert sum(law.counts.values()) >= 3


@pytest.mark.slow
def test_every_function_that_decodes_files_is_reached_by_a_reader(tmp_path: Path) -> None:
    reached: set[str] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        path = frame.f_code.co_filename
        if path.startswith(str(PACKAGE)):
            reached.add(f"{Path(path).relative_to(PACKAGE.parent).as_posix()}:{frame.f_code.co_name}")

    for name, reader in READERS.items():
        if name.startswith(TAKES_LONG):
            continue
        for turn in ("imports what it needs", "is traced"):
            folder = tmp_path / turn / name.replace("/", " ")
            folder.mkdir(parents=True)
            path = folder / f"file{reader.suffix}"
            reader.write(path)
            sys.settrace(note if turn == "is traced" else None)
            try:
                reader.read(path)
            finally:
                sys.settrace(None)
    missed = decoding_functions() - reached
    assert not missed, f"add readers to tests/robustness/readers.py that reach {sorted(missed)}"


def test_every_suffix_of_speech_and_of_meshes_has_a_reader() -> None:
    assert {reader.suffix for reader in READERS.values()} >= {*audio.SUFFIXES, *audio.CONTAINERS, *mesh_files.SUFFIXES}


def test_the_modules_without_entries_exist() -> None:
    assert all((PACKAGE.parent / name.partition(":")[0]).exists() for name in NOT_FROM_ELSEWHERE)


def leave(path: Path) -> None:
    (path.parent.parent / "somewhere").write_text("left")


def take(path: Path) -> int:
    return len(bytearray(2**30))


def fail(path: Path) -> None:
    raise KeyError("vertices")


@pytest.mark.parametrize(("read", "named"), [(leave, "left"), (take, "took"), (fail, "KeyError"), (int, "TypeError")])
def test_the_law_is_not_blind(read: object, named: str, tmp_path: Path) -> None:
    law = Law()
    with small_world(tmp_path) as work:
        (work / "place").mkdir()
        (work / "place" / "file").touch()
        law.check("broken", read, work / "place" / "file", "whole")  # type: ignore[arg-type]
    assert len(law.broken) == 1
    assert named in law.broken[0]


def test_an_import_breaks_the_law(tmp_path: Path) -> None:
    law = Law()
    with small_world(tmp_path) as work:
        (work / "place").mkdir()
        law.check("broken", lambda _: __import__(EVIL), work / "place" / "file", "whole")
    sys.modules.pop(EVIL)
    assert EVIL in law.broken[0]


def test_damage_is_the_same_for_the_same_seed() -> None:
    import random

    data = bytes(range(256)) * 4
    first, second = ([mutate(data, rng, ".bin") for _ in range(20)] for rng in (random.Random(3), random.Random(3)))  # noqa: S311
    assert first == second
    assert sum(body != data for _, body in first) > 15


def test_a_message_quotes_no_megabytes() -> None:
    error = FaceDiffError(f"face.obj: cannot be read ({'x' * 10**6}); export it again")
    assert len(str(error)) <= 1400
    assert str(error).startswith("face.obj: ")
    assert str(error).endswith("export it again")


def test_a_name_that_is_too_long_is_refused() -> None:
    with pytest.raises(FaceDiffError, match=r"too long"):
        mesh_files.read_mesh(Path("a" * 3000 + ".obj"))


PLANS = ("plan", "direction, json", "direction, csv")


@pytest.mark.parametrize("count", [15, pytest.param(700, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])])
@pytest.mark.parametrize("name", PLANS)
def test_mutated_plans_and_directions_are_read_or_refused(name: str, count: int, tmp_path: Path) -> None:
    law = run(name, count, 34, tmp_path)
    assert law.broken == []
    assert law.counts["refused"] > count / 4
