"""What a packed corpus costs on disk, and how quickly its windows are read, against memory-mapped .npy files.

Run ``python tools/benchmarks/packed.py``: makes a corpus of BIWI's size (23 370 vertices, 25 frames a second) and packs
it. Its motion is that of the built-in corpus, each vertex a blend of two of its vertices, plus independent Gaussian
noise at every coordinate of every frame, as capture has it; ``--noise`` gives its deviations in millimetres, since the
size depends on them. Then random windows of 100 frames with their speech are read from both, turn by turn, in one
process:

- ``in memory``: all files lie in the page cache, as for a corpus that is smaller than the machine's memory.
- ``from disk``: every file's pages were given up before each window.
- ``over HTTP``: from a server of this machine that answers ranges, with nothing kept on disk.
"""

from __future__ import annotations

import argparse
import http.server
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

VERTICES = 23_370
RATE = 25
WINDOW = 100


def write_corpus(root: Path, source: Path, clips: int, noise: float) -> None:
    """A corpus in BIWI's layout, in metres."""
    import soundfile

    from facediff.data.corpus import read_templates
    from facediff.data.prepare.runner import write_templates
    from facediff.utils.plain_files import write_json

    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    templates = read_templates(source / "templates.pkl")
    count = len(next(iter(templates.values())))
    one = np.sort(rng.integers(0, count, VERTICES))
    share = rng.random((VERTICES, 1)).astype(np.float32)

    def blended(vertices: np.ndarray) -> np.ndarray:
        return share * vertices[..., one, :] + (1 - share) * vertices[..., (one + 1) % count, :]

    paths = sorted((source / "vertices_npy").glob("*.npy"))
    for number in range(clips):
        path = paths[number * 7 % len(paths)]
        motion = blended(np.load(path).reshape(-1, count, 3))
        motion = np.concatenate([motion] * -(-(WINDOW + 60) // len(motion)))[: WINDOW + 60]
        motion += rng.normal(0, noise / 1000, motion.shape).astype(np.float32)
        name = f"F2_e{number + 1:02d}"
        np.save(root / "vertices_npy" / f"{name}.npy", motion.reshape(len(motion), -1).astype(np.float32))
        speech, _ = soundfile.read(source / "wav" / f"{path.stem}.wav", dtype="int16")
        soundfile.write(root / "wav" / f"{name}.wav", np.resize(speech, len(motion) * 640), 16_000)
    speaker = paths[0].stem.split("_")[0]
    write_templates(root / "templates.pkl", {"F2": blended(templates[speaker].numpy())})
    write_json(root / "manifest.json", {"format": 1, "corpus": "biwi", "unit": "m"})


class Ranges(http.server.SimpleHTTPRequestHandler):
    """Serves files and ranges of them over connections that stay open."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:  # noqa: N802
        """Answer a request."""
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        first, stop = (int(asked[1]), int(asked[2]) + 1) if asked else (0, path.stat().st_size)
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(stop - first))
        self.end_headers()
        with path.open("rb") as stream:
            os.sendfile(self.connection.fileno(), stream.fileno(), first, stop - first)

    def log_message(self, *words: object) -> None:
        """Say nothing."""


def serve(folder: str) -> tuple[subprocess.Popen[str], str]:
    """A server of a folder in a process of its own, and the address of the packed corpus in it."""
    server = subprocess.Popen([sys.executable, __file__, "--serve", folder], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    return server, f"http://127.0.0.1:{int(server.stdout.readline())}/corpus.zarr"


def serve_forever(folder: str) -> None:
    """Serve a folder, and print the port."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Ranges, directory=folder)) as server:
        print(server.server_address[1], flush=True)
        server.serve_forever()


def forget(root: Path) -> None:
    """Give up the pages of all files below a folder."""
    for path in root.rglob("*"):
        if path.is_file():
            descriptor = os.open(path, os.O_RDONLY)
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            os.close(descriptor)


def clips_a_second(
    readers: dict[str, Callable[[int, int], object]], rounds: int, before: Callable[[], None]
) -> dict[str, float]:
    """The median speed of each reader over the same random windows, read turn by turn; processor time is printed."""
    rng = np.random.default_rng(1)
    taken: dict[str, list[float]] = {name: [] for name in readers}
    worked: dict[str, list[float]] = {name: [] for name in readers}
    for _ in range(rounds):
        clip, start = int(rng.integers(10**6)), int(rng.integers(61))
        for name, read in readers.items():
            before()
            began, used = time.perf_counter(), time.process_time()
            read(clip, start)
            taken[name].append(time.perf_counter() - began)
            worked[name].append(time.process_time() - used)
    shown = ", ".join(f"{name} {1000 * statistics.median(seconds):.1f} ms" for name, seconds in worked.items())
    print(f"processor time of a window: {shown}")
    return {name: 1 / statistics.median(seconds) for name, seconds in taken.items()}


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--corpus", type=Path, help="built-in corpus (default: the one in the cache)")
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02, 0.05], help="mm; the last is read")
    parser.add_argument("--chunk-seconds", type=float, default=0.5)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        serve_forever(asked.serve)
    from facediff.data import Biwi
    from facediff.data.packed.packing import pack
    from facediff.data.puppet import made_root

    source = asked.corpus or made_root(0)
    if source is None:
        parser.error("the built-in corpus is not made yet; run `facediff demo`, or give --corpus")
    os.environ["FACEDIFF_PACKED_CACHE_GB"] = "0"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for noise in asked.noise:
            shutil.rmtree(folder / "corpus", ignore_errors=True)
            shutil.rmtree(folder / "corpus.zarr", ignore_errors=True)
            write_corpus(folder / "corpus", source, asked.clips, noise)
            for lossless in (True, False):
                shutil.rmtree(folder / "corpus.zarr", ignore_errors=True)
                began = time.perf_counter()
                report = pack(
                    folder / "corpus",
                    folder / "corpus.zarr",
                    lossless=lossless,
                    chunk_seconds=asked.chunk_seconds,
                    workers=1,
                )
                hour = report.before / 1e9 / (report.seconds / 3600)
                kept = "lossless" if lossless else "0.01 mm "
                print(
                    f"noise {noise:5.3f} mm, {kept}: {report.gb_an_hour:5.2f} GB an hour of {hour:.1f}; packed at "
                    f"{report.seconds / (time.perf_counter() - began):.1f} times the speed of the recording",
                    flush=True,
                )
        server, address = serve(name)

        def reader(root: str) -> Callable[[int, int], Any]:
            corpus = Biwi(root=root).corpus
            clips = list(corpus.clips.values())

            def read(clip: int, start: int) -> None:
                which = clips[clip % len(clips)]
                corpus.read_motion(which, start, start + WINDOW)
                corpus.read_audio(which, start, start + WINDOW)

            for number in range(len(clips)):
                read(number, 0)
            return read

        readers = {"npy": reader(str(folder / "corpus")), "packed": reader(str(folder / "corpus.zarr"))}
        far = {"npy": readers["npy"], "packed": reader(address)}
        for title, chosen, before in (
            ("in memory", readers, lambda: None),
            ("over HTTP", far, lambda: None),
            ("from disk", readers, lambda: forget(folder)),
        ):
            found = clips_a_second(chosen, asked.rounds, before)
            print(
                f"{title}: npy {found['npy']:.1f} clips/s, packed {found['packed']:.1f}, ratio "
                f"{found['packed'] / found['npy']:.2f}",
                flush=True,
            )
        server.terminate()
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    sys.exit(main())
