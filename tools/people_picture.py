"""Draw a video with the points of its face, the tracked face, and the motion of its model on new speech.

    python tools/people_picture.py look.mp4 ada_corpus on_face.npz picture.webp

``tools/pictures.py people`` makes the files. A row each, six moments; the first two rows at the same times.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from facediff.animation import Animation, read_archive  # noqa: E402
from facediff.cli.track import CURVES, PREVIEW_RATE  # noqa: E402
from facediff.data.track.video import read_pictures  # noqa: E402
from facediff.export import ExportOptions  # noqa: E402
from facediff.export.video import drawn_frames  # noqa: E402
from facediff.pipelines.video_styles import first_clip  # noqa: E402

SIZE, MOMENTS = 220, 6


def moments(count: int) -> list[int]:
    """Frames evenly spread over some."""
    return [int(share * count) for share in np.linspace(0.1, 0.9, MOMENTS)]


def row(animation: Animation, picks: list[int], title: str) -> list[np.ndarray]:
    """Frames of an animation."""
    return list(drawn_frames([replace(animation, name=title).part(picks)], ExportOptions(size=SIZE)))


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("video", "corpus", "animation", "picture"):
        parser.add_argument(name, type=Path)
    given = parser.parse_args()
    tracked, spoken = first_clip(given.corpus), read_archive(given.animation)
    picks = moments(len(tracked.vertices))
    pictures = [picture for _, picture in read_pictures(given.video)]
    filmed = [pictures[round(pick / tracked.frame_rate * PREVIEW_RATE)][:-CURVES] for pick in picks]
    rows = [
        [np.asarray(Image.fromarray(picture).resize((SIZE, SIZE))) for picture in filmed],
        row(tracked, picks, "tracked"),
        row(spoken, moments(len(spoken.vertices)), "new speech"),
    ]
    sheet = np.concatenate([np.concatenate(frames, axis=1) for frames in rows])
    Image.fromarray(sheet).save(given.picture, quality=82)


if __name__ == "__main__":
    main()
