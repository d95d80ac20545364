"""Hostile files through the command line: a documented status, one sentence, and nothing half-written.

The telling cases of a catalogue of 241 over recordings of parameters, Audio2Face folders, avatars, imports and records.
"""

from __future__ import annotations

import json
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation, write_archive
from facediff.cli.app import main
from facediff.spaces.files import read_parameters, write_parameters
from tests.fakes import person
from tests.fakes.exported import write_exported
from tests.fakes.published_parameters import write_diffposetalk

Build = Callable[[Path], object]
TAKE = "data import-take {} take.wav --name A -o out"
RETARGET = "retarget ball.npz --target-mesh x.glb -o out.glb --quiet"


def take(change: Callable[[str], str | bytes]) -> Build:
    """A recording of Live Link Face, changed as a text."""

    def build(folder: Path) -> None:
        changed = change((folder / "take.csv").read_text())
        (folder / "x.csv").write_bytes(changed if isinstance(changed, bytes) else changed.encode())

    return build


def weights(change: Callable[[dict[str, Any]], object]) -> Build:
    """The same as BEAT's json, changed as data or replaced by a text."""

    def build(folder: Path) -> None:
        write_parameters(folder / "x.json", read_parameters(folder / "take.csv"))
        content = json.loads((folder / "x.json").read_text())
        text = change(content)
        (folder / "x.json").write_text(text if isinstance(text, str) else json.dumps(content))

    return build


def avatar(change: Callable[[dict[str, Any]], object]) -> Build:
    """A mesh as .glb whose description is changed."""

    def build(folder: Path) -> None:
        data = trimesh.creation.icosphere(subdivisions=1).export(file_type="glb")
        (size,) = struct.unpack_from("<I", data, 12)
        content = json.loads(data[20 : 20 + size])
        change(content)
        text = json.dumps(content).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<I4s", len(text), b"JSON") + text + data[20 + size :]
        (folder / "x.glb").write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)

    return build


def coefficients(**arrays: Any) -> Build:  # noqa: ANN401
    """A corpus of one clip of FLAME's coefficients."""

    def build(folder: Path) -> None:
        (folder / "clips").mkdir()
        (folder / "clips" / "a_01.wav").write_bytes((folder / "take.wav").read_bytes())
        np.savez(folder / "clips" / "a_01.npz", **arrays)

    return build


def backwards(text: str) -> str:
    header, *rows = text.splitlines()
    return "\n".join([header, *reversed(rows)])


def statistics(**arrays: Any) -> Build:  # noqa: ANN401
    """DiffPoseTalk's files with other statistics."""

    def build(folder: Path) -> None:
        write_diffposetalk(folder, head=False)
        np.savez(folder / "stats.npz", **arrays)

    return build


def declares(size: int) -> Build:
    """A checkpoint of some hundred bytes whose pickle asks for ``size`` bytes."""

    def build(folder: Path) -> None:
        with zipfile.ZipFile(folder / "x.ckpt", "w") as archive:
            archive.writestr("archive/data.pkl", b"\x80\x05\x96" + struct.pack("<Q", size) + b"a.")
            archive.writestr("archive/version", "3\n")

    return build


def without_licences(folder: Path) -> None:
    write_exported(folder / "exported")
    content = json.loads((folder / "exported" / "model.json").read_text())
    content["licences"] = {}
    (folder / "exported" / "model.json").write_text(json.dumps(content))


def chain(content: dict[str, Any]) -> None:
    content["nodes"] = [{"children": [number + 1]} for number in range(20_000)] + [{"mesh": 2**40}]
    content["scenes"] = [{"nodes": [0]}]


CHECK = "data check clips --corpus flame_clips:flame_diffposetalk --quiet --workers 1"
IMPORT = "import-checkpoint iter_0110000.pt iter_0026000.pt --statistics stats.npz -o out.ckpt"
CASES: dict[str, tuple[str, Build, int]] = {
    "take, UTF-16": (TAKE.format("x.csv"), take(lambda text: text.encode("utf-16")), 2),
    "take, NaN": (TAKE.format("x.csv"), take(lambda text: text.replace("0.3", "nan")), 2),
    "take, backwards": (TAKE.format("x.csv"), take(backwards), 2),
    "take, a cell of 5 MB": (TAKE.format("x.csv"), take(lambda _: '"' + "a" * 5_000_000), 2),
    "take, links to itself": (TAKE.format("x.csv"), lambda folder: (folder / "x.csv").symlink_to("x.csv"), 2),
    "take, a device": (TAKE.format("x.csv"), lambda folder: (folder / "x.csv").symlink_to("/dev/zero"), 2),
    "take, a path as name": (TAKE.format("take.csv").replace("A", "../../x"), lambda _: None, 2),
    "json, nested": (TAKE.format("x.json"), weights(lambda _: "[" * 200_000), 2),
    "json, 5000 digits": (TAKE.format("x.json"), weights(lambda c: json.dumps(c).replace("0.3", "9" * 5000, 1)), 2),
    "json, surrogates": (TAKE.format("x.json"), weights(lambda content: content.update(names=["\ud800"] * 52)), 2),
    "json, rate": (TAKE.format("x.json"), weights(lambda content: content.update(metadata={"fps": -30})), 2),
    "FLAME, objects": (CHECK, coefficients(exp=np.array([{}], object)), 1),
    "FLAME, complex": (CHECK, coefficients(exp=np.zeros((9, 50), complex), pose=np.zeros((9, 6))), 1),
    "glb, count": (RETARGET, avatar(lambda content: content["accessors"][0].update(count=2**31)), 2),
    "glb, cycle": (RETARGET, avatar(lambda content: content.update(nodes=[{"children": [0], "mesh": 0}])), 2),
    "glb, chain of nodes": (RETARGET, avatar(chain), 2),
    "glb, part": (RETARGET + " --part nothing", avatar(lambda _: None), 2),
    "statistics, none": (IMPORT, statistics(other=np.zeros(3)), 2),
    "statistics, texts": (IMPORT, statistics(exp_mean=np.array(["x"])), 2),
    "checkpoint, declared size": ("import-checkpoint x.ckpt -o out.ckpt", declares(2**33), 2),
    "exported, no licence": ("animate take.wav --checkpoint exported -o out.npy --quiet", without_licences, 0),
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a recording, its sound and a motion."""
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    work = tmp_path / "work"
    work.mkdir()
    person.write_take(work / "take.csv", 1.0)
    person.write_speech(work / "take.wav", 1.0)
    ball = trimesh.creation.icosphere(subdivisions=1)
    rest = np.asarray(ball.vertices, np.float32)
    write_archive(
        work / "ball.npz", Animation("ball", rest[None].repeat(3, 0), rest, 25.0, faces=np.asarray(ball.faces))
    )
    monkeypatch.chdir(work)
    return work


@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_meets_a_status_and_one_sentence(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, build, status = CASES[name]
    build(folder)
    before, begin = set(folder.rglob("*")), time.process_time()
    assert main(words.split()) == status
    said = capsys.readouterr()
    assert said.err.count("error: ") == (status == 2), said.err
    assert "Traceback" not in said.err
    assert status == 0 or set(folder.rglob("*")) == before
    assert time.process_time() - begin < 15
