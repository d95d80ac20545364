"""What a packed corpus costs on disk, and how quickly its windows are read, against memory-mapped .npy files.

Run ``python tools/benchmarks/packed.py``: makes a corpus of BIWI's size (23 370 vertices, 25 frames a second) and packs
it. Its motion is that of the built-in corpus, each vertex a blend of two of its vertices, plus independent Gaussian
noise at every coordinate of every frame, as capture has it; ``--noise`` gives its deviations in millimetres, since the
size depends on them. Then batches of random windows of 100 frames with their speech are read turn by turn, in one
process, from plain files, from packed ones by codec, and from these over HTTP:

- ``first``: all files lie in the page cache; no decoded chunk is kept, as in the first epoch, or for a corpus that is
  larger than the cache of chunks.
- ``again``: the same with the cache of chunks, filled before.
- ``disk``: every file's pages were given up before each batch.

Over HTTP, from a server of this machine that answers ranges, nothing is kept on disk, and each batch is announced when
it begins, as a loader does; ``without read-ahead`` it is not.
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

import numpy as np

VERTICES = 23_370
RATE = 25
WINDOW = 100
BATCH = 8


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
    """A server of a folder in a process of its own, and its address."""
    server = subprocess.Popen([sys.executable, __file__, "--serve", folder], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    return server, f"http://127.0.0.1:{int(server.stdout.readline())}"


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


Window = tuple[int, int]
Reader = Callable[[list[Window]], object]


def reader(root: str, *, memory: float) -> Reader:
    """Reads a batch of windows, clip and first frame, of a corpus whose cache of chunks has so many gigabytes."""
    from facediff.data import Biwi
    from facediff.data.packed.decoded import VARIABLE

    os.environ[VARIABLE] = str(memory)
    corpus = Biwi(root=root).corpus
    clips = list(corpus.clips.values())

    def read(windows: list[Window]) -> None:
        stretches = [(clips[clip % len(clips)], start, start + WINDOW) for clip, start in windows]
        for clip, start, stop in stretches:
            corpus.read_audio(clip, start, stop)
            corpus.read_motion(clip, start, stop)

    for _ in range(3 if memory else 1):
        read([(number, start) for number in range(len(clips)) for start in (0, 60)])
    return read


def compare(title: str, readers: dict[str, Reader], batches: int, before: Callable[[], None] = lambda: None) -> None:
    """Print the speed of each reader over the same random batches, read turn by turn, and its ratio to the first."""
    rng = np.random.default_rng(1)
    taken: dict[str, list[float]] = {name: [] for name in readers}
    worked: dict[str, list[float]] = {name: [] for name in readers}
    for _ in range(batches):
        windows = [(int(rng.integers(10**6)), int(rng.integers(61))) for _ in range(BATCH)]
        for name, read in readers.items():
            before()
            began, used = time.perf_counter(), time.process_time()
            read(windows)
            taken[name].append((time.perf_counter() - began) / BATCH)
            worked[name].append((time.process_time() - used) / BATCH)
    names = list(readers)
    for name in names:
        # Of each turn the ratio, and of these the median: what else runs on the machine slows both sides of a turn.
        ratio = statistics.median(np.divide(taken[names[0]], taken[name]))
        work = statistics.median(np.divide(worked[names[0]], worked[name]))
        print(
            f"{title:6} {name:30} {1000 * statistics.median(taken[name]):6.1f} ms a window, processor "
            f"{1000 * statistics.median(worked[name]):6.1f} ms; {names[0]} : this {ratio:.2f}, processor {work:.2f}",
            flush=True,
        )


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--corpus", type=Path, help="built-in corpus (default: the one in the cache)")
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.02, 0.05], help="mm; the last is read")
    parser.add_argument("--chunk-seconds", type=float, default=0.5)
    parser.add_argument("--batches", type=int, default=15)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        serve_forever(asked.serve)
    from facediff.data.packed.layout import CODECS
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
            write_corpus(folder / "corpus", source, asked.clips, noise)
            for lossless, codec in ((True, "zstd"), (True, "lz4"), (False, "zstd"), (False, "lz4")):
                out = folder / f"{codec}.zarr"
                shutil.rmtree(out, ignore_errors=True)
                began = time.perf_counter()
                report = pack(
                    folder / "corpus",
                    out,
                    lossless=lossless,
                    chunk_seconds=asked.chunk_seconds,
                    codec=codec,
                    workers=1,
                )
                hour = report.before / 1e9 / (report.seconds / 3600)
                kept = ("lossless" if lossless else "0.01 mm") + f", {codec}"
                print(
                    f"noise {noise:5.3f} mm, {kept}: {report.gb_an_hour:5.2f} GB an hour of {hour:.1f}; packed at "
                    f"{report.seconds / (time.perf_counter() - began):.1f} times the speed of the recording",
                    flush=True,
                )
        server, address = serve(name)

        plain = reader(str(folder / "corpus"), memory=0)
        near = {codec: str(folder / f"{codec}.zarr") for codec in CODECS}
        first = {"plain files": plain, **{codec: reader(near[codec], memory=0) for codec in CODECS}}
        for codec in CODECS:
            far = f"{address}/{codec}.zarr"
            first[f"{codec}, HTTP"] = reader(far, memory=0)
        compare("first", first, asked.batches)
        again = {codec: reader(near[codec], memory=0.5) for codec in CODECS}
        compare("again", {"plain files": plain, **again}, asked.batches)
        there = {name: read for name, read in first.items() if "HTTP" not in name}
        compare("disk", there, asked.batches, lambda: forget(folder))
        server.terminate()
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    sys.exit(main())
