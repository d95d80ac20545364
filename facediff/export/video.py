"""A video with the speech; several takes side by side."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.errors import FaceDiffError, MissingExtraError
from facediff.export.format import ExportOptions, Format

Frame = npt.NDArray[np.uint8]


def write(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Write an .mp4 with the speech of the first take that has one.

    A take that ends before the longest stays on its last frame.

    Raises:
        FaceDiffError: if a take has no triangles, or the frame rates differ.
        MissingExtraError: if what draws or encodes is not installed.
    """
    from facediff.render import write_video

    frames = max(len(animation.vertices) for animation in takes)
    shown: Iterable[Frame] = drawn_frames(takes, options)
    if not options.quiet:
        shown = _bar(shown, f"drawing {path.name}", frames)
    speaker = next((animation for animation in takes if animation.speech is not None), takes[0])
    heard = speaker.sound() if options.speech else None
    write_video(path, shown, speaker.frame_rate, heard, speaker.sample_rate)


def drawn_frames(takes: Sequence[Animation], options: ExportOptions) -> Iterator[Frame]:
    """Pictures of takes side by side, one a frame; everything is checked before the first is drawn.

    Faces of one unit are seen by one camera, so that their sizes compare.

    Raises:
        FaceDiffError: if a take has no triangles, or the frame rates differ.
    """
    from facediff.render import Camera, Renderer, side_by_side

    if len({animation.frame_rate for animation in takes}) > 1:
        told = ", ".join(f"{animation.name} {animation.frame_rate:g}" for animation in takes)
        raise FaceDiffError(f"the takes differ in frame rate ({told}); a video has one, so write a video for each")
    metres = [metres_per_unit(animation.unit) for animation in takes]
    camera = None
    if len(set(metres)) == 1:
        camera = Camera.framing([animation.template for animation in takes], view=options.view)
    renderers = [
        Renderer(
            animation.triangles,
            template=animation.template,
            view=options.view,
            size=options.size,
            camera=camera,
            colours=animation.colours,
        )
        for animation in takes
    ]
    frames = max(len(animation.vertices) for animation in takes)
    motions = [held(animation.vertices, frames) for animation in takes]
    # Where nothing else is to be said, the corpora: that one is synthetic must not get lost on the way to a video.
    corpora = dict.fromkeys(animation.metadata["corpus"] for animation in takes if "corpus" in animation.metadata)
    footer = " – ".join(part for part in (options.footer or ", ".join(corpora), procedural(takes)) if part)
    return side_by_side(renderers, motions, [animation.name for animation in takes], footer=footer or None)


def procedural(takes: Sequence[Animation]) -> str:
    """What in the takes was made by rules and not learnt, in short: it must be told wherever it is seen."""
    told = dict.fromkeys(re.sub(r" \([^)]*\)", "", animation.metadata.get("procedural", "")) for animation in takes)
    words = ", ".join(text.replace(";", ",") for text in told if text)
    return f"procedural: {words}" if words else ""


def held(motion: npt.NDArray[np.float32], frames: int) -> npt.NDArray[np.float32]:
    """A motion (T, V, 3) that stays on its last frame until there are so many."""
    missing = frames - len(motion)
    return motion if not missing else np.concatenate([motion, np.repeat(motion[-1:], missing, axis=0)])


def _bar(items: Iterable[Frame], description: str, total: int) -> Iterable[Frame]:
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise MissingExtraError("tqdm", "train", "a progress bar") from error
    return tqdm(items, desc=description, total=total, leave=False)


FORMAT = Format(
    help="video with the speech; several takes side by side",
    write=write,
    then="any player shows it",
    several=True,
    holds_sound=True,
    unit="none",
    ups=(),
    package=("av", "render"),
)
