"""Videos with the speech, and moving pictures without; several animations are shown side by side."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.animation.options import ExportOptions
from facediff.errors import FaceDiffError
from facediff.export.format import Format
from facediff.registry import export_format
from facediff.utils.progress import track

Frame = npt.NDArray[np.uint8]


@export_format.register("mp4")
class Mp4(Format):
    """Video with the speech (H.264 and AAC); several animations side by side."""

    next_step = "any player shows it"
    holds_several = True
    speech: ClassVar[Literal["in the file", "next to it", "none"]] = "in the file"
    units = "none"
    up_axes = ()
    uses = ("view", "size", "video_rate")
    requires = ("av", "render")

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write a video with the speech of the first animation that has one.

        An animation that ends before the longest stays on its last frame.
        """
        from facediff.render import write_video

        frames = shown_frames(path, animations, options)
        speaking = next((animation for animation in animations if animation.speech is not None), animations[0])
        sound = speaking.sound() if not options.no_speech else None
        write_video(path, frames, options.video_rate or speaking.frame_rate, sound, speaking.sample_rate)


@export_format.register("webm")
class Webm(Mp4):
    """Video with the speech (VP9 and Opus), for web pages; several animations side by side."""


@export_format.register("gif")
class Gif(Mp4):
    """Moving picture without sound, a third of a video's size; several animations side by side."""

    speech = "none"
    requires = ("PIL", "render")

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write a picture that plays again and again; its frames last whole hundredths of a second, two at least."""
        from PIL import Image

        rate = min(options.video_rate or animations[0].frame_rate, 50.0)  # browsers play shorter frames slowly
        frames = shown_frames(path, animations, replace(options, size=max(options.size // 3, 16), video_rate=rate))
        pictures = [Image.fromarray(frame).quantize(dither=Image.Dither.NONE) for frame in frames]
        # Rounded ends, not rounded lengths, keep the pace.
        ends = [round(100 * number / rate) for number in range(len(pictures) + 1)]
        lengths = [10 * (end - start) for start, end in zip(ends, ends[1:], strict=False)]
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=lengths, loop=0)


def shown_frames(path: Path, animations: Sequence[Animation], options: ExportOptions) -> Iterator[Frame]:
    """The pictures of a file, with a progress bar."""
    longest = max(len(animation.vertices) for animation in animations)
    total = longest if options.video_rate is None else _count(longest, animations[0].frame_rate, options.video_rate)
    frames = drawn_frames(animations, options)
    return iter(track(frames, f"drawing {path.name}", total=total, shown=not options.quiet))


def _count(frames: int, frame_rate: float, video_rate: float) -> int:
    return math.floor((frames - 1) * video_rate / frame_rate + 1e-9) + 1


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Motion (T, V, 3) at another rate: a picture between two frames shows the straight way between them."""

    motion: npt.NDArray[np.floating]
    frame_rate: float
    video_rate: float

    def __len__(self) -> int:
        return _count(len(self.motion), self.frame_rate, self.video_rate)

    def __getitem__(self, index: int) -> npt.NDArray[np.floating]:
        part, frame = math.modf(index * self.frame_rate / self.video_rate)
        before = np.asarray(self.motion[int(frame)])
        return before if part < 1e-6 else before + np.float32(part) * (self.motion[int(frame) + 1] - before)


def drawn_frames(animations: Sequence[Animation], options: ExportOptions) -> Iterator[Frame]:
    """Pictures of animations side by side, one a frame; everything is checked before the first is drawn.

    Faces of one unit are seen by one camera, so that their sizes compare.
    """
    from facediff.render import Camera, Renderer, portrait, side_by_side

    if len({animation.frame_rate for animation in animations}) > 1:
        rates = ", ".join(f"{animation.name} {animation.frame_rate:g}" for animation in animations)
        raise FaceDiffError(
            f"the animations differ in frame rate ({rates}); a video has one, so write a video for each"
        )
    camera = None
    if len({metres_per_unit(animation.unit) for animation in animations}) == 1:
        camera = Camera.framing(
            [portrait(animation.template, animation.regions) for animation in animations], view=options.view
        )
    renderers = [
        Renderer(
            animation.triangles,
            template=animation.template,
            view=options.view,
            size=options.size,
            camera=camera,
            colours=animation.colours,
        )
        for animation in animations
    ]
    frames = max(len(animation.vertices) for animation in animations)
    motions: list[Any] = [
        np.pad(motion, ((0, frames - len(motion)), (0, 0), (0, 0)), "edge") if len(motion) < frames else motion
        for motion in (animation.vertices for animation in animations)
    ]
    if options.video_rate is not None:
        motions = [Interpolated(motion, animations[0].frame_rate, options.video_rate) for motion in motions]
    # A video must say that a corpus is synthetic, so that the footer names the corpora unless the user chose a text.
    corpora = dict.fromkeys(animation.metadata["corpus"] for animation in animations if "corpus" in animation.metadata)
    footer = " - ".join(part for part in (options.footer or ", ".join(corpora), procedural(animations)) if part)
    names = [animation.name for animation in animations] if len(animations) > 1 else [""]
    return side_by_side(renderers, motions, names, footer=footer or None)


def procedural(animations: Sequence[Animation]) -> str:
    """A short text that names what in the animations follows rules and was not learnt; empty if nothing does."""
    notes = dict.fromkeys(
        re.sub(r" \([^)]*\)", "", animation.metadata.get("procedural", "")) for animation in animations
    )
    rules = ", ".join(note.replace(";", ",") for note in notes if note)
    return f"procedural: {rules}" if rules else ""
