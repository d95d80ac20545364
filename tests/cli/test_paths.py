"""Inputs and outputs of every command: declared, checked before any work, and never one and the same file."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, get_origin

import pytest

from facediff.cli.app import COMMANDS, load
from facediff.cli.data import CORPORA, options_of
from facediff.cli.options import FileOrList, Folder, Map, Output
from facediff.cli.parsing import Parameters, check_paths, flat, parameters_of, parse
from facediff.errors import FaceDiffError
from facediff.utils.files import atomic, atomic_folder, put_in_place
from facediff.utils.option import Option
from facediff.utils.output_paths import reading

# Its outputs lie in folders of runs with numbers of their own, and `--ckpt_path last` replaces what it reads.
LIGHTNING = {"fit", "validate", "test", "predict"}

NO_PATHS = (
    "accelerator acting augmentation audio_encoder baseline by clip clips condition corpus dataset device "
    "expressiveness expressivity face file_unit font guidance host identities identity kind labels languages layout "
    "licence license metric microphone name option output_unit part pattern phonemes protocol push region sampler "
    "scalar scheduler sound split splits subjects suffix to topology truth_layout truth_pattern unit "
    "voice_gate"
)
"""Texts that are no paths; a new option of type text either joins them or declares that it is read or written."""


def commands() -> Iterator[tuple[str, Parameters]]:
    for name in COMMANDS:
        function = load(name)
        if function.__name__ not in ("run", "lightning"):
            yield name, parameters_of(function)
    for corpus in CORPORA:
        plan = importlib.import_module(f"facediff.data.prepare.{corpus}").plan
        yield f"data prepare {corpus}", options_of(plan)


OWN = dict(commands())
DECLARED = {(name, parameter.name): parameter for name, parameters in OWN.items() for parameter in flat(parameters)}


def test_every_command_is_known_here() -> None:
    assert set(COMMANDS) == {*(n for n in OWN if "prepare" not in n), "data prepare", *LIGHTNING}


def test_every_path_declares_whether_it_is_read_or_written() -> None:
    for key, parameter in DECLARED.items():
        option = parameter.option
        if parameter.is_path and not key[0].startswith("data prepare"):  # what a plan takes is read
            assert option.reads or option.writes, key
        if parameter.value_type is str and get_origin(parameter.value_type) is not Literal:
            assert parameter.name in NO_PATHS.split() or option.reads or option.writes, key


def test_every_command_writes_somewhere_or_prints() -> None:
    printing = {name for name, parameters in OWN.items() if not any(p.option.writes for p in flat(parameters))}
    assert printing == {"data check", "components", "check-install", "live"}  # the receivers of the last write


WRITING = [key for key, parameter in DECLARED.items() if parameter.option.writes and not parameter.option.reads]
READING = [key for key, p in DECLARED.items() if p.option.reads or (p.is_path and not p.option.writes)]


def typed(name: str, parameter: str, path: Path) -> object:
    """A path as the parser gives it."""
    declared = DECLARED[name, parameter]
    value = path if declared.is_path else str(path)
    return [value] if declared.is_list else value


def suffix_of(name: str, parameter: str) -> str:
    return next(iter(DECLARED[name, parameter].option.suffixes), ".bin")


@pytest.mark.parametrize("name", sorted({name for name, _ in WRITING}))
def test_an_output_that_is_an_input_is_refused_and_stays(name: str, tmp_path: Path) -> None:
    """Under the same name, another one, or through a link."""
    for target in (target for other, target in WRITING if other == name):
        file = tmp_path / f"precious{suffix_of(name, target)}"
        file.write_text("precious")
        link = file.with_stem("soft")
        link.symlink_to(file)
        for source in (source for other, source in READING if other == name):
            for output in (file, tmp_path / ".." / tmp_path.name / file.name, link):
                with pytest.raises(FaceDiffError) as caught, reading():
                    check_paths(
                        flat(OWN[name]), {source: typed(name, source, file), target: typed(name, target, output)}
                    )
                assert str(tmp_path) in str(caught.value)
        assert file.read_text() == "precious"
        link.unlink()
        file.unlink()
    assert not list(tmp_path.iterdir())


def test_an_output_that_cannot_be_written_is_refused_by_its_option(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    long = "x" * 300
    for name, target in WRITING:
        for output in (tmp_path / "file" / "a", tmp_path / long, tmp_path / "new" / long / "a"):
            path = Path(f"{output}{suffix_of(name, target)}")
            with pytest.raises(FaceDiffError) as caught:
                check_paths(flat(OWN[name]), {target: typed(name, target, path)})
            assert str(output) in str(caught.value)
            assert target.replace("_", "-") in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_names_end_as_declared_and_what_is_read_is_there(tmp_path: Path) -> None:
    for (name, target), parameter in DECLARED.items():
        path = tmp_path / "nothing.xyz"
        if parameter.option.suffixes or parameter.option.exists:
            expected = "expected a name that ends in" if parameter.option.suffixes else "no such f"
            with pytest.raises(FaceDiffError, match=expected):
                check_paths(flat(OWN[name]), {target: typed(name, target, path)})


def test_options_name_options_of_their_command() -> None:
    for (name, _), parameter in DECLARED.items():
        others = {*parameter.option.needs.split(), *parameter.option.without.split()}
        assert others <= {p.name for p in flat(OWN[name])}, f"{name} {parameter.flag}"


def example(
    source: Annotated[Path, Option(reads=True)],
    *,
    method: FileOrList = None,
    folder: Folder = None,
    output: Output,
    second: Annotated[Path | None, Option(writes="file")] = None,
    correspondence: Map = None,
) -> None:
    """Nothing."""


def check(*words: object) -> None:
    with reading():
        parse(parameters_of(example), [str(word) for word in words], "facediff example")


def test_an_input_within_a_text_is_found(tmp_path: Path) -> None:
    file = tmp_path / "a.npy"
    file.touch()
    for text in (f"NAME={file}", f"{file}:0.3,x:0.7", f"x:0.3,{file}:0.7", f"{file}:lips", f"{file}>0.1"):
        with pytest.raises(FaceDiffError, match="would be overwritten, but this command reads"):
            check("x", "--method", text, "-o", file)


def test_two_outputs_are_two_files(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "a.csv")
    for other in (tmp_path / "a.csv", tmp_path / "link"):
        with pytest.raises(FaceDiffError, match="named for two outputs"):
            check("x", "-o", tmp_path / "a.csv", "--second", other)
    with pytest.raises(FaceDiffError, match="named for two outputs"):
        check("x", "-o", tmp_path / "a.npz", "--correspondence", tmp_path / "a.npz")


def test_data_of_a_folder_that_is_read_is_not_replaced_but_results_in_it_are(tmp_path: Path) -> None:
    for name in ("a.npy", "manifest.json", "scores.csv"):
        (tmp_path / name).touch()
    for name in ("a.npy", "manifest.json"):
        with pytest.raises(FaceDiffError, match="this command reads"):
            check("x", "--folder", tmp_path, "-o", tmp_path / name)
    check("x", "--folder", tmp_path, "-o", tmp_path / "scores.csv")
    check("x", "--folder", tmp_path, "-o", tmp_path / "new.npy")


def test_an_input_that_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in (tmp_path / "fifo", Path("/dev/zero"), Path("/dev/null"), tmp_path / ("x" * 300)):
        with pytest.raises(FaceDiffError) as caught:
            check(path, "-o", tmp_path / "out")
        assert str(path)[:40] in str(caught.value)


def test_an_empty_word_is_not_the_working_folder() -> None:
    for words in (["", "-o", "a"], ["a", "-o", ""], ["a", "--output="], ["a", "-oa", "--folder", ""]):
        with pytest.raises(FaceDiffError, match="expected a path"):
            check(*words)


def test_standard_output_is_named_only_where_it_is_meant() -> None:
    with pytest.raises(FaceDiffError, match="--output -"):
        check("x", "-o", "-")


def test_what_is_read_stays_under_every_later_name(tmp_path: Path) -> None:
    """Names that a command makes up by itself, such as those of further samples, are checked when they are written."""
    file = tmp_path / "folder" / "a.npy"
    file.parent.mkdir()
    file.write_text("precious")
    with reading([file]):
        with pytest.raises(FaceDiffError, match="this command reads"), atomic(file) as temporary:
            temporary.touch()
        (tmp_path / "new").touch()
        with pytest.raises(FaceDiffError, match="this command reads"):
            put_in_place(tmp_path / "new", file)
        with pytest.raises(FaceDiffError, match="this command reads"), atomic_folder(file.parent, replace=True):
            pass
    assert file.read_text() == "precious"
    with atomic(file) as temporary:
        temporary.write_text("new")
    assert file.read_text() == "new"
