"""The site of an exported model: what the server offers, to whom, and the folder that any server can offer."""

from __future__ import annotations

import gzip
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock
from urllib.parse import quote

import numpy as np
import pytest
import soundfile

from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.runtime import onnxruntime_web
from facediff.runtime.site import PAGE, Site, make_app, make_site, write_site
from facediff.utils.server import LOOPBACK
from tests.fakes.exported import write_exported
from tests.fakes.serving import ask, servers

Serve = Callable[[Site], str]


@pytest.fixture(scope="module")
def serve() -> Iterator[Serve]:
    """Serves a site on a free port, and gives the address without a slash at its end."""
    with servers() as running:
        yield lambda site: running.start(make_app(site, LOOPBACK))[0]


@pytest.fixture
def runtime(tmp_path: Path) -> dict[str, Path]:
    """Files in the place of ONNX Runtime's."""
    for name in ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.wasm"):
        (tmp_path / name).write_bytes(name.encode())
    return {name: tmp_path / name for name in ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.wasm")}


@pytest.fixture
def site(runtime: dict[str, Path], tmp_path: Path) -> Site:
    return make_site(write_exported(tmp_path / "<b>face"), runtime)


def test_every_file_is_offered_as_what_it_is_under_strict_headers(site: Site, serve: Serve) -> None:
    address = serve(site)
    kinds = {"": "text/html", "worker.js": "text/javascript", "onnxruntime/ort.wasm.min.mjs": "text/javascript"}
    kinds |= {"onnxruntime/ort-wasm-simd-threaded.wasm": "application/wasm", "model/model.json": "application/json"}
    for name, kind in kinds.items():
        status, headers, content = ask(f"{address}/{name}")
        assert (status, headers["content-type"].split(";")[0]) == (200, kind)
        # Both are needed for shared memory, without which WebAssembly has one thread.
        assert headers["cross-origin-opener-policy"] == "same-origin"
        assert headers["cross-origin-embedder-policy"] == "require-corp"
        wanted = site[name or "index.html"]
        assert content == (wanted if isinstance(wanted, bytes) else wanted.read_bytes())
        if name:
            assert "default-src 'none'" in headers["content-security-policy"]
    assert b"<b>face" not in ask(address)[2]


def test_files_come_compressed_and_are_not_sent_again(site: Site, serve: Serve) -> None:
    address = serve(site)
    status, headers, content = ask(f"{address}/worker.js", **{"Accept-Encoding": "gzip"})
    assert (status, headers["content-encoding"]) == (200, "gzip")
    assert gzip.decompress(content) == site["worker.js"]
    assert ask(f"{address}/worker.js", **{"If-None-Match": headers["etag"]})[0] == 304
    assert ask(f"{address}/worker.js", **{"If-None-Match": '"another"'})[0] == 200


def test_nothing_else_is_offered_and_no_other_page_may_ask(site: Site, serve: Serve) -> None:
    address = serve(site)
    for name in ("model/../../secret", "..%2f..%2fetc/passwd", "model/", "/etc/passwd", "model/notes.txt"):
        assert ask(f"{address}/{name}")[0] == 404
    assert ask(address, Host="evil.example")[0] == 403
    assert ask(address, Origin="http://evil.example")[0] == 403


def test_folder_holds_the_site(site: Site, tmp_path: Path) -> None:
    size = write_site(site, tmp_path / "out")
    found = {path.relative_to(tmp_path / "out").as_posix(): path for path in (tmp_path / "out").rglob("*.*")}
    assert set(found) | {"_headers"} == set(site)
    for name, path in found.items():
        content = site[name]
        assert path.read_bytes() == (content if isinstance(content, bytes) else content.read_bytes())
    assert size == sum(path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file())
    with pytest.raises(FaceDiffError, match="out"):
        write_site(site, tmp_path / "out")


def test_recordings_are_offered_by_their_names(runtime: dict[str, Path], serve: Serve, tmp_path: Path) -> None:
    face, examples = write_exported(tmp_path / "face"), [tmp_path / "good morning.wav", tmp_path / "ü.wav"]
    for path in examples:
        soundfile.write(path, np.sin(np.arange(8000) / 9) / 2, 16_000)
    site = make_site(face, runtime, examples)
    address = serve(site)
    [facts] = re.findall(r'id="facts">(.*?)</script>', ask(address)[2].decode())
    assert json.loads(facts)["recordings"] == ["good morning.wav", "ü.wav"]
    for path in examples:
        assert ask(f"{address}/recordings/{quote(path.name)}")[2] == path.read_bytes()
    (tmp_path / "other").mkdir()
    twin = tmp_path / "other" / "ü.wav"
    twin.write_bytes(examples[1].read_bytes())
    with pytest.raises(FaceDiffError, match=r"other/ü\.wav"):
        make_site(face, runtime, [*examples, twin])
    twin.write_bytes(b"no sound")
    with pytest.raises(FaceDiffError, match=r"other/ü\.wav"):
        make_site(face, runtime, [twin])


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no names that are no UTF-8")
def test_names_that_are_no_text_are_shown_as_far_as_they_are(runtime: dict[str, Path], tmp_path: Path) -> None:
    folder = write_exported(tmp_path / "fa\udcffce")
    soundfile.write(tmp_path / "hello.wav", np.sin(np.arange(8000) / 9) / 2, 16_000)
    site = make_site(folder, runtime, [(tmp_path / "hello.wav").rename(tmp_path / "hell\udcff.wav")])
    assert "<title>fa\ufffdce" in str(site[PAGE], "utf-8")  # type: ignore[arg-type]
    assert "recordings/hell\ufffd.wav" in site


def test_folder_that_is_interrupted_leaves_nothing(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.copyfile", mock.Mock(side_effect=KeyboardInterrupt))
    before = set(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        write_site(site, tmp_path / "out")
    assert set(tmp_path.iterdir()) == before


def test_command_writes_a_folder_and_says_errors_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(onnxruntime_web, "FILES", {})
    monkeypatch.chdir(tmp_path)
    write_exported(tmp_path / "face")
    assert main(["serve", "face", "-o", "site"]) == 0
    assert (tmp_path / "site" / "index.html").is_file()
    capsys.readouterr()
    for words, named in (
        (["face", "-o", "site"], "--output site"),
        (["missing"], "missing"),
        (["face", "--runtime", "nowhere.tgz"], "--runtime nowhere.tgz"),
        (["site"], "site/model.json"),
    ):
        assert main(["serve", *words]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert named in said
