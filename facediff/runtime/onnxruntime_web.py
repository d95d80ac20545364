"""ONNX Runtime for browsers: one pinned version of the npm registry, fetched once, and believed by its hashes only."""

from __future__ import annotations

import base64
import hashlib
import http.client
import io
import os
import tarfile
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.utils.checksums import sha256
from facediff.utils.files import atomic_folder, cache_dir
from facediff.utils.limits import brief

VERSION = "1.22.0"
NAME = f"onnxruntime-web {VERSION}"
REGISTRY = "https://registry.npmjs.org"
"""Where npm packages come from; the variable ``npm_config_registry`` names a mirror, as it does for npm."""

INTEGRITY = "sha512-Ud/+EBo6mhuaQWt/OjaOk0iNWjXqJoeeMFr6xQEERZdIZH2OWpGzuujz7lfuOBjUa6TEE/sc4nb7Da5dNL34fg=="
"""Hash of the package, as the registry and npm's lock files state it."""
SIZE = 20_387_966
"""Its bytes."""

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

LICENCE = """ONNX Runtime Web, https://github.com/microsoft/onnxruntime

MIT License

Copyright (c) Microsoft Corporation

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit
persons to whom the Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""

REMEDY = f"expected the package of `npm pack onnxruntime-web@{VERSION}`, or a folder with its files"


@dataclass(frozen=True)
class Package:
    """A package of npm by which a download is known."""

    address: str
    size: int
    integrity: str

    def check(self, name: str, content: bytes) -> bytes:
        """The content, if it is the package's."""
        integrity = f"sha512-{base64.b64encode(hashlib.sha512(content).digest()).decode('ascii')}"
        if len(content) != self.size or integrity != self.integrity:
            raise FaceDiffError(f"{name}: is not {NAME} (its size or hash differs); {REMEDY}")
        return content


def package() -> Package:
    """The pinned package, at the registry that the environment names."""
    registry = os.environ.get("npm_config_registry") or REGISTRY  # noqa: SIM112 - npm's own name
    if not registry.startswith(("https://", "http://")):
        raise FaceDiffError(f"npm_config_registry={registry}: is no address of a registry; expected https://…")
    address = f"{registry.rstrip('/')}/onnxruntime-web/-/onnxruntime-web-{VERSION}.tgz"
    return Package(address, SIZE, INTEGRITY)


def web_runtime(source: Path | None = None, *, say: Callable[[str], object] = lambda _: None) -> dict[str, Path]:
    """The files of ONNX Runtime for browsers, by name.

    Args:
        source: a folder that holds them, or npm's package of this version; if None they are taken from facediff's
            cache, and fetched from the npm registry the first time.
        say: called with a sentence before anything is fetched.
    """
    if source is not None and not source.exists():
        raise FaceDiffError(f"--runtime {source}: no such file or folder; {REMEDY}")
    if source is not None and source.is_dir():
        files = _in_folder(source)
        if files is None:
            raise FaceDiffError(f"--runtime {source}: holds no {NAME}, or files that were changed; {REMEDY}")
        return files
    content = b""
    if source is not None:
        with source.open("rb") as stream:
            content = package().check(f"--runtime {source}", stream.read(SIZE + 1))
    cache = cache_dir() / f"onnxruntime-web-{VERSION}"
    files = _in_folder(cache)
    if files is not None:
        return files
    content = content or _fetch(package(), say)
    with atomic_folder(cache, replace=True) as staged:
        for name, data in _unpacked(content).items():
            (staged / name).write_bytes(data)
    files = _in_folder(cache)
    if files is None:
        raise FaceDiffError(f"{cache}: cannot be read back as it was written; set FACEDIFF_CACHE to another folder")
    return files


def _in_folder(folder: Path) -> dict[str, Path] | None:
    """The files in a folder; None if one is missing or another one."""
    for subfolder in PLACES:
        files = {name: folder / subfolder / name for name in FILES}
        if all(path.is_file() for path in files.values()):
            return files if all(sha256(path) == FILES[name] for name, path in files.items()) else None
    return None


def _fetch(pinned: Package, say: Callable[[str], object]) -> bytes:
    say(f"fetching {NAME} ({pinned.size / 1e6:.0f} MB, once) from {pinned.address}")
    try:
        with urllib.request.urlopen(pinned.address, timeout=30) as answer:  # noqa: S310 - http or https, see package()
            content: bytes = answer.read(pinned.size + 1)
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise FaceDiffError(
            f"{pinned.address}: cannot be fetched ({brief(error)}); go online once, or run `npm pack "
            f"onnxruntime-web@{VERSION}` elsewhere and give the file with --runtime"
        ) from error
    return pinned.check(pinned.address, content)


def _unpacked(content: bytes) -> dict[str, bytes]:
    """The files of the package, whose hash has been checked."""
    files: dict[str, bytes] = {}
    with tarfile.open(fileobj=io.BytesIO(content), mode="r:gz") as archive:
        for member in archive:
            name = member.name.removeprefix("package/dist/")
            stream = archive.extractfile(member) if name in FILES and member.isreg() else None
            if stream is not None:
                files[name] = stream.read()
    return files
