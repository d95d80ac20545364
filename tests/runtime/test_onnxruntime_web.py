"""ONNX Runtime for browsers: fetched once, believed by its hashes only. No network: a registry in miniature answers."""

from __future__ import annotations

import hashlib
import io
import tarfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.runtime import onnxruntime_web
from facediff.runtime.onnxruntime_web import FILES, web_runtime

CONTENT = {"ort.mjs": b"export {}", "ort.wasm": b"\0asm"}


def packed(content: dict[str, bytes]) -> bytes:
    """The bytes of a package of npm with these files, and others that are not taken."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, data in {**content, "unneeded.js": b"x", "../../escape": b"x"}.items():
            entry = tarfile.TarInfo(f"package/dist/{name}")
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()


@pytest.fixture(autouse=True)
def package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> bytes:
    """A small package in the place of the pinned one, and a cache of its own; the package's bytes."""
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in CONTENT.items()}
    monkeypatch.setattr(onnxruntime_web, "FILES", hashes)
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("npm_config_registry", "http://127.0.0.1:9/")  # nobody answers there
    return packed(CONTENT)


class Registry:
    """Answers every request with the same bytes."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.begins = b"HTTP/1.0 200 OK\r\n\r\n"
        self.asked: list[str] = []
        registry = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                registry.asked.append(self.path)
                self.wfile.write(registry.begins + registry.content)

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()


@pytest.fixture
def registry(package: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    made = Registry(package)
    monkeypatch.setenv("npm_config_registry", made.address)
    yield made
    made.server.shutdown()
    made.server.server_close()


def content_of(found: dict[str, Path]) -> dict[str, bytes]:
    return {name: path.read_bytes() for name, path in found.items()}


def cached(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in (tmp_path / "cache").rglob("*") if path.is_file())


def test_package_is_fetched_once_and_only_its_files_are_unpacked(registry: Registry, tmp_path: Path) -> None:
    said: list[str] = []
    assert content_of(web_runtime(say=said.append)) == CONTENT
    assert len(said) == 1
    assert registry.address in said[0]
    assert content_of(web_runtime(say=said.append)) == CONTENT
    assert registry.asked == [f"/onnxruntime-web/-/onnxruntime-web-{onnxruntime_web.VERSION}.tgz"]
    assert cached(tmp_path) == sorted(CONTENT)
    assert not (tmp_path / "escape").exists()


def test_changed_file_of_the_cache_is_fetched_again(registry: Registry) -> None:
    web_runtime()["ort.mjs"].write_bytes(b"evil()")
    assert content_of(web_runtime()) == CONTENT
    assert len(registry.asked) == 2


@pytest.mark.parametrize("change", ["changed", "missing", "cut", "no package"])
def test_other_bytes_are_refused_and_nothing_is_kept(change: str, registry: Registry, tmp_path: Path) -> None:
    registry.content = {
        "changed": packed({**CONTENT, "ort.wasm": b"evil"}),
        "missing": packed({"ort.mjs": CONTENT["ort.mjs"]}),
        "cut": registry.content[:60],
        "no package": b"<html>",
    }[change]
    with pytest.raises(FaceDiffError, match=registry.address):
        web_runtime()
    assert cached(tmp_path) == []


def test_package_and_folders_serve_without_network(package: bytes, tmp_path: Path) -> None:
    (tmp_path / "own.tgz").write_bytes(package)
    found = web_runtime(tmp_path / "own.tgz")
    assert content_of(found) == CONTENT
    own = tmp_path / "project" / "node_modules" / "onnxruntime-web" / "dist"
    own.mkdir(parents=True)
    for name, data in CONTENT.items():
        (own / name).write_bytes(data)
    assert {path.parent for path in web_runtime(tmp_path / "project").values()} == {own}
    (own / "ort.mjs").write_bytes(b"another version")
    for wrong in (tmp_path / "project", tmp_path / "nowhere"):
        with pytest.raises(FaceDiffError, match=rf"--runtime {wrong}"):
            web_runtime(wrong)


def test_pinned_files_are_those_of_the_pinned_package(
    web_runtime_package: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.undo()
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    assert set(web_runtime(web_runtime_package)) == set(FILES)
