"""Packed corpora at addresses: windows by requests for ranges, from every process."""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import fsspec
import pytest
import torch

from facediff.data.check import check
from facediff.data.packed.packing import pack
from facediff.data.packed.unpacking import unpack
from facediff.errors import FaceDiffError
from facediff.utils.checksums import describe_files
from tests.fakes.tiny import Tiny, write_tiny

TINY = "tests.fakes.tiny.Tiny"


class Ranges(http.server.SimpleHTTPRequestHandler):
    """Serves files, and ranges of them, as object storage does; counts the bytes of shards."""

    protocol_version = "HTTP/1.1"
    sent: list[tuple[str, int]] = []  # noqa: RUF012

    def do_GET(self) -> None:  # noqa: N802
        if self.path.startswith("/moved/"):
            self.send_response(302)
            self.send_header("Location", self.path.removeprefix("/moved"))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        self.close_connection = "hasty" in self.path  # without a word, as servers do that were idle for too long
        content, asked = path.read_bytes(), re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if asked:
            content = content[int(asked[1]) : int(asked[2]) + 1]
        self.sent.append((self.path, len(content)))
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *words: object) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder with a corpus, plain and packed, and its address."""
    root = tmp_path_factory.mktemp("served")
    pack(write_tiny(root / "corpus", sentences=4), root / "corpus.zarr", corpus=TINY, workers=1)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Ranges, directory=str(root))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield root, f"http://127.0.0.1:{server.server_address[1]}/corpus.zarr"
        server.shutdown()


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    Ranges.sent.clear()
    return tmp_path / "cache"


def test_an_address_is_read_as_the_folder_is(served: tuple[Path, str]) -> None:
    root, address = served
    near, far = Tiny(root=str(root / "corpus.zarr")), Tiny(root=address)
    for one, other in zip(near.dataset("train"), far.dataset("train"), strict=True):
        assert torch.equal(one.motion, other.motion)
        assert torch.equal(one.audio, other.audio)
    assert Ranges.sent
    assert far.root.is_dir()


def test_a_window_costs_its_chunks_only(served: tuple[Path, str]) -> None:
    corpus = Tiny(root=served[1]).corpus
    clip = corpus.clips["B_e04"]
    corpus.read_motion(clip, 0, 1)
    Ranges.sent.clear()
    corpus.read_motion(clip, 5, 15)
    shard = (served[0] / "corpus.zarr/motion_int16/c/0/0").stat().st_size
    ((path, size),) = Ranges.sent  # two chunks in one request
    assert path.endswith("motion_int16/c/0/0")
    assert size < shard / 5


@pytest.mark.parametrize("place", ["moved/corpus.zarr", "hasty.zarr", "corpus.zarr/"])
def test_servers_that_answer_otherwise(served: tuple[Path, str], place: str) -> None:
    root, address = served
    if not (root / "hasty.zarr").exists():
        (root / "hasty.zarr").symlink_to(root / "corpus.zarr")
    near, far = Tiny(root=str(root / "corpus.zarr")), Tiny(root=f"{address.rpartition('/')[0]}/{place}")
    for one, other in zip(near.dataset("train"), far.dataset("train"), strict=True):
        assert torch.equal(one.motion, other.motion)


def test_loader_processes_connect_for_themselves(served: tuple[Path, str]) -> None:
    options = {"batch_size": 3}
    near = list(Tiny(root=str(served[0] / "corpus.zarr"), **options).train_dataloader())
    data = Tiny(root=served[1], num_workers=2, **options)
    data.corpus.read_motion(data.clips("train")[0])  # connected before the fork
    for one, other in zip(near, data.train_dataloader(), strict=True):
        assert torch.equal(one.motion, other.motion)


def test_check_and_unpack_take_addresses(served: tuple[Path, str], tmp_path: Path) -> None:
    root, address = served
    report = check(address, TINY)
    assert report.sound
    assert report.state()["root"] == address
    unpack(address, tmp_path / "far", workers=1)
    unpack(root / "corpus.zarr", tmp_path / "near", workers=1)
    assert describe_files(tmp_path / "far") == describe_files(tmp_path / "near")


@pytest.mark.parametrize(
    "address", ["http://127.0.0.1:9/corpus.zarr", "nosuch://bucket/corpus.zarr", "jupyter://x", "/elsewhere"]
)
def test_what_cannot_be_reached_is_one_sentence(served: tuple[Path, str], address: str) -> None:
    address = served[1].rpartition("/")[0] + address if address.startswith("/") else address
    with pytest.raises(FaceDiffError, match=re.escape(address)):
        _ = Tiny(root=address).corpus


def test_an_object_that_is_cut_short_is_named(served: tuple[Path, str]) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(served[0] / "corpus.zarr"), "/cut/corpus.zarr", recursive=True)
    shard = "/cut/corpus.zarr/motion_int16/c/0/0"
    memory.pipe(shard, memory.cat_file(shard)[:-50])
    corpus = Tiny(root="memory://cut/corpus.zarr").corpus
    with pytest.raises(FaceDiffError, match="memory://cut/corpus.zarr/motion_int16"):
        corpus.read_motion(corpus.clips["A_e01"])
