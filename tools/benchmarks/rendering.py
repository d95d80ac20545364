"""How many pictures a second the renderer draws, and what a second of video costs.

Run ``python tools/benchmarks/rendering.py``; half a minute. The meshes are dented spheres with about as many
vertices as FLAME (5 023) and BIWI (23 370). OpenCV is held to one thread, and seconds are the process's own, so that
other programs on the machine disturb little.

``python tools/benchmarks/rendering.py video`` writes videos and prints seconds for each second of speech; with
``--against REVISION`` it also runs an older version of the package, in turn with this one, and prints the ratio.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from machine import machine

from facediff.render import Renderer

SIZES = (5023, 23370)
FRAMES = 12

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]


def head(n_vertices: int) -> tuple[Array, Faces]:
    """A head-sized egg (V, 3) of about `n_vertices`, open at its neck, with faces (F, 3)."""
    rows = round(math.sqrt(n_vertices / 2))
    columns = round(n_vertices / rows)
    polar, around = np.meshgrid(
        np.linspace(0.01, 0.85 * np.pi, rows),
        np.linspace(0, 2 * np.pi, columns, endpoint=False),
        indexing="ij",
    )
    unit = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    faces = np.concatenate([np.stack([a, a + columns, b], 1), np.stack([b, a + columns, b + columns], 1)])
    return unit.reshape(-1, 3) * [0.75, 1.1, 0.9], faces


def motion(vertices: Array) -> Array:
    """The mesh with a mouth-like dent that opens: (FRAMES, V, 3)."""
    x, y, z = vertices.T
    dent = np.exp(-((x / 0.25) ** 2) - ((y + 0.4) / 0.12) ** 2) * (z > 0)
    opening = np.sin(np.linspace(0, np.pi, FRAMES))
    return np.asarray(vertices - opening[:, None, None] * 0.2 * dent[:, None] * [0, 0, 1])


def frames_per_second(draw: Callable[[Array], object], frames: Array) -> float:
    """Median speed over the frames, after one to warm up, per second of one core's time."""
    draw(frames[0])
    seconds = []
    for frame in frames:
        start = time.process_time()
        draw(frame)
        seconds.append(time.process_time() - start)
    return 1 / float(np.median(seconds))


def talking_faces(frames: int) -> dict[str, tuple[Array, Faces, npt.NDArray[np.uint8]]]:
    """Motion (T, V, 3), faces and colours of the built-in face and of an egg of BIWI's size, whose mouths open."""
    from facediff.synthetic.head.parts import build_head
    from facediff.synthetic.known_faces import built_in_rig

    opening = np.sin(np.arange(frames) / 2) ** 2
    rig = built_in_rig()
    talking = rig.neutral + opening[:, None, None] * rig.deltas[rig.names.index("jawOpen")]
    egg, egg_faces = head(SIZES[-1])
    moving = motion(egg)[np.rint(opening * (FRAMES // 2)).astype(int)]
    tint = np.rint(255 * np.clip(np.abs(egg), 0, 1)).astype(np.uint8)
    return {
        "the built-in face": (talking, build_head().faces.astype(np.int64), build_head().colours),
        "an egg of BIWI's size": (moving, egg_faces, tint),
    }


def video_seconds(seconds: float, size: int, frame_rate: int = 25) -> dict[str, list[float]]:
    """For each face: seconds of the clock and of processors for each second of a video with sound."""
    from facediff.render import side_by_side, write_video

    sound = np.random.default_rng(0).normal(0, 0.1, round(seconds * 16000)).astype(np.float32)
    costs = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (frames, faces, colours) in talking_faces(round(seconds * frame_rate)).items():
            renderer = Renderer(faces, template=frames[0], size=size, colours=colours)
            renderer.render(frames[0])
            clock, processor = time.perf_counter(), time.process_time()
            pictures = side_by_side(renderer, [frames], ["face"])
            write_video(Path(folder, "face.mp4"), pictures, frame_rate, sound, 16000)
            costs[name] = [(time.perf_counter() - clock) / seconds, (time.process_time() - processor) / seconds]
    return costs


def video(options: argparse.Namespace) -> None:
    """Print seconds for each second of speech, of this version and of another in turn."""
    versions = {"this version": Path(__file__).parents[2]}
    with tempfile.TemporaryDirectory() as older:
        if options.against:
            command = ["git", "-C", str(Path(__file__).parents[2]), "archive", options.against, "facediff"]
            archive = subprocess.run(command, capture_output=True, check=True).stdout
            subprocess.run(["tar", "-x", "-C", older], input=archive, check=True)
            versions[options.against] = Path(older)
        found: dict[str, list[dict[str, list[float]]]] = {version: [] for version in versions}
        for _ in range(options.rounds):
            for version, folder in versions.items():
                words = ["video", f"--seconds={options.seconds}", f"--size={options.size}", "--json"]
                command = [sys.executable, str(Path(__file__).resolve()), *words]
                environment = {**os.environ, "PYTHONPATH": str(folder)}
                done = subprocess.run(command, capture_output=True, check=True, env=environment, text=True)
                found[version].append(json.loads(done.stdout))
    print(f"{machine()}; {options.size} pixels, 25 frames a second, best of {options.rounds}")
    print(f"{'seconds for each second of video':<36}{'':<22}{'clock':>8}{'CPU':>8}{'ratio':>8}")
    for face in found["this version"][0]:
        best = {
            version: [min(column) for column in zip(*(costs[face] for costs in rounds), strict=True)]
            for version, rounds in found.items()
        }
        for version, (clock, processor) in best.items():
            ratio = clock / best["this version"][0]
            print(f"{face:<36}{version:<22}{clock:>8.2f}{processor:>8.2f}{ratio:>8.2f}")


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="?", choices=("frames", "video"), default="frames")
    parser.add_argument("--against", help="video: a revision of git to compare with")
    parser.add_argument("--seconds", type=float, default=4.0, help="video: length")
    parser.add_argument("--size", type=int, default=512, help="video: pixels")
    parser.add_argument("--rounds", type=int, default=3, help="video: runs, of which the best counts")
    parser.add_argument("--json", action="store_true", help="video: one run of this version, as JSON")
    options = parser.parse_args()
    if options.json:
        print(json.dumps(video_seconds(options.seconds, options.size)))
    else:
        video(options) if options.what == "video" else drawing()


def drawing() -> None:
    """Print one line per mesh and way of drawing."""
    import cv2

    cv2.setNumThreads(1)
    print(f"{machine()}; OpenCV {cv2.__version__}, one thread, seconds of its core")
    print(f"512 x 512, median of {FRAMES} frames")
    print(f"{'vertices':>9}{'faces':>9}  {'drawn by':<34}{'frames/s':>9}{'ratio':>7}")
    for size in SIZES:
        vertices, faces = head(size)
        frames = motion(vertices)
        colours = np.clip(np.abs(frames[-1]), 0, 1)
        smooth = Renderer(faces, template=vertices)
        coarse = Renderer(faces, template=vertices, supersample=1)
        tinted = Renderer(faces, template=vertices, colours=colours)
        ways: dict[str, Callable[[Array], object]] = {
            "facediff, 2 x 2 samples": smooth.render,
            "facediff, 2 x 2, vertex colours": tinted.render,
            "facediff, 1 sample": coarse.render,
        }
        base: float | None = None
        for name, draw in ways.items():
            speed = frames_per_second(draw, frames)
            base = speed if base is None else base
            ratio = f"{speed / base:.1f}" if base else "-"
            print(f"{len(vertices):>9}{len(faces):>9}  {name:<34}{speed:>9.1f}{ratio:>7}")


if __name__ == "__main__":
    main()
