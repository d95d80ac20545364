"""ONNX Runtime for browsers: one pinned version of the npm registry, fetched once, and believed by its hashes only."""

from __future__ import annotations

import http.client
import io
import os
import tarfile
import urllib.request
import zlib
from collections.abc import Callable
from pathlib import Path

from facediff.errors import FaceDiffError, damaged
from facediff.utils.checksums import sha256
from facediff.utils.files import atomic_folder, cache_dir

VERSION = "1.22.0"
NAME = f"onnxruntime-web {VERSION}"
REGISTRY = "https://registry.npmjs.org"
"""Where npm packages come from; the variable ``npm_config_registry`` names a mirror, as it does for npm."""

LARGEST = 1 << 25
"""Bytes that are read of the package, and of each of its files: 20 MB and 22 MB at most."""

FILES = {
    "ort.wasm.min.mjs": "6ef726f355b791129f7ddf3f62e7877a16b9b777abe87004b8ab306e6b9cf265",
    "ort-wasm-simd-threaded.mjs": "30dd851d9c00622940500f71ddd2ff8820c5cb65270816080175b958705385a8",
    "ort-wasm-simd-threaded.wasm": "71aef04959c5c1b6de461b6538e2058e306610034a85aad2742d0c7fd4533fe4",
    "ort.webgpu.min.mjs": "e131e81c9324807e1e6f9103e8f8e936112827dcc9993cde9407a333b1f07ae0",
    "ort-wasm-simd-threaded.jsep.mjs": "1cbcba8f2c769c1eecbab66a1b1e55ef11704515bf4306373e3db3c37cf6dcd8",
    "ort-wasm-simd-threaded.jsep.wasm": "b45970d0632383a057c27ca5b660b216f8e00c17cf8db9f6207b5e4abc839368",
}
"""The files that a page needs, with their SHA-256: the first three for the processor, the others for WebGPU."""

PLACES = ("", "dist", "package/dist", "node_modules/onnxruntime-web/dist")
"""Where in a folder the files may lie."""

REMEDY = f"give the package of `npm pack onnxruntime-web@{VERSION}`, or a folder with its files, with --runtime"
UNREADABLE = OSError, EOFError, http.client.HTTPException, tarfile.TarError, zlib.error


def web_runtime(source: Path | None = None, *, say: Callable[[str], object] = lambda _: None) -> dict[str, Path]:
    """The files of ONNX Runtime for browsers, by name.

    Args:
        source: a folder that holds them, or npm's package of this version; if None they are taken from facediff's
            cache, and fetched from the npm registry the first time.
        say: called with a sentence before anything is fetched.
    """
    if source is not None and source.is_dir():
        if (files := _in_folder(source)) is None:
            raise FaceDiffError(f"--runtime {source}: holds no {NAME}, or files that were changed; {REMEDY}")
        return files
    cache = cache_dir() / f"onnxruntime-web-{VERSION}"
    if (source is None or source.is_file()) and (files := _in_folder(cache)) is not None:
        return files
    registry = os.environ.get("npm_config_registry") or REGISTRY  # noqa: SIM112 - npm's own name
    address = f"{registry.rstrip('/')}/onnxruntime-web/-/onnxruntime-web-{VERSION}.tgz"
    if source is None:
        say(f"fetching {NAME} (20 MB, once) from {address}")
    where, location = (address, address) if source is None else (f"--runtime {source}", source.resolve().as_uri())
    with atomic_folder(cache, replace=True) as staged, damaged(where, REMEDY, *UNREADABLE):
        with urllib.request.urlopen(location, timeout=30) as answer:  # noqa: S310 - believed by hashes, from anywhere
            content = io.BytesIO(answer.read(LARGEST))
        with tarfile.open(fileobj=content, mode="r:gz") as archive:
            for member in archive:
                name = member.name.removeprefix("package/dist/")
                stream = archive.extractfile(member) if name in FILES and member.isreg() else None
                if stream is not None:
                    (staged / name).write_bytes(stream.read(LARGEST))
        if _in_folder(staged) is None:
            raise ValueError(f"is not {NAME}")
    return {name: cache / name for name in FILES}


def _in_folder(folder: Path) -> dict[str, Path] | None:
    """The files in a folder; None if one is missing or another one."""
    for subfolder in PLACES:
        files = {name: folder / subfolder / name for name in FILES}
        if all(path.is_file() for path in files.values()):
            return files if all(sha256(path) == FILES[name] for name, path in files.items()) else None
    return None
